# SPDX-License-Identifier: Apache-2.0
"""The loss's kernels on a CUDA device against pytorch_msssim in float64. `pytest -m gpu`."""

import pytest
import torch
from ssim_cases import MOMENT_ROUNDINGS, TOLERANCE, ULP, assert_near, pair, reference

from nrfgs_ns.image import ssim as module
from nrfgs_ns.image.metrics import SSIM_C2
from nrfgs_ns.image.ssim import photometric_loss

pytestmark = pytest.mark.gpu


@pytest.fixture(autouse=True)
def kernels_run():
    assert module.kernels_run_on(torch.device("cuda", torch.cuda.current_device()))


@pytest.mark.parametrize("ssim_lambda", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("size", [(11, 11), (12, 43), (33, 11), (97, 128), (532, 799), (1200, 1600)])
def test_values_and_gradients(size, ssim_lambda):
    prediction, truth = pair(*size, device="cuda")
    loss = photometric_loss(prediction, truth, ssim_lambda)
    assert type(loss.grad_fn).__name__ == "WeightedSumBackward"
    assert_near(loss, prediction, truth, ssim_lambda, TOLERANCE)


@pytest.mark.parametrize("value", [0.0, 0.9, 1.0])
def test_nearly_flat_images(value):
    generator = torch.Generator().manual_seed(3)
    truth = value + 1e-3 * torch.randn(70, 90, 3, generator=generator)
    prediction = (truth + 1e-3 * torch.randn(70, 90, 3, generator=generator)).cuda().requires_grad_()
    loss = photometric_loss(prediction, truth.cuda(), 1.0)
    expected, gradient = reference(prediction, truth.cuda(), 1.0)
    flat = 2 * MOMENT_ROUNDINGS * ULP / SSIM_C2
    assert (loss - expected).abs() <= flat
    # Slopes are at most 2 / C2 with a relative error of `flat`, and the gradient is made of three.
    windows = 3 * 60 * 80
    error = (torch.autograd.grad(loss, prediction)[0] - gradient).abs().max()
    assert error * windows <= 3 * 2 / SSIM_C2 * flat


def test_twice_is_the_same():
    prediction, truth = pair(270, 333, device="cuda")
    losses = [photometric_loss(prediction, truth, 0.2) for _ in range(2)]
    assert torch.equal(*losses) and torch.equal(*(torch.autograd.grad(loss, prediction)[0] for loss in losses))
    with torch.no_grad():
        assert torch.equal(photometric_loss(prediction, truth, 0.2), losses[0])


def test_images_that_are_not_contiguous_and_upstream_gradients():
    prediction, truth = pair(40, 57, device="cuda")
    turned = prediction.transpose(0, 1)
    (1000.0 * photometric_loss(turned, truth.transpose(0, 1), 0.2)).backward()
    _, gradient = reference(prediction, truth, 0.2)
    assert (prediction.grad / 1000.0 - gradient).abs().max() <= TOLERANCE * gradient.abs().max()


def test_not_a_number_is_seen():
    prediction, truth = pair(50, 50, device="cuda")
    broken = prediction.detach().clone()
    broken[49, 49, 2] = float("nan")
    assert photometric_loss(broken, truth, 0.2).isnan()
