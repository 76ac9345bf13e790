# SPDX-License-Identifier: Apache-2.0
"""Trainings on two devices: shards grow, checkpoints are whole, all stop together."""

from pathlib import Path

import pytest
import torch
from torch.testing import assert_close

from nrfgs_ns.densification import CHANGE
from nrfgs_ns.densification.error_guided import ERROR, WIDTH
from nrfgs_ns.densification.strategy import CHANGE_BEFORE
from nrfgs_ns.training.checkpoint_files import read, read_latest


def checkpoint(folder: str | Path) -> dict:
    return read_latest(Path(folder))[1]


def splats_of(content: dict) -> dict[str, torch.Tensor]:
    prefix = "_model.gauss_params."
    state = content["pipeline"]
    return {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}


def test_thirty_steps_densify_and_stay_finite(two_devices):
    first, second = (torch.load(two_devices / f"thirty-{rank}.pt") for rank in (0, 1))
    start, end = first["counts"][0], first["counts"][-1]
    assert [step for step, *_ in first["counts"]] == list(range(30))
    assert sum(start[2]) == 300 < sum(end[2]), "nothing was densified"
    grown = 0
    for (step, mine, of_all), (_, theirs, of_all_there) in zip(first["counts"], second["counts"], strict=True):
        assert of_all == of_all_there == [mine, theirs], step
        grown += sum(of_all) != 300
    assert grown > 10
    for name, value in first["shared"].items():
        assert torch.equal(value, second["shared"][name]), "shared weights have come apart"
    content = checkpoint(first["saved"])
    assert content["step"] == 29
    for name, value in splats_of(content).items():
        assert len(value) == sum(end[2]) and torch.isfinite(value).all(), name
        (moments,) = content["optimizers"][name]["state"].values()
        assert moments["exp_avg"].shape == moments["exp_avg_sq"].shape == value.shape
        assert int(moments["step"]) == 30
        assert (moments["exp_avg"] != 0).any()


def test_checkpoints_go_from_two_devices_to_one_and_to_two(two_devices):
    """What each training holds after loading is what the one before had written, row for row."""
    of_two, of_one, again = (checkpoint(path) for path in torch.load(two_devices / "there-and-back.pt"))
    held = [torch.load(two_devices / "one-0.pt")]
    agree_with(of_two, held, [slice(None)])
    held = [torch.load(two_devices / f"two-{rank}.pt") for rank in (0, 1)]
    agree_with(of_one, held, [slice(0, None, 2), slice(1, None, 2)])
    assert [content["step"] for content in (of_two, of_one, again)] == [5, 11, 17]
    assert len(splats_of(again)["means"]) != len(splats_of(of_two)["means"])
    assert again["optimizers"].keys() == of_one["optimizers"].keys()
    assert of_one["pipeline"].keys() == again["pipeline"].keys()


def agree_with(content: dict, held: list[dict], rows: list[slice]) -> None:
    statistics = content["pipeline"]["_model._extra_state"]["strategy"]
    for device, part in zip(held, rows, strict=True):
        assert device["same"], "an optimiser holds orphans"
        for name, value in splats_of(content).items():
            assert torch.equal(device["splats"][name], value[part]), name
            (moments,) = content["optimizers"][name]["state"].values()
            assert torch.equal(device["moments"][name], moments["exp_avg_sq"][part]), name
        for name in (ERROR, WIDTH, CHANGE, CHANGE_BEFORE):
            assert torch.equal(device["statistics"][name], statistics[name][part]), name
        assert device["sampling"] == content["pipeline"]["_extra_state"]["sampling"]["unseen_cameras"]


def test_both_devices_report_what_one_process_would(two_devices):
    """The same splats in the same order, up to float32: 1e-4 of a metric is 100 times what rounding may do to a mean
    over pixels, and less than a thousandth of what one missing shard would."""
    (first, alone), (second,) = (torch.load(two_devices / f"scores-{rank}.pt") for rank in (0, 1))
    # A device asks its head about a splat once for each camera, in two rows of one table. Vectorised functions round
    # the last rows of a table otherwise than those before: one unit of an opacity, 3e-8, was seen, 4e-7 of a pixel.
    assert first.keys() == second.keys()
    assert first == pytest.approx(second, rel=1e-6)
    for name in ("splats", "parameter_bytes"):
        assert first[name] == second[name] == alone[name], name
    assert first.keys() == alone.keys() >= {"psnr", "ssim", "l1"}
    for name in ("psnr", "ssim", "l1"):
        assert first[name] == pytest.approx(alone[name], rel=1e-4), name


def test_one_device_s_nan_stops_all_with_its_message_and_so_do_splats_that_are_gone(two_devices):
    first, second = (torch.load(two_devices / f"stopped-{rank}.pt") for rank in (0, 1))
    assert first == second
    assert first[0].startswith("On device 1 of 2: Training stopped at step 7: loss main_loss has NaN")
    assert first[1].startswith("No splat is left in step 11: all were pruned")
    content = checkpoint(next((two_devices / "stopped").rglob("nerfstudio_models")))
    assert content["step"] == 7
    assert all(torch.isfinite(value).all() for value in splats_of(content).values())


def test_memory_that_one_device_lacks_holds_growth_on_all(two_devices):
    first, second = (torch.load(two_devices / f"held-{rank}.pt") for rank in (0, 1))
    assert first["held"] == second["held"] == (second["counts"][0], 0)
    for device in (first, second):
        assert max(device["counts"]) == device["counts"][0]


SPLATS = "gauss_params."


@pytest.fixture(scope="module")
def devices(two_devices) -> tuple[dict, dict]:
    return tuple(torch.load(two_devices / f"averaged-{rank}.pt") for rank in (0, 1))


def saved(folder: str | Path, step: int, part: str = "pipeline") -> dict:
    return read(Path(folder) / f"step-{step:09d}.ckpt")[part]


def whole_after(devices: tuple[dict, dict], step: int) -> dict[str, torch.Tensor]:
    """All parameters after a step, as one device would hold them, in float64."""
    one, other = (device["after"][step] for device in devices)
    rows = {name: torch.cat([value, other[name]]) if name.startswith(SPLATS) else value for name, value in one.items()}
    return {name: value.double() for name, value in rows.items()}


def test_all_begin_anew_where_one_does_and_share_weights_and_exposures(devices):
    splats = [[len(after[f"{SPLATS}means"]) for after in device["after"]] for device in devices]
    assert set(splats[0]) == {150} and set(splats[1][:4]) == {150} and set(splats[1][4:]) != {150}
    assert devices[0]["counts"] == devices[1]["counts"] == [0, 0, 1, 2, 1, 2, 3, 4, 5, 6, 7, 8]
    assert "over the last 8 steps." in devices[0]["said"] and devices[1]["said"] == ""
    first, second = (device["ended"] for device in devices)
    assert all(torch.equal(value, second[name]) for name, value in first.items() if not name.startswith(SPLATS))
    first, second = (device["exposures"] for device in devices)
    assert torch.equal(first, second)
    assert (first != 0).any() and first.mean(dim=0).abs().max() < 1e-6


def test_the_trained_model_is_the_mean_of_the_whole(devices):
    """Parameters are up to 10; eight float32 roundings of that, 8 * 10 * 6e-8."""
    expected = [whole_after(devices, step) for step in range(4, 12)]
    content = saved(devices[0]["saved"][0], 11)
    for name, last in expected[-1].items():
        mean = torch.stack([state[name] for state in expected]).mean(dim=0)
        assert mean.abs().max() <= 10
        assert_close(content[f"_model.{name}"].double(), mean, rtol=0, atol=5e-6, msg=lambda text, of=name: of + text)
        assert (mean - last).abs().max() > 1e-4, name
    assert "parameter_mean" not in saved(devices[0]["saved"][0], 11, "training")


def test_no_checkpoint_has_a_mean_and_what_goes_on_averages_its_own_steps(devices):
    assert "parameter_mean" not in saved(devices[0]["saved"][0], 7, "training")
    assert [device["resumed"] for device in devices] == [[1, 2, 3, 4]] * 2
