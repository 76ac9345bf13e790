# SPDX-License-Identifier: Apache-2.0
"""Trainings on two devices: shards stay equal, checkpoints are whole, all stop together."""

from pathlib import Path

import pytest
import torch
from torch.testing import assert_close

from nrfgs_ns.densification import CHANGE
from nrfgs_ns.training.checkpoint_files import read_latest


def checkpoint(folder: str | Path) -> dict:
    return read_latest(Path(folder))[1]


def splats_of(content: dict) -> dict[str, torch.Tensor]:
    prefix = "_model.gauss_params."
    state = content["pipeline"]
    return {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}


def test_fifty_steps_densify_and_stay_finite_and_balanced(two_devices):
    first, second = (torch.load(two_devices / f"fifty-{rank}.pt") for rank in (0, 1))
    start, end = first["counts"][0], first["counts"][-1]
    assert [step for step, *_ in first["counts"]] == list(range(50))
    assert sum(start[2]) == 300 < sum(end[2]), "nothing was densified"
    grown = 0
    for (step, mine, of_all), (_, theirs, of_all_there) in zip(first["counts"], second["counts"], strict=True):
        assert of_all == of_all_there == [mine, theirs], step
        assert max(of_all) - min(of_all) <= 1, "shards were left apart"
        grown += sum(of_all) != 300
    assert grown > 10
    for name, value in first["shared"].items():
        assert torch.equal(value, second["shared"][name]), "shared weights have come apart"
    content = checkpoint(first["saved"])
    assert content["step"] == 49
    for name, value in splats_of(content).items():
        assert len(value) == sum(end[2]) and torch.isfinite(value).all(), name
        (moments,) = content["optimizers"][name]["state"].values()
        assert moments["exp_avg"].shape == moments["exp_avg_sq"].shape == value.shape
        assert int(moments["step"]) == 50
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
    """What devices hold are their rows of a checkpoint."""
    statistics = content["pipeline"]["_model._extra_state"]["strategy"]
    for device, part in zip(held, rows, strict=True):
        assert device["same"], "an optimiser holds orphans"
        for name, value in splats_of(content).items():
            assert torch.equal(device["splats"][name], value[part]), name
            (moments,) = content["optimizers"][name]["state"].values()
            assert torch.equal(device["moments"][name], moments["exp_avg_sq"][part]), name
        for name in ("grad2d", "count", "radii", CHANGE):
            assert torch.equal(device["statistics"][name], statistics[name][part]), name
        assert device["sampling"] == content["pipeline"]["_extra_state"]["sampling"]["unseen_cameras"]


def test_both_devices_report_what_one_process_would(two_devices):
    """The same splats in the same order, up to float32: 1e-4 of a metric is 100 times what rounding may do to a mean
    over pixels, and less than a thousandth of what one missing shard would."""
    (first, alone), (second,) = (torch.load(two_devices / f"scores-{rank}.pt") for rank in (0, 1))
    # The colour fit sums over all pixels in float64, in an order that depends on where memory begins; in float32,
    # a colour may differ by one unit, 6e-8, and so may a mean of them.
    assert {name: value for name, value in first.items() if not name.startswith("cc_")} == {
        name: value for name, value in second.items() if not name.startswith("cc_")
    }
    assert first == pytest.approx(second, rel=1e-6)
    assert first["splats"] == alone["splats"] and first["parameter_bytes"] == alone["parameter_bytes"]
    assert first.keys() == alone.keys() >= {"psnr", "ssim", "l1"}
    for name in ("psnr", "ssim", "l1"):
        assert first[name] == pytest.approx(alone[name], rel=1e-4), name


def test_one_device_s_nan_stops_all_with_its_message(two_devices):
    first, second = (torch.load(two_devices / f"stopped-{rank}.pt") for rank in (0, 1))
    assert first == second
    assert first.startswith("On device 1 of 2: Training stopped at step 7: loss main_loss has NaN")
    content = checkpoint(next((two_devices / "stopped").rglob("nerfstudio_models")))
    assert content["step"] == 7
    assert all(torch.isfinite(value).all() for value in splats_of(content).values())


@pytest.mark.slow
def test_a_resumed_training_is_the_unbroken_one(run_together):
    """With as many devices, random splits and moves between shards included. The same machine adds the same numbers in
    the same order, so that only a lost state can differ."""
    whole, half, rest = (checkpoint(path) for path in torch.load(run_together("unbroken") / "unbroken.pt"))
    counts = [len(splats_of(content)["means"]) for content in (half, whole)]
    assert counts[0] != counts[1], "nothing was densified in the second half: the test would prove nothing"
    for name, value in whole["pipeline"].items():
        if isinstance(value, torch.Tensor):
            assert_close(rest["pipeline"][name], value, rtol=1e-5, atol=1e-7, msg=lambda text, name=name: name + text)
