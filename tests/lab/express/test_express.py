# SPDX-License-Identifier: Apache-2.0
"""The expressiveness study: counts, models against the heads, fits with known answers, and the command."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch.testing import assert_close

from nrfgs_lab.express import models, plan, report
from nrfgs_lab.express.command import Express
from nrfgs_lab.express.fit import FitConfig, fit, least_squares, linear_bound, measure, psnr
from nrfgs_lab.express.reflectance import NETWORK_FILE, NUM_WEIGHTS, Btf, read_networks
from nrfgs_lab.express.targets import (
    SYNTHETIC_DEVIATION,
    Targets,
    fibonacci_sphere,
    from_btf,
    materials_by_gloss,
    measured_image,
    measured_pixels,
    random_cap,
    synthetic,
    ubo_views,
)
from nrfgs_ns.appearance.gsnb import GsnbConfig
from nrfgs_ns.appearance.head import SH_C0
from nrfgs_ns.appearance.nrf import NrfConfig
from nrfgs_ns.appearance.sg import SgConfig
from nrfgs_ns.appearance.spherical_harmonics import sh_bases
from nrfgs_ns.cli import chosen
from nrfgs_ns.errors import InputError


def test_counts_are_the_papers():
    sh, field = models.Harmonics(), models.Field()
    assert (sh.count(328), field.count(328)) == (15_744, 15_707)
    assert (sh.count(160_000), field.count(160_000)) == (7_680_000, 5_604_227)
    assert field.num_shared() == 4227 and field.numbers_per_sample() == 35


@pytest.mark.parametrize("num_samples", [328, 160_000])
def test_models_keep_to_the_budget(num_samples):
    counts = {label: spec.build().count(num_samples) for label, spec in plan.models(num_samples).items()}
    budget = 48 * num_samples
    assert all(count <= budget for label, count in counts.items() if label != "gsnb")
    assert counts["gsnb"] == budget + 7760
    # Sizes are chosen to use the budget at 328 samples: whoever is chosen leaves less than a tenth of it.
    assert num_samples > 328 or all(count > 0.9 * budget for count in counts.values())


def test_a_wrong_count_is_refused():
    specs = plan.models(328)
    with pytest.raises(AssertionError):
        plan.check_counts(328, {**specs, "nrf": specs["nrf"].but(width=63)})
    with pytest.raises(AssertionError, match="nrf-split"):
        plan.check_counts(328, {**specs, "nrf-split": specs["nrf-split"].but(width=43)})


def on_grid(head, stored, directions):
    """A head's colours [S, D, 3], its splats at the origin and its cameras at `directions`."""
    count = len(stored["features_dc"])
    splats = {"means": torch.zeros(count, 3), "opacities": torch.zeros(count, 1), **stored}
    rows = torch.arange(count).repeat_interleave(len(directions))
    return head(splats, rows, directions.repeat(count, 1)).colors.view(count, len(directions), 3)


def randomise(samples):
    generator = torch.Generator().manual_seed(9)
    return {name: tensor + 0.1 * torch.randn(tensor.shape, generator=generator) for name, tensor in samples.items()}


# float32 sums of at most 100 terms of order 1: a few 1e-6.
CLOSE = {"rtol": 0, "atol": 1e-5}


@torch.no_grad()
@pytest.mark.parametrize("bands", [1, 3])
def test_split_field_is_the_heads(bands):
    torch.manual_seed(0)
    config = NrfConfig(num_bands=bands, use_distance=False, opacity_residual=False, output_init="default")
    head, model = config.setup(), models.SplitField(bands=max(bands, 2), zero_output=False)
    own = slice(0, 35)
    weight = head.low[0].weight  # (z, c, alpha, low); the constant alpha counts as a bias
    model.low[0].weight[:, own], model.low[0].weight[:, 35:] = weight[:, own], weight[:, 36:]
    model.low[0].bias[:] = head.low[0].bias + 0.5 * weight[:, 35]
    model.low[2].load_state_dict(head.low[2].state_dict())
    if bands == 1:
        models.zero(model.high)
    else:
        model.bands = bands
        model.high = head.high
    samples = randomise(model.start(torch.rand(5, 3) * 0.4 + 0.3, torch.Generator().manual_seed(1)))
    stored = {"features_dc": (samples["base"] - 0.5) / SH_C0, "latents": samples["latents"]}
    directions = fibonacci_sphere(11)
    assert_close(model(samples, directions).clamp_min(0.0), on_grid(head, stored, directions), **CLOSE)


@torch.no_grad()
def test_lobes_are_the_heads():
    head, model = SgConfig(lobes=4).setup(), models.Lobes(lobes=4)
    samples = randomise(model.start(torch.rand(5, 3), torch.Generator()))
    directions = fibonacci_sphere(11)
    stored = {"features_dc": (samples["base"] - 0.5) / SH_C0, "sg_axes": -samples["axes"]}  # the head looks inward
    stored |= {"sg_sharpness": samples["sharpness"], "sg_colors": samples["colors"]}
    assert_close(model(samples, directions).clamp_min(0.0), on_grid(head, stored, directions), **CLOSE)


@torch.no_grad()
def test_learnt_basis_is_the_heads():
    torch.manual_seed(0)
    head, model = GsnbConfig().setup(), models.LearntBasis()
    model.network.load_state_dict(dict(zip(model.network.state_dict(), head.basis.state_dict().values(), strict=True)))
    samples = randomise(model.start(torch.rand(5, 3), torch.Generator()))
    directions = fibonacci_sphere(11)
    stored = {"features_dc": samples["coefficients"][:, 0], "features_rest": samples["coefficients"][:, 1:]}
    # The head looks from the camera: the same directions reversed.
    assert_close(model(samples, directions).clamp_min(0.0), on_grid(head, stored, -directions), **CLOSE)
    model.set_progress(0.0)
    assert_close(model(samples, directions), models.Harmonics()(samples, directions))


@torch.no_grad()
def test_field_and_factors_are_their_formulas_pair_by_pair():
    torch.manual_seed(0)
    directions = fibonacci_sphere(7)
    for model in (models.Field(), models.Field(bound=0.2), models.FactoredHarmonics()):
        samples = randomise(model.start(torch.rand(5, 3), torch.Generator().manual_seed(1)))
        got = model(samples, directions)
        for s in range(5):
            for d in range(7):
                direction = directions[d : d + 1]
                if isinstance(model, models.Field):
                    waves = [direction]
                    for band in range(4):
                        angle = math.pi * 2**band * direction
                        waves += [angle.sin(), angle.cos()]
                    inputs = torch.cat([samples["latents"][s : s + 1], samples["base"][s : s + 1], *waves], dim=-1)
                    out = model.network(inputs)[0]
                    expected = samples["base"][s] + (out if model.bound is None else 0.2 * out.tanh())
                else:
                    inputs = torch.cat([samples["features"][s : s + 1], direction], dim=-1)
                    factors = model.network(inputs).sigmoid().view(9, 3)
                    expected = 0.5 + (sh_bases(2, direction)[0] @ (factors * samples["coefficients"][s]))
                assert_close(got[s, d], expected, **CLOSE)


def test_models_start_from_the_mean_colour():
    mean = torch.rand(6, 3)
    for spec in plan.models(328).values():
        torch.manual_seed(0)
        model = spec.build()
        model.set_progress(0.0)
        colors = model(model.start(mean, torch.Generator().manual_seed(0)), fibonacci_sphere(50))
        # A network with torch's own start adds something small, and factors are near a half, not at it.
        assert (colors.mean(dim=1) - mean).abs().max() < 0.35


def test_least_squares_recovers_harmonics_of_degree_three():
    targets = synthetic(0, samples=20, degree=3)
    measured = measure(least_squares(targets), targets)
    # float32 colours of order 1 carry errors of 1e-7 or so: 120 dB and more; 100 leaves room for the sums.
    assert measured["train_psnr"] > 100 and measured["held_out_psnr"] > 100


BEST = psnr((9 + 11) * SYNTHETIC_DEVIATION**2 / (4 * math.pi))
"""What harmonics of degree 3 reach: each of those of degrees 4 and 5 has the mean square 1 / (4 pi) on the sphere."""


def test_floor_of_degree_three_is_the_energy_of_degrees_four_and_five():
    count = 328 * 20 * 3
    targets = synthetic(0, directions=400)
    # The mean of `count` squares of normal numbers has a relative deviation of sqrt(2 / count), in dB times 10 / ln 10;
    # four of them, and as much again for 400 directions instead of the sphere.
    tolerance = 8 * (10 / math.log(10)) * math.sqrt(2 / count)
    assert tolerance < 0.4
    measured = measure(least_squares(targets), targets)
    assert abs(measured["train_psnr"] - BEST) < tolerance
    assert abs(measured["held_out_psnr"] - BEST) < tolerance


def test_adam_reaches_the_optimum_of_harmonics():
    targets = synthetic(1, samples=30)
    optimum = measure(least_squares(targets), targets)["train_psnr"]
    reached = fit(models.Harmonics, targets, FitConfig(passes=200, sample_lr=0.03), 0)
    # A convex problem: within a hundredth of a dB, and never above.
    assert optimum - 0.01 < measure(reached, targets)["train_psnr"] < optimum + 1e-4


def constant_psnr(targets):
    return psnr((targets.colors - targets.colors.mean(dim=1, keepdim=True)).square().mean().item())


@pytest.mark.parametrize("label", ["nrf", "nrf-bounded", "nrf-split", "sg", "gsnb-small", "vdgs-like"])
def test_a_small_fit_beats_constants_and_is_reproducible(label):
    targets = synthetic(2, samples=40, degree=2, factors=4, deviation=0.1)
    config = FitConfig(passes=60, sample_lr=0.03, block=20)
    build = plan.models(328)[label].build
    first, second = fit(build, targets, config, 5), fit(build, targets, config, 5)
    measured = measure(first, targets)
    # Degree 2 with four factors is within reach of every model; 3 dB is half of the square error.
    assert measured["train_psnr"] > constant_psnr(targets) + 3.0
    assert measured == measure(second, targets)


def test_progress_counts_steps():
    steps = []
    fit(models.Harmonics, synthetic(0, samples=45), FitConfig(passes=3, block=20), 0, lambda: steps.append(1))
    assert len(steps) == 9 == FitConfig(passes=3, block=20).steps(45)


def test_linear_bound_is_the_energy_outside_the_principal_components():
    targets = synthetic(0, samples=200, factors=6)
    assert linear_bound(targets, 6) > 80  # six factors, six numbers: nothing is left but rounding
    rows = targets.colors.flatten(1).double().numpy()
    values = np.linalg.svd(rows - rows.mean(axis=0), compute_uv=False)
    assert_close(linear_bound(targets, 3), psnr((values[3:] ** 2).sum() / rows.size))


FLOOR = {"samples": 328, "directions": 200}


@pytest.mark.parametrize("what", ["decaying", "degrees-4-and-5", "degree-5", "lobe", "grey-lobe"])
def test_altered_targets_leave_harmonics_where_they_are(what):
    plain = synthetic(0, **FLOOR)
    altered = synthetic(0, **FLOOR, **plan.TARGET_CHANGES["synthetic"][what])
    reached = [measure(least_squares(targets), targets)["train_psnr"] for targets in (plain, altered)]
    # The altered ones have exactly the energy that `test_floor_...` expects of the plain ones within 0.4 dB at worst.
    assert reached[1] == pytest.approx(reached[0], abs=0.4)
    assert reached[1] == pytest.approx(BEST, abs=0.4)


def test_altered_targets_have_the_dimensions_that_they_say():
    def dimensions(**changes):
        targets = synthetic(0, samples=150, directions=200, held_out=5, **changes)
        rows = targets.colors.flatten(1).double()
        values = torch.linalg.svdvals(rows - rows.mean(dim=0))
        return int((values > 1e-4 * values[0]).sum())  # float32 colours: noise at 1e-7 of the largest

    changes = plan.TARGET_CHANGES["synthetic"]
    assert dimensions() == 3 * 36
    assert dimensions(**changes["grey"]) == 36
    assert dimensions(**changes["degree-5"]) == 3 * 11
    assert dimensions(**changes["degrees-4-and-5"]) == 3 * 20
    assert dimensions(**changes["factors-8"]) == 8
    assert dimensions(**changes["grey-lobe"]) == 36  # few numbers describe a lobe, but no linear code knows


def test_scattered_directions_are_neither_even_nor_the_held_out_ones():
    targets = synthetic(0, samples=2, directions=50, held_out=50, scattered=True)
    assert not torch.equal(targets.directions, fibonacci_sphere(50))
    assert (targets.directions @ targets.held_out_directions.T).max() < 1 - 1e-6


def test_variations_are_named_in_the_report():
    spec, fit_config = plan.ModelSpec("field"), FitConfig()
    for setup in ("synthetic", "pixels", "image"):
        for cell in plan.variation_cells(setup, spec, fit_config, 0, {}):
            assert cell.name == f"{setup}-vary-{cell.label}-seed0"
            assert any(cell.label == f"{model}-{what}" for model in ("sh-lsq", "linear", "nrf", "nrf-more")
                       for what in report.CHANGES if what)  # fmt: skip


def test_psnr_pools_and_clamps():
    colors = torch.zeros(3, 2, 3)
    targets = Targets(fibonacci_sphere(2), colors, fibonacci_sphere(2), colors)
    fitted = least_squares(replace(targets, colors=colors - 0.1))
    measured = measure(fitted, targets, block=2)
    assert measured["train_psnr"] == pytest.approx(20.0, abs=1e-3)  # 0.1 below everywhere: 10 log10(1 / 0.01)
    assert measured["train_psnr_clamped"] == 120.0


def test_directions_are_spread_as_they_say():
    for cap, mean_height in ((180.0, 0.0), (60.0, 0.75)):
        for directions in (fibonacci_sphere(500, cap), random_cap(4000, cap, torch.Generator().manual_seed(0))):
            assert_close(directions.norm(dim=-1), torch.ones(len(directions)))
            assert directions[:, 2].min() >= math.cos(math.radians(cap)) - 1e-6
            # Heights are uniform: deviation of the mean is range / sqrt(12 n), here at most 2 / sqrt(12 * 4000); four.
            assert abs(directions[:, 2].mean() - mean_height) < 0.037
    views = ubo_views()
    assert views.shape == (81, 3) and len(views.mul(1e4).round().unique(dim=0)) == 81
    assert (views[:, 2] > 0.25).all()


@pytest.fixture
def networks_folder(tmp_path):
    weights = np.random.default_rng(0).normal(0, 0.3, (3, NUM_WEIGHTS)).astype(np.float32)
    np.savez(tmp_path / NETWORK_FILE, names=np.array(["a", "b", "c"]), weights=weights)
    return tmp_path


@pytest.fixture
def networks(networks_folder):
    return read_networks(networks_folder)


def test_measured_samples_are_fixed_by_their_seed(networks):
    for make, sizes in ((measured_pixels, {"samples": 12}), (measured_image, {"side": 9, "cells": 5})):
        first, again, other = (make(networks, seed, held_out=10, **sizes) for seed in (0, 0, 1))
        assert torch.equal(first.colors, again.colors) and torch.equal(first.held_out_colors, again.held_out_colors)
        assert not torch.equal(first.colors, other.colors)
        assert first.colors.shape == (len(first), 81, 3) and first.held_out_colors.shape == (len(first), 10, 3)
        assert (first.colors >= 0).all() and (first.colors <= 1 + 1e-6).all()
        assert first.colors.var(dim=1).max() > 0


def test_materials_are_ranked_by_how_much_they_change(networks):
    weights = networks.weights.clone()
    weights[1] = 0.0
    weights[1, -3:] = 0.2  # the last bias alone: the same BRDF everywhere
    still = replace(networks, weights=weights)
    assert materials_by_gloss(still, 0.0, 0.0).tolist() == [1]
    assert materials_by_gloss(still, 0.0, 1.0).tolist() == [0, 1, 2]
    assert 1 not in materials_by_gloss(still, 0.5, 1.0).tolist()
    targets = measured_pixels(still, 0, samples=9, held_out=5, gloss=(0.0, 0.0))
    # That material has no highlight: what changes is rounding.
    assert targets.colors.var(dim=1).max() < 1e-9


def test_photographs_hold_every_fifth_view_out():
    images = torch.arange(11.0)[:, None, None, None].expand(11, 6, 4, 3) / 20
    btf = Btf([(i, 0) for i in range(11)], fibonacci_sphere(11), images)
    targets = from_btf(btf, 1, samples=7)
    assert targets.colors.shape == (7, 9, 3) and targets.held_out_colors.shape == (7, 2, 3)
    assert_close(targets.held_out_colors[0, :, 0], torch.tensor([1.0, 6.0]) / 20)
    assert_close(targets.held_out_directions, btf.directions[[1, 6]])
    assert len(from_btf(btf, 0, side=400)) == 16
    with pytest.raises(ValueError, match="24 texels, but 25"):
        from_btf(btf, 0, samples=25)
    with pytest.raises(ValueError, match="4 views"):
        from_btf(Btf(btf.views[:4], btf.directions[:4], images[:4]), 0)


def test_deviation_over_seeds_is_the_samples(tmp_path):
    def record(seed, value):
        cell = plan.main_cell("synthetic", "sh", plan.ModelSpec("harmonics"), FitConfig(), seed)
        return {"name": cell.name, "settings": json.loads(json.dumps(cell.settings())), "train_psnr": value} | {
            "parameters": 15_744,
            "machine": {},
        }

    summary = report.summarise([record(0, 20.0), record(1, 22.0), record(2, 24.0)])
    assert summary["table"][0]["train_psnr"] == {"mean": 22.0, "deviation": 2.0}
    assert "| synthetic | SH degree 3, Adam | 15,744 | 3 | 22.00 ± 2.00 | - | 21.1 |" in report.markdown(summary)


def test_the_command_measures_once_and_resumes(tmp_path, capsys):
    out = tmp_path / "out"
    chosen(["express", "--out", str(out), "--quick", "--passes", "1"]).main()
    assert "only the synthetic set-up is run" in " ".join(capsys.readouterr().out.split())
    runs = sorted((out / "runs").glob("*.json"))
    rows = {row["model"]: row for row in json.loads((out / "summary.json").read_text())["table"]}
    assert set(rows) == set(report.ROWS)
    assert rows["nrf"]["parameters"] == 128 * 35 + 4227 and rows["sh"]["parameters"] == 128 * 48
    assert (out / "express-samples.png").exists() and (out / "express-sweep.png").exists()
    assert str(tmp_path) not in "".join(path.read_text() for path in runs)

    # One record is lost, one is of other settings, one is altered by hand: the last alone is believed.
    runs[0].unlink()
    other = json.loads(runs[1].read_text())
    other["settings"]["seed"] = 77
    runs[1].write_text(json.dumps(other))
    kept = json.loads(runs[2].read_text())
    runs[2].write_text(json.dumps({**kept, "seconds": 12345.0}))
    Express(out=out, quick=True, passes=1).main()
    assert runs[0].exists() and json.loads(runs[1].read_text())["settings"]["seed"] != 77
    assert json.loads(runs[2].read_text())["seconds"] == 12345.0


def test_the_command_runs_on_measured_reflectance(tmp_path, networks_folder):
    Express(out=tmp_path / "out", quick=True, passes=1, setups=("image",), reflectance=networks_folder).main()
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert {row["setup"] for row in summary["table"]} == {"image"}
    assert (tmp_path / "out" / "express-image.jpg").exists()


def test_the_command_runs_on_photographs(tmp_path):
    folder = tmp_path / "wool"
    folder.mkdir()
    generator = np.random.default_rng(0)
    for theta, phi in ((0, 0), (30, 0), (30, 120), (30, 240), (60, 0), (60, 180)):
        pixels = generator.integers(0, 256, (12, 12, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / f"00001 tl030 pl000 tv{theta:03d} pv{phi:03d}.png")
    Express(out=tmp_path / "out", quick=True, passes=1, setups=("pixels", "image"), btf=folder).main()
    record = json.loads((tmp_path / "out" / "runs" / "image-nrf-seed0.json").read_text())
    assert record["settings"]["source"] == {"kind": "photographs", "material": "wool", "light": [30, 0], "side": 12}
    assert (record["samples"], record["directions"], record["held_out_directions"]) == (144, 4, 2)
    assert record["parameters"] == 144 * 35 + 4227
    # Photographs have the directions and the material that they have; how the field is fitted can vary.
    varied = {path.stem for path in (tmp_path / "out" / "runs").glob("*-vary-*")}
    assert "pixels-vary-nrf-whole-batch-seed0" in varied and "image-vary-nrf-four-times-passes-seed0" in varied
    assert not [name for name in varied if "directions" in name or "material" in name or "matter" in name]


@pytest.mark.gpu
def test_a_gpu_starts_from_the_same_numbers_and_arrives_near_by():
    targets = synthetic(0, samples=40, degree=2)
    config = FitConfig(passes=20, block=20)
    on_cpu = measure(fit(models.Field, targets, config, 0), targets)
    on_gpu = measure(fit(models.Field, targets.to("cuda"), config, 0), targets.to("cuda"))
    # Forty steps from the same start: rounding has not led the two apart by a tenth of a decibel.
    assert on_gpu["train_psnr"] == pytest.approx(on_cpu["train_psnr"], abs=0.1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"setups": ("pixel",)}, "--setups has 'pixel'"),
        ({"reflectance": Path("a"), "btf": Path("b")}, "Give one"),
        ({"samples": 100}, "--samples is 100"),
        ({"seeds": ()}, "--seeds and --image-seeds must name at least one"),
        ({"setups": ("pixels",), "reflectance": Path("nowhere")}, "nbrdf_weights.npz does not exist"),
    ],
)
def test_bad_options_are_refused_before_anything_is_fitted(tmp_path, options, message):
    with pytest.raises(InputError, match=message):
        Express(out=tmp_path / "out", **options).main()
    assert not list(tmp_path.rglob("*.json"))
