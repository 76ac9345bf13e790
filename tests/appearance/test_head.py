# SPDX-License-Identifier: Apache-2.0
"""What every head owes the model, whatever its formulas."""

import pytest
import torch
from head_cases import awake, scene
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from nrfgs_ns.appearance import gsnb, vdgs
from nrfgs_ns.appearance.gsnb import GsnbConfig
from nrfgs_ns.appearance.head import AppearanceHead, AppearanceHeadConfig, SplatAppearance
from nrfgs_ns.appearance.nrf import NrfConfig, view_geometry
from nrfgs_ns.appearance.sg import SgConfig
from nrfgs_ns.appearance.sh import ShConfig
from nrfgs_ns.appearance.vdgs import HashGrid, VdgsConfig
from nrfgs_ns.errors import InputError
from nrfgs_ns.model.config import NrfgsModelConfig

CONFIGS = {"nrf": NrfConfig(), "sh": ShConfig(), "vdgs": VdgsConfig(), "gsnb": GsnbConfig(), "sg": SgConfig()}
SMALL = {
    "nrf": NrfConfig(latent_dim=3, hidden_width=5),
    "nrf, logit": NrfConfig(latent_dim=3, hidden_width=5, num_bands=2, opacity_bound="logit"),
    "nrf, one branch": NrfConfig(latent_dim=3, hidden_width=5, num_bands=2, split_bands=False, opacity_residual=False),
    "sh": ShConfig(degree=2),
    "vdgs": VdgsConfig(degree=1),
    "gsnb": GsnbConfig(degree=1),
    "sg": SgConfig(lobes=2),
}
"""Few enough numbers for finite differences."""


@pytest.fixture(params=CONFIGS)
def config(request):
    return CONFIGS[request.param]


@pytest.mark.parametrize("name", SMALL)
def test_gradients_agree_with_finite_differences(name, monkeypatch):
    """To every stored number, the cameras and every shared weight."""
    for module, constant, small in ((vdgs, "HIDDEN_WIDTH", 4), (gsnb, "HIDDEN_WIDTH", 4), (gsnb, "BANDS", 2)):
        monkeypatch.setattr(module, constant, small)
    head = awake(SMALL[name])
    if name == "vdgs":  # four levels of 16 rows, the first of them numbered
        head.grid = HashGrid(1, log2_table_size=4, per_level_scale=2).double()
        head.grid.table.data.normal_()
    splats, visible, centers = scene(head, count=5)
    weights = dict(head.named_parameters())

    def f(centers, *tensors):
        table = dict(zip(splats, tensors, strict=False))
        shared = dict(zip(weights, tensors[len(splats) :], strict=True))
        return torch.func.functional_call(head, shared, (table, visible, centers))

    inputs = [centers, *splats.values(), *(weight.detach().clone() for weight in weights.values())]
    assert torch.autograd.gradcheck(f, [x.requires_grad_() for x in inputs])


@pytest.mark.parametrize("size", [1.0, 1e-6, 1e6])
def test_float32_is_float64_up_to_rounding(config, size):
    """In scenes of any size, with latents as large.

    How far rounding can go is measured: in float64, every number that goes in is off by a random 8 units (2^-24). 8 is
    about how many operations deep each stage is. The tolerance is 8 times the largest change in 6 such runs, and 64
    units of 1 for the sums over up to 64 terms.
    """
    head = awake(config)
    splats, visible, centers = scene(head)
    splats = {name: value * (size if name in ("means", "latents") else 1) for name, value in splats.items()}
    centers = size * centers
    exact, unit = head(splats, visible, centers), 2.0**-24

    def off(value):
        return value * (1 + 8 * unit * torch.empty_like(value).uniform_(-1, 1))

    changes = []
    for seed in range(6):
        torch.manual_seed(seed)
        weights = {name: off(weight.detach()) for name, weight in head.named_parameters()}
        table = {name: off(value) for name, value in splats.items()}
        moved = torch.func.functional_call(head, weights, (table, visible, off(centers)))
        changes.append([(a - b).abs().max().item() for a, b in zip(moved, exact, strict=True)])
    head.float()
    single = head({name: value.float() for name, value in splats.items()}, visible, centers.float())
    for value, expected, change in zip(single, exact, torch.tensor(changes).max(dim=0).values.tolist(), strict=True):
        assert value.dtype == torch.float32
        assert_close(value.double(), expected, rtol=0, atol=8 * change + 64 * unit)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("offset", [0.0, 1e-20, 1e-6])
def test_a_camera_on_the_splat_gives_finite_values_and_gradients(config, dtype, offset):
    head = awake(config, dtype)
    splats, visible, _ = scene(head, dtype=dtype)
    splats = {name: value.requires_grad_() for name, value in splats.items()}
    splats["means"].data[visible[0]] = 0.0  # where 1e-20 is not lost in the sum
    colors, opacities = head(splats, visible, splats["means"].detach()[visible] + offset)
    (colors.sum() + opacities.sum()).backward()
    for value in (colors, opacities, *(splat.grad for splat in splats.values()), *(w.grad for w in head.parameters())):
        assert torch.isfinite(value).all()


def test_values_are_bounded_and_every_stored_number_is_felt(config):
    head = awake(config)
    splats, visible, centers = scene(head, count=60)
    splats = {name: value.requires_grad_() for name, value in splats.items()}
    colors, opacities = head(splats, visible, centers)
    assert colors.shape == (40, 3) and opacities.shape == (40,)
    assert (colors >= 0).all() and (opacities >= 0).all() and (opacities <= 1).all()
    (colors.sum() + opacities.sum()).backward()
    hidden = torch.ones(60, dtype=torch.bool)
    hidden[visible] = False
    for name, value in splats.items():
        assert (value.grad[hidden] == 0).all(), name
        assert (value.grad[visible] != 0).any(dim=0).all(), name


def test_nothing_visible_is_nothing_and_one_camera_is_as_good_as_one_for_each_splat(config):
    head = awake(config)
    splats, visible, viewed = scene(head)
    for centers in (torch.zeros(3).double(), torch.zeros(0, 3).double()):
        colors, opacities = head(splats, torch.zeros(0, dtype=torch.int64), centers)
        assert colors.shape == (0, 3) and opacities.shape == (0,)
    one = head(splats, visible, viewed[0])
    each = head(splats, visible, viewed[:1].expand(len(visible), 3))
    assert torch.equal(one.colors, each.colors) and torch.equal(one.opacities, each.opacities)


class Mine(AppearanceHead):
    name = "mine"

    def forward(self, splats, visible, camera_centers, change=lambda *answer: answer):
        rows = {name: value.view(-1).view(value.shape) for name, value in splats.items()}  # of contiguous tables
        return SplatAppearance(*change(*self.base_appearance(rows, visible)))


def answering(change):
    return {"forward": lambda *inputs: Mine.forward(*inputs, change)}


@pytest.mark.parametrize("change, says", [
    ({"name": None}, "Mine has no name"),
    ({"splat_params": lambda self, rgb: {"x": rgb[1:]}}, r"'x' of splat_params must be .*\[5, 3\], but .*\[4, 3\]"),
    ({"splat_params": lambda self, rgb: {"x": rgb.long()}}, "'x' of splat_params .* int64"),
    ({"forward": lambda self, splats, *_: splats["slopes"]}, r"KeyError: 'slopes' \(.*test_head.py, line \d+\)"),
    ({"forward": lambda self, splats, visible, _: torch.zeros(5)[visible]}, "IndexError: .*splat_params must return"),
    ({"forward": lambda self, *_: (1, 2)}, "returns a tuple"),
    (answering(lambda colors, opacities: (colors, opacities[:, None])), r"opacities .*\[2\], but .*\[2, 1\]"),
    (answering(lambda colors, opacities: (colors.half(), opacities)), "colors .*float16"),
    (answering(lambda colors, opacities: (colors / 0, opacities)), "colors .*not all finite"),
    ({"at_pixel": True, "image_of": lambda _, made, at: made.unfold(1, 8, 8)[..., :2, 0]}, r"image_of .*\[16, 2, 2\]"),
])  # fmt: skip
def test_a_head_that_breaks_the_contract_is_told_before_the_training(change, says):
    config = NrfgsModelConfig(appearance=AppearanceHeadConfig(_target=type("Mine", (Mine,), change)))
    with pytest.raises(InputError, match=says):
        config.setup(scene_box=None, num_train_data=1, seed_points=(torch.rand(5, 3), torch.full((5, 3), 100)))


point = st.tuples(*3 * [st.floats(-1e6, 1e6, allow_nan=False, width=32)])


@given(point, point, st.sampled_from([1e-3, 0.01, 1.0]))
def test_direction_and_distance(mean, center, eps):
    mean, center = torch.tensor([mean]).double(), torch.tensor(center).double()
    directions, log_distance = view_geometry(mean, center, eps)
    true = (center - mean).norm()
    assert_close(log_distance.exp().squeeze(), true.clamp_min(eps))
    assert_close(directions.norm(), (true / true.clamp_min(eps)))
    assert_close(directions * true.clamp_min(eps), center - mean)
