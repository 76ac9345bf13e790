# SPDX-License-Identifier: Apache-2.0
"""The loss of L1 and SSIM: PyTorch's path against pytorch_msssim. Its kernels: kernels/small_interpreted.py."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from ssim_cases import MOMENT_ROUNDINGS, TOLERANCE, ULP, assert_near, pair, reference

from nrfgs_ns.image import ssim as module
from nrfgs_ns.image.metrics import SSIM_C2
from nrfgs_ns.image.ssim import photometric_loss

FLAT = 2 * MOMENT_ROUNDINGS * ULP / SSIM_C2
"""Error on images of next to no variance."""
DOUBLE_TOLERANCE = TOLERANCE * 2.0**-29
"""The same bound for float64's 2^-53 instead of 2^-24."""


@pytest.fixture(autouse=True)
def kernels_run(request):
    if request.node.get_closest_marker("gpu"):
        assert module.kernels_run_on(torch.device("cuda", torch.cuda.current_device()))


@settings(max_examples=40, derandomize=True)
@given(st.integers(11, 40), st.integers(11, 40), st.sampled_from([0.0, 0.2, 1.0]), st.integers(0, 9))
def test_values_and_gradients_in_float64(height, width, ssim_lambda, seed):
    prediction, truth = (image.detach().double() for image in pair(height, width, seed))
    prediction.requires_grad_()
    assert_near(photometric_loss(prediction, truth, ssim_lambda), prediction, truth, ssim_lambda, DOUBLE_TOLERANCE)


SIZES = [(11, 11), (12, 43), (31, 64), (33, 11), (90, 70), (97, 128)]


@pytest.mark.parametrize("ssim_lambda", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("size, device", [
    *((size, "cpu") for size in SIZES),
    *(pytest.param(size, "cuda", marks=pytest.mark.gpu) for size in [*SIZES, (532, 799), (1200, 1600)]),
])  # fmt: skip
def test_values_and_gradients_in_float32(size, device, ssim_lambda):
    prediction, truth = pair(*size, device=device)
    loss = photometric_loss(prediction, truth, ssim_lambda)
    assert (type(loss.grad_fn).__name__ == "WeightedSumBackward") == (device == "cuda")
    assert_near(loss, prediction, truth, ssim_lambda, TOLERANCE)


@pytest.mark.parametrize("value", [0.0, 0.3, 1.0])
def test_flat_images_in_float32(value):
    """Variances of 0 come out as rounding; D >= C2 bounds what that does, and the exact value is known."""
    truth = torch.full((30, 40, 3), value)
    prediction = truth.clone().requires_grad_()
    loss = photometric_loss(prediction, truth, 1.0)
    loss.backward()
    assert loss.abs() <= FLAT
    # Slopes are at most 2 / C2; the gradient is made of three of them, which cancel except for their relative errors.
    assert (prediction.grad * 3 * 20 * 30).abs().max() <= 3 * 2 / SSIM_C2 * FLAT


def test_black_against_white():
    """Means 0 and 1, no variance: S = C1 / (1 + C1).

    The float32 weights add up to 1 within 2^-24, those of both axes together within 2^-23: so much of E[yy] - E[y]^2 is
    left, and divided by C2.
    """
    white = torch.ones(15, 12, 3, dtype=torch.float64)
    black = torch.zeros_like(white).requires_grad_()
    loss = photometric_loss(black, white, 1.0)
    assert (1 - loss - 1e-4 / 1.0001).abs() <= 1e-4 * 2.0**-23 / SSIM_C2
    assert_near(loss, black, white, 1.0, 2 * MOMENT_ROUNDINGS * 2.0**-53 / SSIM_C2)


@pytest.mark.parametrize("size", [(10, 30), (30, 10), (5, 4)])
def test_small_images_are_the_librarys(size):
    prediction, truth = pair(*size)
    with pytest.warns(UserWarning, match="Skipping Gaussian Smoothing"):
        loss = photometric_loss(prediction, truth, 0.2)
        expected, gradient = reference(prediction, truth, 0.2)
    # An axis that is not blurred leaves windows of next to no variance.
    assert (loss - expected).abs() <= FLAT
    assert (torch.autograd.grad(loss, prediction)[0] - gradient).abs().max() <= FLAT * gradient.abs().max()


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
@pytest.mark.parametrize(("size", "place"), [(20, (10, 10, 1)), (50, (49, 49, 2))])
def test_not_a_number_is_seen(size, place, device):
    prediction, truth = pair(size, size, device=device)
    broken = prediction.detach().clone()
    broken[place] = float("nan")
    assert photometric_loss(broken, truth, 0.2).isnan()


# The kernels on a CUDA device. `pytest -m gpu`.
@pytest.mark.gpu
@pytest.mark.parametrize("value", [0.0, 0.9, 1.0])
def test_nearly_flat_images(value):
    generator = torch.Generator().manual_seed(3)
    truth = value + 1e-3 * torch.randn(70, 90, 3, generator=generator)
    prediction = (truth + 1e-3 * torch.randn(70, 90, 3, generator=generator)).cuda().requires_grad_()
    loss = photometric_loss(prediction, truth.cuda(), 1.0)
    expected, gradient = reference(prediction, truth.cuda(), 1.0)
    assert (loss - expected).abs() <= FLAT
    # Slopes are at most 2 / C2 with a relative error of FLAT, and the gradient is made of three.
    assert (torch.autograd.grad(loss, prediction)[0] - gradient).abs().max() * 3 * 60 * 80 <= 3 * 2 / SSIM_C2 * FLAT


@pytest.mark.gpu
def test_twice_is_the_same():
    prediction, truth = pair(270, 333, device="cuda")
    losses = [photometric_loss(prediction, truth, 0.2) for _ in range(2)]
    assert torch.equal(*losses) and torch.equal(*(torch.autograd.grad(loss, prediction)[0] for loss in losses))
    with torch.no_grad():
        assert torch.equal(photometric_loss(prediction, truth, 0.2), losses[0])


@pytest.mark.gpu
def test_images_that_are_not_contiguous_and_upstream_gradients():
    prediction, truth = pair(40, 57, device="cuda")
    (1000.0 * photometric_loss(prediction.transpose(0, 1), truth.transpose(0, 1), 0.2)).backward()
    _, gradient = reference(prediction, truth, 0.2)
    assert (prediction.grad / 1000.0 - gradient).abs().max() <= TOLERANCE * gradient.abs().max()
