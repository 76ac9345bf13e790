# SPDX-License-Identifier: Apache-2.0
"""A field through a compact file and back, and nerfstudio's commands on the result."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import tyro
from compact_fields import RENDER, field, read_container, through_a_file, write_container
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from short_trainings import command_line, set_up, trained
from torch.testing import assert_close

from nrfgs_lab.training_run import evaluate
from nrfgs_ns.appearance.head import Field, base_colors
from nrfgs_ns.appearance.reduce import build
from nrfgs_ns.compact.decode import decode
from nrfgs_ns.compact.encode import LARGEST_LOGIT, encode
from nrfgs_ns.compact.entropy import encode_table
from nrfgs_ns.compact.finetune import CodedSplats, Density, Rounded, bits_of_places, fine_tune, growth_without
from nrfgs_ns.compact.tables import NEAR, OCTAHEDRAL, STEPS, Grid, from_morton, morton, nearest_turn
from nrfgs_ns.errors import InputError
from nrfgs_ns.export.command import Export
from nrfgs_ns.trained.loading import load_file, load_model
from nrfgs_ns.training.config_file import read_config

pytestmark = pytest.mark.usefixtures("no_cuda")


@given(seed=st.integers(0, 99), count=st.integers(0, 40))
def test_morton_interleaves_and_back(seed, count):
    codes = np.random.default_rng(seed).integers(0, 2**21, (count, 3))
    codes[:1] = 2**21 - 1
    interleaved = morton(codes)
    assert (from_morton(interleaved) == codes).all()
    for row, number in zip(codes[:3], interleaved, strict=False):  # by hand, bit for bit
        assert sum(((int(row[axis]) >> k) & 1) << (3 * k + axis) for k in range(21) for axis in range(3)) == int(number)


@given(seed=st.integers(0, 99))
def test_grids_are_half_a_step_off_at_most(seed):
    random = np.random.default_rng(seed)
    values = random.normal(size=(30, 3)) * 10.0 ** random.uniform(-4, 4, 3)
    grid = Grid(values.min(axis=0), np.full(3, 0.3))
    rounding = 4 * np.finfo(float).eps * np.abs(values).max(axis=0)
    assert (np.abs(grid.values(grid.codes(values)) - values) <= grid.step / 2 + rounding).all()


def ellipsoids(quats, scales):
    """R S R^T, [N, 3, 3]."""
    turns = Rotation.from_quat(np.roll(quats, -1, axis=1)).as_matrix()
    return turns * scales[:, None, :] @ turns.transpose(0, 2, 1)


@given(seed=st.integers(0, 99))
def test_the_nearest_turn_draws_the_same_ellipsoid(seed):
    random = np.random.default_rng(seed)
    quats = random.normal(size=(200, 4)) * 10.0 ** random.uniform(-3, 3, (200, 1))
    quats[:24] = OCTAHEDRAL
    scales = random.normal(size=(200, 3))
    turned, permuted = nearest_turn(quats, scales)
    assert np.allclose(np.linalg.norm(turned, axis=1), 1.0) and (turned[:, 0] > NEAR).all()
    assert np.allclose(ellipsoids(turned, permuted), ellipsoids(quats, scales), atol=1e-9)
    again, same = nearest_turn(turned, permuted)
    assert np.allclose(again, turned) and (same == permuted).all()


def test_every_number_comes_back_within_half_a_step(tmp_path):
    one = field()
    decoded = through_a_file(one, tmp_path)
    read = decoded.splats
    rows = torch.cdist(read["means"].double(), one.splats["means"].double()).argmin(dim=1)
    assert len(rows.unique()) == len(rows) == 60
    truth = {name: value[rows] for name, value in one.splats.items()}
    quats, scales = nearest_turn(truth["quats"].double().numpy(), truth["scales"].double().numpy())
    truth |= {"quats": torch.from_numpy(quats).float(), "scales": torch.from_numpy(scales).float()}
    # Half a step, and float32's rounding of numbers below 16: 2^-20.
    rounding, median = 2.0**-20, one.splats["scales"].mean(dim=1).median().exp().item()
    assert (read["means"] - truth["means"]).abs().max() <= STEPS["means"] * median / 2 + rounding
    assert (read["scales"] - truth["scales"]).abs().max() <= STEPS["scales"] / 2 + rounding
    cut = truth["opacities"].clamp(-LARGEST_LOGIT, LARGEST_LOGIT)
    assert (read["opacities"] - cut).abs().max() <= STEPS["opacities"] / 2 + rounding
    drawn = base_colors(truth["features_dc"])
    assert (base_colors(read["features_dc"]) - drawn).abs().max() <= STEPS["colors"] / 2 + rounding
    spread = one.splats["latents"].double().std(dim=0, correction=0).max().item()
    off = (read["latents"] - truth["latents"]).abs().max()
    assert STEPS["latents"] * spread / 8 < off <= STEPS["latents"] * spread / 2 + rounding
    assert (read["quats"] - truth["quats"])[:, 1:].abs().max() <= STEPS["turns"] / 2 + rounding
    assert_close(read["quats"].norm(dim=1), torch.ones(60))
    for name, weight in one.head.state_dict().items():
        assert_close(decoded.weights[name], weight, rtol=2**-11, atol=2**-25)  # float16, subnormal below 2^-14
    assert decoded.config == replace(one.head.config, opacity_bound=one.head.config.bound)


def test_splats_are_in_morton_order_and_the_file_is_small(tmp_path):
    decoded = through_a_file(field(3000), tmp_path)
    grid = Grid(*(np.array(decoded.header["grids"]["means"][part]) for part in ("low", "step")))
    assert (np.diff(morton(grid.codes(decoded.splats["means"].double().numpy())).astype(np.int64)) >= 0).all()
    assert (tmp_path / "f.nrf").stat().st_size < 248 * 3000 / 10, "random splats already take a tenth of a PLY file"


def test_splats_that_are_not_finite_are_left_out_and_huge_ones_written(tmp_path):
    one = field()
    one.splats["features_dc"][7], one.splats["latents"][9], one.splats["scales"][11] = 1e30, -1e30, -800.0
    assert len(through_a_file(one, tmp_path).splats["means"]) == 60
    one.splats["means"][3, 1] = math.nan
    one.splats["quats"][5] = 0.0
    one.splats["scales"][7, 0] = math.inf
    assert len(through_a_file(one, tmp_path).splats["means"]) == 57
    one.splats["opacities"][:] = math.nan
    with pytest.raises(InputError, match="None of the 60"):
        through_a_file(one, tmp_path)


def test_large_weights_and_a_lone_splat(tmp_path):
    one = field(1)
    one.head.low[0].weight[0, 0] = 1e6  # beyond float16
    decoded = through_a_file(one, tmp_path)
    assert decoded.weights["low.0.weight"][0, 0] == 1e6
    assert_close(decoded.splats["means"], one.splats["means"])


def test_a_file_alone_is_in_its_own_unit_of_length(tmp_path):
    one = field()
    one.head.scene_unit = 32.0
    header, streams = encode(one, {"rasterize_mode": "classic", "background": [0, 0, 0]})
    write_container(tmp_path / "f.nrf", header, streams)
    model = load_file(tmp_path / "f.nrf")
    rows, center = torch.arange(60), torch.tensor([40.0, 0.0, 0.0])
    expected = build(one.head.config, model.head.state_dict(), 32.0)(model.field.splats, rows, center)
    assert_close(model.field.head(model.field.splats, rows, center), expected)
    assert model.projection_options.near_plane == 0.32, "the near plane is in scene units"
    header["render"]["near_plane"] = 2.5
    write_container(tmp_path / "f.nrf", header, streams)
    assert load_file(tmp_path / "f.nrf").projection_options.near_plane == 2.5, "of the training, in world units"
    write_container(tmp_path / "f.nrf", {**header, "render": {"rasterize_mode": "classic"}}, streams)
    with pytest.raises(InputError, match="render has not the keys rasterize_mode, background"):
        load_file(tmp_path / "f.nrf")


def compact(config: Path, output: Path, *words: str) -> dict:
    """What `nrfgs export compact` reports of the file that it writes."""
    report = output.with_suffix(".json")
    torch.manual_seed(0)
    words = ["compact", "--load-config", str(config), "--output", str(output), "--report", str(report), *words]
    tyro.cli(Export, args=words).main()
    return json.loads(report.read_text())


@pytest.fixture(scope="module")
def exported(tiny_scene, tmp_path_factory):
    """config.yml of an 8-step training with a loud field, the compact file, and the report."""
    out = tmp_path_factory.mktemp("runs")
    options = {
        "--pipeline.model.appearance.output-init": "default",
        "--pipeline.model.warmup-steps": 0,
        "--pipeline.model.appearance.latent-dim": 8,
        "--pipeline.model.camera-optimizer.mode": "SO3xR3",  # its poses are no part of the file
    }
    config = trained(command_line("nrfgs", tiny_scene, out, 8, options))
    return config, out / "small.nrf", compact(config, out / "small.nrf")


def test_ns_eval_reads_the_file(exported, tmp_path):
    _, file, numbers = exported
    config = file.parent / "small.nrf.nerfstudio" / "nrfgs" / "compact" / "config.yml"
    results = evaluate(config, tmp_path / "eval.json")
    assert results["splats"] == numbers["written"]
    # The same pictures, measured by two pieces of code in float32.
    assert results["psnr"] == pytest.approx(numbers["psnr_file"], abs=1e-3)
    assert numbers["bytes"] == file.stat().st_size and numbers["ply_bytes"] == 248 * numbers["written"]
    assert numbers["loss_db"] == pytest.approx(numbers["psnr_model"] - numbers["psnr_file"])
    # Rounding alone: errors of 65 dB, in steps of 1/512 of white, against this model's of 16 dB.
    assert abs(numbers["loss_db"]) < 0.03 and numbers["written"] == numbers["splats"] and numbers["rank"] == 8
    spread = decode(file).splats["latents"].std(dim=0)
    assert (spread.diff() < 1e-3).all() and spread[0] > 1.5 * spread[-1], "principal components, the strongest first"


def test_ns_render_reads_the_file(exported, tmp_path, dataset_render):
    config = exported[1].with_suffix(".nrf.nerfstudio") / "nrfgs" / "compact" / "config.yml"
    dataset_render(load_config=config, output_path=tmp_path, image_format="png").main()
    assert len(list((tmp_path / "test" / "rgb").rglob("*.png"))) == 2


def test_the_files_config_is_read_from_any_folder(exported, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    compact(exported[0], Path("made/it.nrf"), "--no-measure")
    config = tmp_path / "made" / "it.nrf.nerfstudio" / "nrfgs" / "compact" / "config.yml"
    monkeypatch.chdir("/")
    assert read_config(config).get_checkpoint_dir() == config.parent / "nerfstudio_models", "nerfstudio looks there"
    load_model(config, "test")
    moved = (tmp_path / "made").rename(tmp_path / "moved")
    load_model(moved / config.relative_to(tmp_path / "made"), "test")
    with pytest.raises(InputError, match="is a compact file. Name the config.yml in .*it.nrf.nerfstudio"):
        load_model(moved / "it.nrf", "test")


def test_a_training_does_not_begin_with_a_compact_file(exported, tiny_scene, tmp_path):
    """It would have been ignored, or taken with the optimisers of other splats."""
    line = ["nrfgs", "--data", str(tiny_scene), "--output-dir", str(tmp_path), "--vis", "tensorboard"]
    with pytest.raises(InputError, match="pipeline.compact"):
        set_up([*line, "--pipeline.compact", str(exported[1])])


def test_a_model_is_trained_for_the_file(exported, tmp_path):
    """The dearer a byte, the coarser the steps and the smaller the tables; the pictures stay as good."""
    bytes_of, steps = {}, {}
    for rate in ("0", "3e-3"):
        found = compact(exported[0], tmp_path / f"{rate}.nrf", "--finetune", "120", "--rate", rate)
        bytes_of[rate] = sum(found["stream_bytes"][name] for name in ("means", "splats", "latents"))
        grids = decode(tmp_path / f"{rate}.nrf").header["grids"]
        steps[rate] = np.concatenate([grids[name]["step"] for name in ("means", "scales", "colors", "turns")])
        assert found["loss_db"] < 0.1, "it has been trained on"
    assert (steps["3e-3"] > 1.1 * steps["0"]).all()
    assert bytes_of["3e-3"] < 0.8 * bytes_of["0"]


def test_a_splat_without_a_rotation_is_left_out_of_a_fine_tune(exported):
    pipeline = load_model(exported[0], "test")
    pipeline.model.gauss_params["quats"].data[5] = 0.0
    one, _, _ = fine_tune(pipeline, 1, 0.0, lambda bits: None)
    assert 0 < len(one.splats["means"]) < pipeline.model.num_points and one.splats["quats"].isfinite().all()


def test_what_a_splat_is_worth_is_what_pictures_lose_without_it(exported):
    pipeline = load_model(exported[0], "test")
    model, one = pipeline.model, pipeline.model.field.detached()
    camera, batch = pipeline.datamanager.next_train(0)
    model.train()
    model.config.background_color = "black"
    torch.manual_seed(0)
    growth, _ = growth_without(model, one, [(camera, batch)] * 200)

    @torch.no_grad()
    def error(gates):
        view = model.project(camera, one.splats)
        seen = one.seen_from(view)
        outputs, _ = model.composite(view, seen._replace(opacities=seen.opacities * gates[view.visible]))
        return float((outputs["rgb"] - model.truth_of(batch, outputs["background"])).square().sum())

    ones = torch.ones(len(growth))
    found = torch.tensor([error(ones.index_fill(0, row, 0.0)) for row in growth.argsort()[[0, 1, -3, -2, -1]]])
    found = found / error(ones) - 1.0
    # 200 drawings: a standard deviation is at most sqrt(2 / 200) = 0.1 of the part that they estimate.
    assert_close(growth.sort().values[[0, 1, -3, -2, -1]], found, rtol=0.1, atol=0.02 * float(found.max()))


def test_splats_that_go_take_what_an_optimizer_knows_of_them_along():
    coded = CodedSplats(field().splats)
    optimizer = torch.optim.Adam([{"params": [table.values]} for table in coded.tables.values()])
    tables = coded(rounded=True)
    (coded.bits(tables).sum() + tables["means"].sum()).backward()
    optimizer.step()
    before = {name: (table.values, optimizer.state[table.values]["exp_avg"]) for name, table in coded.tables.items()}
    kept = torch.arange(60) % 3 > 0
    coded.keep(kept, optimizer)
    for name, table in coded.tables.items():
        values, moments = before[name]
        assert torch.equal(table.values, values[kept])
        assert torch.equal(optimizer.state[table.values]["exp_avg"], moments[kept])


def test_splats_in_a_plane_or_at_one_place_take_no_fewer_bits_than_none():
    """Their logarithm adapts the rate to a size."""
    means, steps = torch.rand(50, 3), torch.full((3,), 1e-3)
    assert 12 < bits_of_places(means * torch.tensor([1.0, 1.0, 0.0]), steps) < bits_of_places(means, steps) - 8
    assert bits_of_places(means[:1].expand(50, 3), steps) == 0


def test_what_training_expects_is_what_a_file_has(tmp_path):
    torch.manual_seed(0)
    values = torch.distributions.Laplace(0.0, torch.tensor([0.1, 1.0, 3.0])).sample((20_000,))
    table, density = Rounded(values, torch.tensor([0.1, 0.25, 0.5])), Density(values)
    optimizer = torch.optim.Adam(density.parameters(), lr=0.02)
    for _ in range(150):
        optimizer.zero_grad()
        density.bits(table(rounded=True), table.steps).sum().backward()
        optimizer.step()
    with torch.no_grad():
        rounded = table(rounded=True)
        expected = float(density.bits(rounded, table.steps).sum()) / 8
        codes = (rounded / table.steps).round().long().numpy()
        means = Rounded(torch.rand(20_000, 3) * torch.tensor([1.0, 5.0, 0.2]), torch.full((3,), 1e-3))
        of_places = 20_000 * float(bits_of_places(means(rounded=True), means.steps)) / 8
    _, words = encode_table(codes.T)
    assert expected == pytest.approx(len(words), rel=0.02)
    one = field(1)
    rows = {name: value.expand(20_000, -1) for name, value in one.splats.items()}
    splats = {**rows, "means": means(rounded=True).detach()}
    steps = {name: np.ones(n) for name, n in (("turns", 3), ("scales", 3), ("opacities", 1), ("colors", 3))}
    steps |= {"latents": np.ones(8), "means": means.steps.detach().double().numpy()}
    write_container(tmp_path / "f.nrf", *encode(Field(one.head, splats), RENDER, steps))
    entries = read_container((tmp_path / "f.nrf").read_bytes())[0]["streams"]
    assert of_places == pytest.approx({entry["name"]: entry["bytes"] for entry in entries}["means"], rel=0.03)


@pytest.mark.parametrize("words, shares", [("", (0.95, 0.8)), ("--finetune 120", (0.8,))])
def test_a_size_is_reached_and_not_exceeded(words, shares, exported, tmp_path, capsys):
    config, file, _ = exported
    for share in shares:
        limit, output = share * file.stat().st_size, tmp_path / f"{share}.nrf"
        found = compact(config, output, *words.split(), "--size-mb", str(limit / 1e6))
        assert 0.95 * limit <= found["bytes"] == output.stat().st_size <= limit
        assert "Encoding, attempt 1" in capsys.readouterr().out
    if not words:
        assert found["coarser"] > 1 and found["rate"] is None
    assert found["loss_db"] < 1.0


@pytest.mark.parametrize("name", ["page.html", "folder"])
def test_a_page_reaches_its_size_with_all_that_is_in_it(name, exported, tmp_path):
    def written(output: Path, *options: str) -> int:
        line = ["web", "--load-config", str(exported[0]), "--output", str(output), "--no-measure", *options]
        tyro.cli(Export, args=line).main()
        return output.stat().st_size if output.is_file() else sum(path.stat().st_size for path in output.iterdir())

    limit = written(tmp_path / "plain" / name) - 1000
    assert 0.95 * limit <= written(tmp_path / name, "--size-mb", str(limit / 1e6)) <= limit


def test_a_size_that_is_too_small_is_refused_with_the_smallest_and_so_are_other_options(exported, tmp_path):
    words = ["compact", "--load-config", str(exported[0]), "--output", str(tmp_path / "x.nrf"), "--no-measure"]
    for options, said in (
        ("--size-mb 1e-4", "the smallest output of this model has 0.0"),
        ("--size-mb 1e-4 --finetune 10", "the smallest output"),
        ("--size-mb 0", "must be positive"),
        ("--size-mb nan", "must be"),
        ("--finetune -1", "--finetune is -1"),
        ("--rate nan", "--rate is nan"),
        ("--rate 10 --finetune 20", "smaller --rate"),
    ):
        with pytest.raises(InputError, match=said):
            tyro.cli(Export, args=[*words, *options.split()]).main()
    tyro.cli(Export, args=[*words, "--size-mb", "50"]).main()
    assert (tmp_path / "x.nrf").stat().st_size < 1e6, "a file that is small enough stays as precise as it is"
