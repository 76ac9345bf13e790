# SPDX-License-Identifier: Apache-2.0
"""The model of a photograph: known answers, gradients, gauge, identity, checkpoints."""

import pytest
import torch

from nrfgs_ns.image.photograph import GAMMA, PARTS, PENALTY, TOE, TOE_STEP, PhotographModel, exposed

LENSES = torch.tensor([[0.5, 0.5, 1.0, 1.5], [0.4, 0.6, 2.0, 3.0]])
CHOICES = [("exposure",), ("white-balance",), ("exposure", "white-balance"), ("vignetting",), ("response",), PARTS]


def model_of(parts=PARTS, photographs: int = 5, start=None, seed: int | None = None) -> PhotographModel:
    """Of two cameras that take turns; with a seed, every number away from its start."""
    cameras = [index % 2 for index in range(photographs)]
    model = PhotographModel([f"{index}.jpg" for index in range(photographs)], cameras, LENSES, parts, start)
    if seed is not None:
        torch.manual_seed(seed)
        with torch.no_grad():
            for parameter in model.parameters():
                parameter.add_(0.3 * torch.rand_like(parameter))
        model.center_()
    return model


def srgb(light):
    return torch.where(light <= 0.0031308, 12.92 * light, 1.055 * light.clamp_min(0.0031308) ** (1 / 2.4) - 0.055)


@pytest.mark.parametrize("parts", CHOICES)
def test_starts_as_the_identity_to_the_bit(parts):
    image = torch.rand(6, 7, 3) * 1.2
    model = model_of(parts)
    for index in range(5):
        assert torch.equal(model(image, index), image.clamp(0.0, 1.0))


def test_a_stop_is_a_stop_of_light_under_srgb():
    light = torch.linspace(0.005, 0.45, 30)[:, None, None].expand(30, 1, 3).double()
    model = model_of(("exposure",)).double()
    with torch.no_grad():
        model.shots[2] = 1.0
    # Above sRGB's linear toe (0.0031308) its curve is the model's to the last digit.
    torch.testing.assert_close(model(srgb(light), 2), srgb(2 * light), atol=1e-6, rtol=0)
    torch.testing.assert_close(exposed(srgb(light), 1.0), srgb(2 * light), atol=1e-6, rtol=0)


def test_white_balance_changes_ratios_and_not_the_mean_stop():
    model = model_of(("exposure", "white-balance"))
    with torch.no_grad():
        model.shots[1] = torch.tensor([0.5, 0.3, -0.2])
    red, green, blue = model.stops()[1].tolist()
    assert (red + green + blue) / 3 == pytest.approx(0.5)
    assert (red - green, blue - green) == (pytest.approx(0.3), pytest.approx(-0.2))


def test_vignetting_darkens_the_corner_by_its_stops_and_leaves_the_centre():
    model = model_of(("vignetting",))
    with torch.no_grad():
        model.falloff[0] = torch.tensor([0.6, 0.4])
    image = torch.full((1001, 1001, 3), 0.5)
    taken = model(image, 0).detach()
    assert taken[500, 500] == pytest.approx(0.5, abs=1e-5)
    corner = (0.5 + TOE) * 2 ** (-1.0 / GAMMA) - TOE  # r = 1, up to half a pixel
    assert taken[0, 0, 0].item() == pytest.approx(corner, abs=2e-3)
    assert torch.equal(model(image, 1), image)  # the other camera
    assert torch.equal(model.by_camera(image, 0), taken)


def test_a_response_with_a_shoulder_makes_a_stop_count_less_in_the_lights():
    model = model_of(("exposure", "response"), photographs=4)
    with torch.no_grad():
        model.curves[:, 1] = 0.5
        model.shots[0] = 1.0
    image = torch.tensor([0.1, 0.4, 0.6])[:, None, None].expand(3, 1, 3)
    plain, shouldered = exposed(image, 1.0), model(image, 0)
    assert (shouldered[1:] < plain[1:] - 0.01).all()
    # No stop, no change: the curve is all cameras' alike.
    torch.testing.assert_close(model(image, 1), image)


def test_response_undoes_itself():
    """k and 1/k after one another give the picture back, whatever the curve: a stop is a group."""
    model = model_of(("exposure", "response"), photographs=2).double()
    with torch.no_grad():
        model.curves[:] = torch.tensor([(0.12 - TOE) / TOE_STEP, 0.4])
        model.shots[:, 0] = torch.tensor([0.8, -0.8])
    image = 0.1 + 0.5 * torch.rand(4, 5, 3, dtype=torch.float64)  # what is cut off is lost
    torch.testing.assert_close(model(model(image, 0), 1), image)


@pytest.mark.parametrize("parts", CHOICES)
def test_gradients_against_finite_differences(parts):
    model = model_of(parts, seed=1).double()
    image = (0.1 + 0.7 * torch.rand(4, 5, 3, dtype=torch.float64)).requires_grad_()  # nothing is at a bound
    names, values = zip(*model.named_parameters(), strict=True)

    def taken(image, *values):
        with torch.nn.utils.stateless._reparametrize_module(model, dict(zip(names, values, strict=True))):
            return model(image, 3), model.penalty(3) if model.has_penalty else image

    inputs = (image, *(value.detach().requires_grad_(True) for value in values))
    assert torch.autograd.gradcheck(taken, inputs)


def test_gradients_in_single_precision_are_those_in_double():
    image, weight = torch.rand(40, 50, 3), torch.rand(40, 50, 3)
    gradients = []
    for dtype in (torch.float32, torch.float64):
        model = model_of(("exposure", "white-balance"), seed=2).to(dtype)
        (model(image.to(dtype), 1) * weight.to(dtype)).sum().backward()
        gradients.append(model.shots.grad)
    torch.testing.assert_close(gradients[0].double(), gradients[1], rtol=1e-5, atol=1e-4)
    assert (gradients[1][1] != 0).all() and (gradients[1][[0, 2, 3, 4]] == 0).all()


def test_what_all_photographs_have_in_common_is_the_scenes():
    start = torch.tensor([[1.0, 0.9, 1.2], [0.0, 0.1, 0.2], [0.5, 0.5, 0.5]])
    model = PhotographModel(["a", "b", "c"], [0, 0, 0], LENSES[:1], start=start)
    torch.testing.assert_close(model.stops(), start - start.mean(dim=0))
    optimizer = torch.optim.Adam(model.parameters(), lr=0.1)
    for _ in range(20):  # all photographs are brighter than the picture: that is no exposure's business
        optimizer.zero_grad()
        sum((1.0 - model(torch.full((2, 2, 3), 0.3), index)).abs().mean() for index in range(3)).backward()
        optimizer.step()
        model.center_()
        assert model.stops().mean(dim=0).abs().max() < 1e-6


def test_bounds_hold_after_a_step():
    model = model_of(("vignetting", "response"))
    with torch.no_grad():
        model.falloff.fill_(-1.0)
        model.curves.fill_(5.0)
    model.center_()
    assert (model.falloff == 0).all()
    assert model.curves[0].tolist() == pytest.approx([(0.3 - TOE) / TOE_STEP, 0.9])
    assert torch.isfinite(model(torch.rand(3, 3, 3) * 4, 0)).all()


def test_penalty_is_of_the_cameras_numbers_and_nothing_at_the_start():
    assert not model_of(("exposure", "white-balance")).has_penalty
    model = model_of(PARTS)
    assert model.has_penalty and model.penalty(0) == 0.0
    with torch.no_grad():
        model.shots[2] = 1.0
        model.curves[0] = torch.tensor([1.0, 0.5])
    assert model.penalty(2).item() == pytest.approx(PENALTY * 1.25)
    assert model.penalty(1) == 0.0


def test_patterns_that_are_the_scenes_stay_as_they_started():
    torch.manual_seed(0)
    ramp = torch.linspace(-1.0, 1.0, 6)[:, None]
    constant = torch.full((6, 1), 6**-0.5)
    held = [torch.cat([constant, ramp / ramp.norm()], dim=1), constant, constant]
    start = torch.randn(6, 3)
    model = PhotographModel([str(index) for index in range(6)], [0] * 6, LENSES[:1], start=start, held=held)
    slow = (ramp.T @ model.shots[:, 0]).item()
    torch.testing.assert_close(model.stops(), start - start.mean(dim=0))
    with torch.no_grad():
        model.shots.add_(torch.randn(6, 3))
    own = model.shots.detach().clone()
    model.center_()
    assert model.shots.mean(dim=0).abs().max() < 1e-6
    assert (ramp.T @ model.shots[:, 0]).item() == pytest.approx(slow, abs=1e-5)
    torch.testing.assert_close(model.shots[:, 1:], own[:, 1:] - own[:, 1:].mean(dim=0))  # not held for colours


def test_a_checkpoint_without_patterns_holds_the_constants():
    model = model_of(("exposure", "white-balance"), seed=5)
    state = {name: value for name, value in model.state_dict().items() if name not in ("held", "kept")}
    again = PhotographModel.from_state(state)
    assert again.held.shape == (3, 15) and torch.equal(again.shots, model.shots)
    eye = torch.eye(5)
    goes_on = PhotographModel(model.names, [0, 1, 0, 1, 0], LENSES, start=torch.randn(5, 3), held=[eye, eye, eye])
    goes_on.load_state_dict({name: value for name, value in state.items() if name not in ("held", "kept")})
    goes_on.center_()
    torch.testing.assert_close(goes_on.shots, model.shots)


def test_a_checkpoint_brings_its_own_patterns():
    eye = torch.eye(5)
    many = PhotographModel([f"{i}.jpg" for i in range(5)], [0] * 5, LENSES, held=[eye, eye, eye])
    few = PhotographModel([f"{i}.jpg" for i in range(5)], [0] * 5, LENSES)
    few.load_state_dict(many.state_dict())
    assert torch.equal(few.held, many.held) and few.kept.shape == (15,)


def test_recovers_known_exposures_from_the_photographs_alone():
    torch.manual_seed(3)
    scene, truth = torch.rand(24, 24, 3) * 0.6 + 0.1, torch.randn(6, 3) * 0.4
    truth -= truth.mean(dim=0)
    photographs = [exposed(scene, stops) for stops in truth]
    model = PhotographModel([str(index) for index in range(6)], [0] * 6, LENSES[:1])
    guess = torch.nn.Parameter(torch.full_like(scene, 0.5))
    optimizer = torch.optim.Adam([{"params": [guess], "lr": 0.02}, {"params": model.parameters(), "lr": 0.02}])
    for step in range(900):
        optimizer.zero_grad()
        index = step % 6
        error = (model(guess, index).clamp(0.0, 1.0) - photographs[index]).abs().mean()
        error.backward()
        optimizer.step()
        model.center_()
    assert (model.stops() - truth).abs().max() < 0.1
    assert (guess - scene).abs().mean() < 0.02


@pytest.mark.parametrize("parts", CHOICES)
def test_a_checkpoint_brings_it_back(parts, tmp_path):
    model = model_of(parts, seed=4)
    torch.save(model.state_dict(), tmp_path / "state.pt")
    again = PhotographModel.from_state(torch.load(tmp_path / "state.pt", weights_only=True))
    image = torch.rand(5, 6, 3)
    for index in range(5):
        assert torch.equal(again(image, index), model(image, index))
    with pytest.raises(ValueError, match="are others"):
        PhotographModel(["x"] * 5, [0, 1, 0, 1, 0], LENSES, parts).load_state_dict(model.state_dict())


def test_camera_is_found_by_its_angle():
    model = model_of()
    assert model.camera_like(100, 80, 105, 115) == 0
    assert model.camera_like(50, 40, 105, 118) == 1


def test_unknown_parts_are_refused():
    with pytest.raises(ValueError, match="sharpness"):
        model_of(("sharpness",))
