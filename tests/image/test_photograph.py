# SPDX-License-Identifier: Apache-2.0
"""The model of a photograph: known answers, gradients, gauge, identity, checkpoints."""

import pytest
import torch
from exposures import exposed

from nrfgs_ns.image.photograph import BASIS, PhotographModel


def model_of(seed: int | None = None) -> PhotographModel:
    """Five photographs; with a seed, every number away from its start."""
    model = PhotographModel([f"{index}.jpg" for index in range(5)])
    if seed is not None:
        torch.manual_seed(seed)
        with torch.no_grad():
            model.shots.add_(0.3 * torch.rand_like(model.shots))
        model.center_()
    return model


def srgb(light):
    return torch.where(light <= 0.0031308, 12.92 * light, 1.055 * light.clamp_min(0.0031308) ** (1 / 2.4) - 0.055)


def test_starts_as_the_identity_to_the_bit():
    image, model = torch.rand(6, 7, 3) * 1.2, model_of()
    for index in range(5):
        assert torch.equal(model(image, index), image.clamp(0.0, 1.0))


def test_a_stop_is_a_stop_of_light_under_srgb():
    light = torch.linspace(0.005, 0.45, 30)[:, None, None].expand(30, 1, 3).double()
    model = model_of().double()
    with torch.no_grad():
        model.shots[2] = torch.tensor([1.0, 0.0, 0.0])
    # Above sRGB's linear toe (0.0031308) its curve is the model's to the last digit.
    torch.testing.assert_close(model(srgb(light), 2), srgb(2 * light), atol=1e-6, rtol=0)
    torch.testing.assert_close(exposed(srgb(light), 1.0), srgb(2 * light), atol=1e-6, rtol=0)


def test_white_balance_changes_ratios_and_not_the_mean_stop():
    model = model_of()
    with torch.no_grad():
        model.shots[1] = torch.tensor([0.5, 0.3, -0.2])
    red, green, blue = (model.shots[1] @ torch.tensor(BASIS)).tolist()
    assert (red + green + blue) / 3 == pytest.approx(0.5)
    assert (red - green, blue - green) == (pytest.approx(0.3), pytest.approx(-0.2))


def test_gradients_against_finite_differences():
    model = model_of(seed=1).double()
    image = (0.1 + 0.7 * torch.rand(4, 5, 3, dtype=torch.float64)).requires_grad_()  # nothing is at a bound

    def taken(image, shots):
        return torch.func.functional_call(model, {"shots": shots}, (image, 3))

    assert torch.autograd.gradcheck(taken, (image, model.shots.detach().requires_grad_()))


def test_what_all_photographs_have_in_common_is_the_scenes():
    start = torch.tensor([[1.0, 0.9, 1.2], [0.0, 0.1, 0.2], [0.5, 0.5, 0.5]])
    model = PhotographModel(["a", "b", "c"], start=start)
    torch.testing.assert_close(model.shots.detach(), start - start.mean(dim=0))
    optimizer = torch.optim.Adam(model.parameters(), lr=0.1)
    for _ in range(20):  # all photographs are brighter than the picture: that is no exposure's business
        optimizer.zero_grad()
        sum((1.0 - model(torch.full((2, 2, 3), 0.3), index)).abs().mean() for index in range(3)).backward()
        optimizer.step()
        model.center_()
        assert (model.shots @ torch.tensor(BASIS)).mean(dim=0).abs().max() < 1e-6


def test_patterns_that_are_the_scenes_stay_as_they_started():
    torch.manual_seed(0)
    ramp, constant = torch.linspace(-1.0, 1.0, 6)[:, None], torch.full((6, 1), 6**-0.5)
    held = [torch.cat([constant, ramp / ramp.norm()], dim=1), constant, constant]
    model = PhotographModel([str(index) for index in range(6)], start=torch.randn(6, 3), held=held)
    slow = (ramp.T @ model.shots[:, 0]).item()
    with torch.no_grad():
        model.shots.add_(torch.randn(6, 3))
    own = model.shots.detach().clone()
    model.center_()
    assert model.shots.mean(dim=0).abs().max() < 1e-6
    assert (ramp.T @ model.shots[:, 0]).item() == pytest.approx(slow, abs=1e-5)
    torch.testing.assert_close(model.shots[:, 1:], own[:, 1:] - own[:, 1:].mean(dim=0))  # not held for colours


def test_a_checkpoint_brings_it_back_with_its_patterns(tmp_path):
    torch.manual_seed(4)
    model = PhotographModel([f"{index}.jpg" for index in range(5)], torch.rand(5, 3), [torch.eye(5)] * 3)
    torch.save(model.state_dict(), tmp_path / "state.pt")
    again = PhotographModel.from_state(torch.load(tmp_path / "state.pt", weights_only=True))
    image = torch.rand(5, 6, 3)
    for index in range(5):
        assert torch.equal(again(image, index), model(image, index))
    assert torch.equal(again.held, model.held) and torch.equal(again.kept, model.kept) and again.names == model.names
