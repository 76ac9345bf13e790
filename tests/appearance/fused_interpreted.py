# SPDX-License-Identifier: Apache-2.0
"""The fused kernels in Triton's interpreter against PyTorch's float64 field."""

import pytest
import quick_interpreter  # noqa: F401
import torch
import triton
import triton.language as tl
from fused_cases import ULP, assert_near, compare, evaluate, float32_tolerance, heads, relative_errors, rounding, scene
from hypothesis import given, settings
from hypothesis import strategies as st

from nrfgs_ns.appearance.fused import launch
from nrfgs_ns.appearance.fused.kernels import _waves


@pytest.fixture
def memory_begins_as_nan():
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)


@pytest.mark.parametrize("count, visible, repeated", [(230, 200, False), (30, 200, True), (70, 70, False)])
@pytest.mark.parametrize("opacity_bound", ["straight-through", "logit"])
def test_values_and_gradients(opacity_bound, count, visible, repeated, memory_begins_as_nan):
    """Of some rows, in three blocks and a part of one, so that a program sees several; of repeated rows, whose
    gradients add up; and of all, whose gradients are written without being cleared before."""
    head, twin = heads(opacity_bound=opacity_bound)
    compare(head, twin, scene(head, count, visible, repeated), float32_tolerance())


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_without_gradients_the_values_are_the_same(mode):
    head, _ = heads()
    case = scene(head, 75, 70)
    with mode():
        alone = head(*case)
    assert all(map(torch.equal, alone, head(*case)))


@settings(max_examples=24, deadline=None, derandomize=True)
@given(
    num_bands=st.sampled_from([1, 2, 3, 5, 7]),
    split_bands=st.booleans(),
    opacity_residual=st.booleans(),
    opacity_bound=st.sampled_from(["straight-through", "logit"]),
    use_distance=st.booleans(),
    latent_dim=st.sampled_from([1, 7, 16, 31, 33]),
    hidden_width=st.sampled_from([3, 16, 33]),
    columns=st.sampled_from([8, 16]),
    visible=st.integers(0, 70),
    repeated=st.booleans(),
)
def test_every_switch_and_size(num_bands, columns, visible, repeated, **switches):
    """And both ways of giving the output layer to the tensor cores."""
    head, twin = heads(num_bands=num_bands, **switches)
    case = scene(head, 75, visible, repeated)
    (launches,) = launch.LAUNCHES["fp32"]
    ours = launch.Launches(*(how._replace(columns=columns) for how in launches))
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(launch.LAUNCHES, "fp32", (ours,))
        compare(head, twin, case, float32_tolerance(num_bands))


@triton.jit
def waves_kernel(directions, waves_out, N: tl.constexpr, BANDS: tl.constexpr):
    positions = tl.arange(0, N)[:, None] * 4 + tl.arange(0, 4)[None, :]
    waves = _waves(tl.load(directions + positions), BANDS)
    for i in tl.static_range(2 * BANDS):
        tl.store(waves_out + i * 4 * N + positions, waves[i])


def test_bands_by_double_angles():
    bands, n = 7, 2**14
    directions = torch.cat([torch.linspace(-1, 1, 4 * n - 4), torch.tensor([0.0, 0.25, -0.5, 1e-6])]).view(n, 4)
    waves = torch.empty(bands, 2, n, 4)
    waves_kernel[(1,)](directions, waves, N=n, BANDS=bands)
    for k in range(bands):
        angle = torch.pi * 2.0**k * directions.double()
        error = (waves[k].double() - torch.stack([angle.sin(), angle.cos()])).norm(dim=0).max().item()
        assert error <= 2.0**k * 4 * ULP  # the kernel derives 2^k 4e-7; the error of band 0 is known, 2.1e-7


def test_the_next_way_is_taken_where_the_first_does_not_run(monkeypatch):
    first, second = launch.LAUNCHES["bf16"]
    probe, tried = launch.probe, []

    def lacking(packing, launches, options):
        tried.append(launches)
        if launches == first:
            raise RuntimeError("out of resource: shared memory")
        probe(packing, launches, options)

    monkeypatch.setattr(launch, "probe", lacking)
    head, twin = heads(precision="bf16")
    compare(head, rounding(twin, launch.KINDS["bf16"]), scene(head, 150, 140), 2.0**-13)
    assert tried == [first, second]


EXTREMES = {
    "on the splat": lambda splats, centers: centers.copy_(splats["means"][0]),
    "far away": lambda splats, centers: centers.mul_(1e6),
    "beyond reach": lambda splats, centers: centers.mul_(1e20),
    "logits": lambda splats, centers: splats["opacities"].sign_().mul_(1e4),
    "latents": lambda splats, centers: splats["latents"].mul_(1e4),
    "colours": lambda splats, centers: splats["features_dc"].mul_(1e3),
    "near the floor": lambda splats, centers: splats["means"].mul_(0.012).add_(centers),
}


@pytest.mark.parametrize("scale", [1.0, 1e4])
@pytest.mark.parametrize("opacity_bound", ["straight-through", "logit"])
@pytest.mark.parametrize("extreme", list(EXTREMES))
def test_extremes(extreme, opacity_bound, scale):
    """With weights as torch starts them, and with enormous ones."""
    head, twin = heads(opacity_bound=opacity_bound, scale=scale)
    splats, _, centers = scene(head, 60, 50)
    EXTREMES[extreme](splats, centers)
    case = splats, torch.arange(50), centers
    exact = evaluate(twin, *case, dtype=torch.float64)
    # Large numbers before tanh leave float32 with few digits of what tanh still sees. PyTorch in float32 loses them as
    # well: the kernels, which only round in another order, may not lose ten times as much.
    plain, _ = heads()
    plain.config, plain.fused = twin.config, twin.fused
    plain.load_state_dict(twin.state_dict())
    errors = relative_errors(evaluate(plain.float(), *case), exact)
    assert_near(evaluate(head, *case), exact, {n: float32_tolerance() + 10 * error for n, error in errors.items()})


@pytest.mark.parametrize("precision", ["tf32", "bf16", "fp16"])
def test_rounded_products(precision):
    """The twin rounds the same factors: float32's roundings are left, and factors that fall on either side.

    A factor within a few float32 roundings of the middle of two neighbours, one in 2^12 for bf16 and in 2^9 for the
    others, may be rounded up by one and down by the other: an error of 2 u in each of that many, u being 2^-9 and
    2^-12, is 2 u sqrt(1 / 2^12) = 2^-14, or 2^-15.5. Four products in a row double it.
    """
    head, twin = heads(precision=precision)
    case = scene(head, 150, 140)
    compare(head, rounding(twin, launch.KINDS[precision]), case, 2.0**-13)
    case[0]["latents"] *= 1e6
    with torch.no_grad():
        colors, opacities = head(*case)  # float16 saturates
    assert torch.isfinite(colors).all() and ((opacities >= 0) & (opacities <= 1)).all()


def test_tiny_gradients_survive_half_precision():
    """A mean over a million pixels: gradients of 1e-9, below what fp16 holds."""
    head, _ = heads(precision="fp16")
    splats, visible, centers = scene(head, 40, 30)
    gradients = []
    for factor in (1.0, 2.0**-30):  # a power of two: nothing else may change
        splats["latents"] = splats["latents"].detach().requires_grad_()
        colors, opacities = head(splats, visible, centers)
        (factor * (colors.sum() + opacities.sum())).backward()
        gradients.append(splats["latents"].grad / factor)
    assert gradients[0].abs().max() > 0
    assert torch.equal(*gradients)
