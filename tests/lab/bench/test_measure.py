# SPDX-License-Identifier: Apache-2.0
"""One real run of a benchmark, in this process: interrupted while training and before its evaluation, then measured."""

import json
from pathlib import Path

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras

from nrfgs_lab.bench import run as bench_run
from nrfgs_lab.bench.choice import named_run, united, with_records
from nrfgs_lab.bench.command import Bench
from nrfgs_lab.bench.measure import at_size, over_views
from nrfgs_lab.bench.spec import Job, cells_of, command, identity, make_spec
from nrfgs_ns.errors import InputError

pytestmark = pytest.mark.usefixtures("no_cuda")


class Killed(BaseException):
    """Stands for a signal."""


def test_an_interrupted_run_ends_with_a_whole_record(tiny_scene, tmp_path, monkeypatch):
    content = {"runs": {"NRF": "nrfgs"}, "scenes": ["tiny"], "strategies": ["mcmc@310"], "steps": 8}
    options = "--pipeline.model.warmup-length 1 --pipeline.model.few-views off"
    content |= {"checkpoint_every": 2, "train_views": 3, "options": options}
    spec = make_spec(content, "test")
    (cell,) = cells_of(spec)
    parser = ["nrfgs-data", "--data", str(tiny_scene)]
    args = command(spec, cell, parser, tmp_path / "work")
    job = Job(args, identity(spec, cell, parser), 8, str(tmp_path / "record.json"), str(tmp_path / "work"), 3, 1)

    train, evaluate = bench_run.train, bench_run.evaluate

    def killed_at_5(args, on_step, on_save, earlier):
        def step(number: int) -> None:
            if number == 5:
                raise Killed

        return train(args, step, on_save, earlier)

    def killed(*_):
        raise Killed

    monkeypatch.setattr(bench_run, "train", killed_at_5)
    with pytest.raises(Killed):
        bench_run.run(job)
    assert bench_run.last_checkpoint(tmp_path / "work").name == "step-000000004.ckpt"
    monkeypatch.setattr(bench_run, "train", train)
    monkeypatch.setattr(bench_run, "evaluate", killed)
    with pytest.raises(Killed):
        bench_run.run(job)
    assert not Path(job.record).exists()
    monkeypatch.setattr(bench_run, "train", killed)  # what is trained is not trained again
    monkeypatch.setattr(bench_run, "evaluate", evaluate)
    bench_run.run(job)

    record = json.loads(Path(job.record).read_text())
    measured, trained = record["measured"], record["train"]
    assert record["identity"] == job.identity and str(tmp_path) not in json.dumps(record)
    assert trained["parts"] == 2 and trained["steps"] == 8 and trained["seconds"] > 0
    assert [step for step, _ in trained["splats"]] == [0, 7]
    assert [step for step, _ in trained["saved"]] == [2, 4, 6, 7]
    # One and the same code took both; the renderings are the same to rounding.
    for metric in ("psnr", "ssim", "l1"):
        assert measured["test"][metric] == pytest.approx(record["eval"][metric], rel=1e-5)
    assert measured["test"]["lpips"] is None
    assert [image["image"] for image in measured["train"]["per_image"]] == [
        "view_001.png",
        "view_003.png",
        "view_006.png",
    ]
    mean = sum(image["psnr"] for image in measured["train"]["per_image"]) / 3
    assert measured["train"]["psnr"] == pytest.approx(mean)
    assert measured["parameter_bytes"] == record["eval"]["parameter_bytes"] == 4 * (measured["splats"] * 46 + 6664)
    assert measured["diffuse"] == 0
    assert measured["fps"] > 0 and measured["checkpoint_bytes"] > measured["parameter_bytes"]
    assert len(list((tmp_path / "work" / "pictures").glob("eval_img_*.png"))) == 2


class Grey:
    """A model that renders grey."""

    device = torch.device("cpu")

    def get_outputs_for_camera(self, camera):
        return {"rgb": torch.full((16, 16, 3), 0.5), "background": torch.zeros(3)}

    def get_gt_img(self, image):
        return image

    def composite_with_background(self, image, background):
        return image


def test_flip_is_asked_for_inside_the_mask_and_left_out_of_the_mean_where_it_is_none():
    asked = []

    def flip(pred, truth, mask):
        asked.append((pred.shape, float(truth.mean()), mask if mask is None else int(mask.sum())))
        return None if mask is not None and not mask.any() else 0.25 * len(asked)

    def view(name, value, mask=None):
        batch = {"image": torch.full((16, 16, 3), value)} | ({} if mask is None else {"mask": mask})
        return name, (None, batch)

    part = torch.zeros(16, 16, 1)
    part[:4] = 1.0
    views = [view("a", 0.5), view("b", 0.0, part), view("c", 1.0, torch.zeros(16, 16, 1))]
    measured = over_views(Grey(), views, flip)
    assert asked == [((16, 16, 3), 0.5, None), ((16, 16, 3), 0.0, 64), ((16, 16, 3), 1.0, 0)]
    assert [one["flip"] for one in measured["per_image"]] == [0.25, 0.5, None] and measured["flip"] == 0.375
    without = over_views(Grey(), views)
    assert without["flip"] is None and "flip" not in without["per_image"][0]


def test_at_size_keeps_the_pose_and_the_vertical_angle():
    """The middle of the upper edge, and the image's centre, look where they looked."""
    pose = torch.tensor([[0.0, 0.0, 1.0, 3.0], [1.0, 0.0, 0.0, 2.0], [0.0, 1.0, 0.0, 1.0]])
    camera = Cameras(pose[None], fx=300.0, fy=320.0, cx=200.0, cy=100.0, width=400, height=200)
    wide = at_size(camera, 1920, 1080)
    assert (wide.width.item(), wide.height.item()) == (1920, 1080)
    for before, after in (((100, 200), (540, 960)), ((0, 200), (0, 960))):
        rays = [one.generate_rays(0, coords=torch.tensor(at).float()) for one, at in ((camera, before), (wide, after))]
        torch.testing.assert_close(rays[0].directions, rays[1].directions)
        torch.testing.assert_close(rays[0].origins, rays[1].origins)


FILE = """
runs:
  no split: {method: nrfgs, options: --x False, steps: 9}
  NRF-GS: nrfgs
  nrfgs-sh: {method: nrfgs-sh, options: --degree 1}
  5: nrfgs-vdgs
scenes: [{path: garden, downscale: 4}, other]
"""


@pytest.fixture
def file(tmp_path):
    """The file above."""
    (tmp_path / "spec.yaml").write_text(FILE)
    return tmp_path / "spec.yaml"


def test_runs_are_chosen_by_name(file):
    """A run of the file, with its options; else a method. A name that is both is the file's."""

    def runs(*words):
        return [(run.name, run.method, run.options, run.steps) for run in Bench(spec=file, runs=words).plan().runs]

    assert runs("no split", "NRF-GS") == [("no split", "nrfgs", ("--x", "False"), 9), ("NRF-GS", "nrfgs", (), None)]
    assert runs("nrfgs-sh", "5") == [("nrfgs-sh", "nrfgs-sh", ("--degree", "1"), None), ("5", "nrfgs-vdgs", (), None)]
    assert runs("nrfgs", "nrfgs-sg --y 1") == [
        ("nrfgs", "nrfgs", (), None),
        ("nrfgs-sg --y 1", "nrfgs-sg", ("--y", "1"), None),
    ]
    assert runs("no split=nrfgs --x True") == [("no split", "nrfgs", ("--x", "True"), None)]
    listed = "no method of ns-train.*has no run of that name.*no split, NRF-GS, nrfgs-sh, 5"
    for words in ("no opacity", "NRF-GSS", "a=nrf"):
        with pytest.raises(InputError, match=listed):
            runs("NRF-GS", words)
    with pytest.raises(InputError, match="'nrgs' is no method of ns-train. Give"):
        Bench(runs=("nrgs",), data=("x",)).plan()
    assert [run.method for run in Bench(runs=("splatfacto",), data=("x",)).plan().runs] == ["splatfacto"]


def test_a_chosen_run_is_the_one_of_the_whole_file(file):
    whole, part = Bench(spec=file).plan(), Bench(spec=file, runs=("no split",), data=("garden",)).plan()
    (cell,) = cells_of(part)
    assert cell == cells_of(whole)[0] and cell.scene.downscale == 4
    assert identity(part, cell, None) == identity(whole, cell, None)


def test_everything_of_a_file_and_what_is_asked_for():
    """What is asked for comes behind the file's, in place of what has its name; the rest is the command's."""
    file = {"runs": {"a": "nrfgs", 5: "nrfgs-sh"}, "scenes": [{"path": "s/", "downscale": 2}, "t"], "steps": 9}
    asked = {"runs": {"a": "nrfgs-sg", "b": "nrfgs"}, "scenes": ["u", {"path": "s", "downscale": 2}], "steps": 3}
    both = united(file, asked)
    assert both["runs"] == {"a": "nrfgs-sg", "5": "nrfgs-sh", "b": "nrfgs"} and list(both["runs"]) == ["a", "5", "b"]
    assert both["scenes"] == [{"path": "s", "downscale": 2}, "t", "u"]
    assert both["steps"] == 3 and "seeds" not in both and "strategies" not in both
    # A file without seeds or strategies has the defaults of a benchmark.
    more = united(file, {**asked, "seeds": [7, 42], "strategies": ["mcmc"]})
    assert more["seeds"] == [42, 7] and more["strategies"] == ["own", "mcmc"]
    more = united({**file, "seeds": 1, "strategies": "original"}, {**asked, "seeds": [7], "strategies": ["mcmc"]})
    assert more["seeds"] == [1, 7] and more["strategies"] == ["original", "mcmc"]
    assert united({}, asked) == asked


def test_scenes_are_chosen_however_their_path_is_written(file):
    (scene,) = Bench(spec=file, data=("./garden/",)).plan().scenes
    assert (scene.name, scene.downscale) == ("garden", 4)


def test_a_report_has_what_is_asked_for_and_what_is_there():
    content = {
        "runs": {"a": "nrfgs", "b": "nrfgs", "c": "nrfgs"},
        "scenes": ["s", "t", "u"],
        "strategies": ["splatfacto", "original", "mcmc"],
        "seeds": [1, 2, 3],
    }
    whole = make_spec(content, "file")
    asked = make_spec({"runs": {"b": "nrfgs"}, "scenes": "t", "strategies": "original", "seeds": 2}, "file")

    def shown(*there):
        spec = with_records(whole, asked, lambda name: name in there)
        return [run.name for run in spec.runs], [one.name for one in spec.scenes], spec.strategies, spec.seeds

    assert shown() == (["b"], ["t"], ["original"], [2])
    (name,) = (
        cell.name
        for cell in cells_of(whole)
        if (cell.run.name, cell.scene.name) == ("c", "s") and (cell.strategy, cell.seed) == ("mcmc", 1)
    )
    assert shown(name) == (["b", "c"], ["s", "t"], ["original", "mcmc"], [1, 2])


def test_runs_on_the_command_line_may_have_names_with_spaces_and_options_with_equals():
    assert named_run("nrfgs-sh") == ("nrfgs-sh", {"method": "nrfgs-sh", "options": ""})
    named = ("NRF-GS logit", {"method": "nrfgs", "options": "--pipeline.model.appearance.opacity-bound=logit"})
    assert named_run("NRF-GS logit=nrfgs --pipeline.model.appearance.opacity-bound=logit") == named
    plain = "nrfgs --machine.seed=3"
    assert named_run(plain) == (plain, {"method": "nrfgs", "options": "--machine.seed=3"})
