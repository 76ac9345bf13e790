# SPDX-License-Identifier: Apache-2.0
"""What a benchmark's file may say, the commands that come of it, and how data sets in each layout are read."""

import json
import shutil
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml
from nerfstudio.utils.eval_utils import eval_setup  # noqa: F401  (registers the data parsers once, before the timing)
from PIL import ExifTags, Image
from small_colmap import Model

from nrfgs_lab.bench.data import held_out_views, parser_options
from nrfgs_lab.bench.file import PLANS, load_spec, make_spec
from nrfgs_lab.bench.job import command, differences, identity, settings
from nrfgs_lab.bench.spec import PRESET_STEPS, Scene, Spec, cells_of, steps_of
from nrfgs_lab.pages.methods import HEADS, best_trial
from nrfgs_lab.pages.options import methods
from nrfgs_lab.training_run import parse
from nrfgs_ns.data.pictures import read_exif
from nrfgs_ns.densification import ErrorGuided, Mcmc
from nrfgs_ns.errors import InputError

SMALL = {"runs": {"SH": "nrfgs-sh", "NRF": "nrfgs"}, "scenes": ["bonsai"]}


def spec(**more):
    return make_spec({**SMALL, **more}, "test.yaml")


@cache
def plans() -> dict[tuple[str, str], Spec]:
    """Each plan of the shipped files, by file and name."""
    result = {}
    for file in sorted(PLANS.glob("*.yaml")):
        for name in yaml.safe_load(file.read_text()).get("plans", [""]):
            result[file.stem, name] = make_spec(load_spec(Path(file.stem), name), file.name)
    return result


def test_shipped_files_are_valid():
    for plan in plans().values():
        cells = cells_of(plan)
        assert {cell.run for cell in cells} == set(plan.runs) and {cell.scene for cell in cells} == set(plan.scenes)


@pytest.mark.slow
@pytest.mark.parametrize("file, name", plans())
def test_ns_train_takes_the_options_of_every_run(file, name, capsys):
    plan = plans()[file, name]
    for cell in {(cell.run, cell.strategy): cell for cell in cells_of(plan)}.values():
        if cell.run.method not in ("harmonics-decay", "linear-basis", "linear-opacity"):  # methods of an earlier commit
            parse(command(plan, cell, ["nrfgs-data", "--data", "x"], Path("w")))


def test_which_trainings_a_plan_has():
    """The first seed of everything comes first, scene by scene, strategies together; runs may have their own scenes and
    steps, and another project's methods run as they are."""
    runs = {"NRF": "nrfgs", "host": "splatfacto"}
    cells = cells_of(spec(runs=runs, strategies=["original", "mcmc@500"], seeds=[1, 2], scenes=["a", "b"]))
    assert len(cells) == 12 and [cell.seed for cell in cells] == [1] * 6 + [2] * 6
    assert [cell.name for cell in cells[:3]] == ["NRF-original-a-1", "NRF-mcmc@500-a-1", "host-own-a-1"]
    runs = {"NRF": {"method": "nrfgs", "steps": "own", "scenes": ["b"]}, "SH": "nrfgs-sh"}
    plan = spec(runs=runs, scenes=["a", {"path": "b", "steps": 7}], steps=9)
    cells = cells_of(plan)
    assert [cell.name for cell in cells] == ["SH-own-a-42", "NRF-own-b-42", "SH-own-b-42"]
    assert [steps_of(plan, cell.run, cell.scene) for cell in cells] == [9, None, 7]
    assert "--max-num-iterations" not in command(plan, cells[1], [], Path())


@pytest.mark.parametrize("content, says", [
    ({"runs": {"NRF": {"options": "-x"}}}, "NRF names no method"),
    ({"runs": {"NRF": {"method": "nrfgs", "colour": 3}}}, "NRF: unknown key.*colour"),
    ({"strategies": ["mcmc@many"]}, "budget is 'many'"),
    ({"seeds": ["x"]}, "seeds"),
    ({"scenes": ["a b", "a_b"]}, "twice"),
    ({"runs": {"NRF": {"method": "nrfgs", "scenes": ["bonsia"]}}}, "NRF: scenes: the plan has no bonsia"),
    ({"runs": {"host": {"method": "splatfacto", "strategies": ["original"]}}}, "splatfacto knows no strategy"),
    ({"runs": {"N": {"method": "nrfgs", "options": "--max-num-iterations 9"}}}, "N: options: --max-num.*use steps"),
    ({"options": "--machine.seed=3"}, "options: --machine.seed is given by the benchmark; use seeds"),
    ({"strategies": []}, "strategies or seeds is empty"),
    ({"scenes": ["../bonsai"]}, "no folder below --scenes"),
    ({"strategies": ["mcmc"], "options": "--pipeline.model.densification original"}, "densification is given.*mcmc"),
])  # fmt: skip
def test_what_is_wrong_is_named(content, says):
    with pytest.raises(InputError, match=says):
        spec(**content)


@pytest.mark.parametrize("text", ["runs: [", "just words", "runs: {A: nrfgs, A: nrfgs-sh}"])
def test_files_that_are_no_mapping_are_named(text, tmp_path):
    (tmp_path / "bad.yaml").write_text(text)
    with pytest.raises(InputError, match="bad.yaml"):
        load_spec(tmp_path / "bad.yaml")


def test_a_preset_keeps_its_steps():
    """nrfgs-fast at the benchmark's 30,000 steps would be nrfgs under another name."""
    runs = {"fast": "nrfgs-fast", "short": {"method": "nrfgs-fast", "steps": 77}, "NRF": "nrfgs"}
    plan = spec(runs=runs, steps=30_000)
    assert [steps_of(plan, run, plan.scenes[0]) for run in plan.runs] == [10_000, 77, 30_000]
    own = {one.config.method_name: one.config.max_num_iterations for one in methods()}
    assert own.pop("nrfgs") == own.pop("nrfgs-harmonics") == 0, "by the number of views; a benchmark says it"
    assert PRESET_STEPS == {name: steps for name, steps in own.items() if steps != 30_000}


@pytest.mark.parametrize("strategy, built", [("own", ErrorGuided()), ("mcmc@7,stop_at=9", Mcmc(budget=7, stop_at=9))])
def test_the_command_means_what_the_file_says(strategy, built, tiny_scene, tmp_path):
    runs = {"NRF": {"method": "nrfgs", "options": "--pipeline.model.appearance.latent-dim 9"}}
    plan = spec(runs=runs, strategies=[strategy], steps=7, seeds=[5], options="--pipeline.model.num-downscales 0")
    parser = parser_options(tiny_scene.parent, Scene(tiny_scene.name), tmp_path)
    config = parse(command(plan, *cells_of(plan), parser, tmp_path))
    model = config.pipeline.model
    assert model.densification == built
    assert (config.max_num_iterations, config.machine.seed, model.num_downscales) == (7, 5, 0)
    assert model.appearance.latent_dim == 9
    assert config.pipeline.datamanager.dataparser.data == tiny_scene


def test_fingerprints_ignore_paths_and_see_the_rest():
    plan = spec(options="--a 1")
    cell, parser = cells_of(plan)[0], ["nrfgs-data", "--data", "/here/bonsai", "--x", "1"]
    one = identity(plan, cell, parser)
    assert "/here" not in json.dumps(one) and one == identity(plan, cell, [*parser[:2], "/there", *parser[3:]])
    assert one == identity(spec(options="--a 1", checkpoint_every=3), cell, parser)
    assert not differences(one, identity(plan, cell, None)), "without the data their options are not compared"
    for change in ({"steps": 3}, {"train_views": 3}):
        assert differences(one, identity(spec(options="--a 1", **change), cell, None))
    assert differences(one, identity(plan, cell, [*parser[:4], "2"])) == "parser: --x 1"
    # The last two: a value that another option has, too, and one option more.
    for options, words in (("--a 2", "--a 1"), ("--a 42", "--a 1"), ("--a 1 --b 1", "fewer words")):
        assert differences(one, identity(spec(options=options), cell, None)) == f"options: {words}"


def load(parser: list[str], method: str = "nrfgs"):
    """The data manager that ns-train would have, with all its images."""
    data = parse([method, *parser]).pipeline.datamanager.setup(device="cpu", test_mode="val")
    data.load_all_images()
    return data


def names_of(dataset) -> list[str]:
    return sorted(Path(name).name for name in dataset.image_filenames)


@pytest.mark.parametrize("folder", ["sparse/0", "colmap/sparse/0"])
def test_colmap_is_read_with_every_8th_by_name(folder, tmp_path):
    """Also of images whose numbers run against their names."""
    model = Model()
    model.images = [(11 - number, *rest) for number, *rest in model.images]
    scene = model.write(tmp_path / "data" / "ring")
    if folder == "sparse/0":
        (scene / "colmap" / "sparse").rename(scene / "sparse")
    before = sorted((tmp_path / "data").rglob("*"))
    parser = parser_options(tmp_path / "data", Scene("ring"), tmp_path / "mirrors")
    assert parser[0] == "colmap"
    data = load(parser)
    assert names_of(data.eval_dataset) == ["000.png", "008.png"]
    assert names_of(data.train_dataset) == [f"{i:03d}.png" for i in range(10) if i not in (0, 8)]
    assert sorted((tmp_path / "data").rglob("*")) == before, "the data set was written to"
    parser_options(tmp_path / "data", Scene("ring"), tmp_path / "mirrors")  # a second time, over the first


def test_a_data_set_of_the_same_name_elsewhere_is_read_there(tmp_path):
    """--scenes has changed, --work has not: a link to the first place would train on other photographs."""
    for place in ("first", "second"):
        Model().write(tmp_path / place / "line")
        parser = parser_options(tmp_path / place, Scene("line"), tmp_path / "mirrors")
        mirror = Path(parser[parser.index("--data") + 1])
        assert (mirror / "images").resolve() == (tmp_path / place / "line" / "images").resolve()
    lists = {"test_list.txt", "train_list.txt", "val_list.txt"}
    assert {entry.name for entry in mirror.iterdir()} == {"colmap", "images", *lists}


def test_nerfstudios_layout_without_a_split_has_every_8th_by_name(tiny_scene, tmp_path):
    file = shutil.copytree(tiny_scene, tmp_path / "plain") / "transforms.json"
    meta = {key: value for key, value in json.loads(file.read_text()).items() if not key.endswith("_filenames")}
    file.write_text(json.dumps({**meta, "frames": meta["frames"][::-1]}))
    data = load(parser_options(tmp_path, Scene("plain"), tmp_path / "mirrors"))
    assert names_of(data.eval_dataset) == ["view_000.png", "view_008.png"]


def test_every_eighth_is_held_out_and_more_of_few():
    names = [f"{i:03}" for i in range(74)]
    assert held_out_views(names, 4) == ["004", "012", "020", "028", "036", "044", "052", "060", "068"]
    assert held_out_views(names[:17], 4) == ["004", "010", "016"]
    assert not set(held_out_views(names[:26], 0)) & set(held_out_views(names[:26], 4))


def test_held_out_scenes_have_no_test_view_and_the_same_cameras_at_half_the_size(tiny_scene, tmp_path):
    whole = json.loads((tiny_scene / "transforms.json").read_text())
    names = sorted(frame["file_path"] for frame in whole["frames"])
    whole |= {"train_filenames": names[1:], "test_filenames": names[:1]}
    source = shutil.copytree(tiny_scene, tmp_path / "captures" / "tiny")
    (source / "transforms.json").write_text(json.dumps(whole))
    plan = spec(scenes=["tiny", {"path": "tiny", "views": 2}], held_out=[2])
    assert [scene.name for scene in plan.scenes] == ["2/tiny", "2/2/tiny"]

    def made(scene) -> tuple[Path, dict]:
        name, _, folder = parser_options(source.parent, scene, tmp_path / "mirrors")
        assert name == "nrfgs-data"
        return Path(folder), json.loads((Path(folder) / "transforms.json").read_text())

    (folder, meta), (_, thin) = map(made, plan.scenes)
    assert meta["test_filenames"] == names[1:][2::6]
    assert sorted(meta["train_filenames"] + meta["test_filenames"]) == names[1:]
    assert (meta["w"], meta["fl_x"]) == (whole["w"] // 2, pytest.approx(whole["fl_x"] / 2))
    with Image.open(folder / names[1]) as image:
        assert image.size == (meta["w"], meta["h"])
    assert not (folder / names[0]).exists()
    left = meta["train_filenames"]
    assert thin == {**meta, "train_filenames": [left[0], left[len(left) // 2]]}
    (fold,) = spec(scenes=["tiny"], held_out=[1], held_out_every=3).scenes
    assert fold.name == "1 of 3/tiny"
    assert made(fold)[1]["test_filenames"] == names[1:][1::3]
    blocks = spec(scenes=["tiny"], held_out=[0, 1], held_out_every=2, held_out_by="place").scenes
    first, second = (set(made(block)[1]["test_filenames"]) for block in blocks)
    assert first | second == set(names[1:]) and not first & second
    places = {frame["file_path"]: np.array(frame["transform_matrix"])[:3, 3] for frame in whole["frames"]}
    axis = np.linalg.svd(np.array(some := [places[name] for name in names[1:]]) - np.mean(some, axis=0))[2][0]
    ends = [sorted(places[name] @ axis for name in block) for block in (first, second)]
    assert ends[0][-1] <= ends[1][0] or ends[1][-1] <= ends[0][0]
    folder, fewer = made(Scene("tiny", views=2))
    assert fewer == {**whole, "train_filenames": [names[1], names[1 + len(names[1:]) // 2]]}
    assert (folder / names[0]).exists()
    other = shutil.copytree(source, tmp_path / "other" / "tiny")  # of the same name: its images are not taken for these
    (other / "transforms.json").write_text(json.dumps({**whole, "train_filenames": names[2:]}))
    again = parser_options(other.parent, Scene("tiny", views=2), tmp_path / "mirrors")[2]
    assert json.loads((Path(again) / "transforms.json").read_text())["train_filenames"][0] == names[2]
    lens = {key: whole.pop(key) for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")}  # as prepare writes several cameras
    whole["frames"] = [{**frame, **lens} for frame in whole["frames"]]
    (source / "transforms.json").write_text(json.dumps(whole))
    shutil.rmtree(tmp_path / "mirrors")
    halved = {(frame["w"], frame["fl_x"], frame["cx"]) for frame in made(plan.scenes[0])[1]["frames"]}
    assert halved == {(meta["w"], meta["fl_x"], meta["cx"])}
    with pytest.raises(InputError, match="holds out none"):
        made(Scene("tiny", held_out=30, held_out_by="place"))
    (source / "transforms.json").write_text(json.dumps({**whole, "train_filenames": []}))
    with pytest.raises(InputError, match="too few training views"):
        parser_options(source.parent, Scene("tiny", held_out=3), tmp_path / "mirrors")
    (source / "transforms.json").write_text(json.dumps({"frames": whole["frames"]}))
    assert made(Scene("tiny", views=2))[1]["test_filenames"] == names[::8]
    frames = [{**frame, "file_path": str(source / frame["file_path"])} for frame in whole["frames"]]
    (source / "transforms.json").write_text(json.dumps({"frames": frames}))
    with pytest.raises(InputError, match="photographs elsewhere"):
        made(Scene("tiny", held_out=3))


@pytest.mark.parametrize("views", [None, 4])
def test_smaller_images_are_there_for_methods_that_only_read_them(views, tiny_scene, tmp_path):
    """Equal to those that `nrfgs-data` resizes itself, of any mode, with masks and EXIF; broken-off work goes on."""
    source = shutil.copytree(tiny_scene, tmp_path / "captures" / "tiny")
    meta = json.loads((source / "transforms.json").read_text())
    names = sorted(frame["file_path"] for frame in meta["frames"])
    meta |= {"train_filenames": names[1:], "test_filenames": names[:1]}
    for number, frame in enumerate(meta["frames"]):
        with Image.open(source / frame["file_path"]) as picture:
            exif = picture.getexif()
            exif[ExifTags.Base.Model] = "camera"
            picture.convert("P" if number % 2 else "RGB").save(source / frame["file_path"], exif=exif)
            frame["mask_path"] = f"masks/{number}.png"
            (source / "masks").mkdir(exist_ok=True)
            picture.convert("L").point(lambda value: 255 * (value > 99)).save(source / frame["mask_path"])
    (source / "transforms.json").write_text(json.dumps(meta))
    scene = Scene("tiny", downscale=2, views=views)
    resized = load(["nrfgs-data", "--data", str(source), "--downscale-factor", "2"]).train_dataset
    (Path(parser_options(source.parent, scene, tmp_path / "mirrors")[2]) / "images_2" / Path(names[3]).name).unlink()
    read = load(parser_options(source.parent, scene, tmp_path / "mirrors")).train_dataset
    assert {path.parent.name for path in read.image_filenames} == {"images_2"}
    twins = {path.name: index for index, path in enumerate(resized.image_filenames)}
    for index, path in enumerate(read.image_filenames):
        mine, theirs = read.get_data(index, "uint8"), resized.get_data(twins[path.name], "uint8")
        assert (mine["image"] == theirs["image"]).all() and (mine["mask"] == theirs["mask"]).all()
        assert read_exif(path)["model"] == "camera"
    assert not (source / "images_2").exists()


def test_compared_heads_have_what_held_out_views_chose():
    trials, rows = ({run.name: run for run in plans()["methods", name].runs} for name in ("heads", "methods"))
    for head, run in HEADS.items():
        trial = trials[f"{head} {best_trial(head)}".strip()]
        assert rows[run].method == trial.method
        assert set(settings(rows[run].options)) == set(settings(trial.options))
