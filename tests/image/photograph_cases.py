# SPDX-License-Identifier: Apache-2.0
"""What the kernels of a photograph's exposure are held against: the same in PyTorch, in float64."""

import torch

from nrfgs_ns.image.photograph import PhotographModel

LENSES = torch.tensor([[0.5, 0.5, 1.0, 1.5]])
TOLERANCE = 2e-6
"""Of numbers near 1 after a dozen roundings of float32."""


def case(height: int, width: int, parts, spread: float, seed: int = 0, device: str = "cpu"):
    """A model of five photographs whose stops have this spread, a picture that is partly out of [0, 1], and the
    gradient of what becomes of it."""
    torch.manual_seed(seed)
    model = PhotographModel([str(index) for index in range(5)], [0] * 5, LENSES, parts, spread * torch.randn(5, 3))
    image, d_taken = 1.6 * torch.rand(height, width, 3) - 0.3, torch.randn(height, width, 3)
    return model.to(device), image.to(device).requires_grad_(), d_taken.to(device)


def assert_near(taken, model, image, d_taken, index: int) -> None:
    """Compare a picture that the kernels have made, and its gradients, with PyTorch's in float64."""
    gradients = torch.autograd.grad((taken * d_taken).sum(), (image, model.shots))
    shots = model.shots.detach().double().requires_grad_()
    twin, picture = model.double(), image.detach().double().requires_grad_()
    with torch.nn.utils.stateless._reparametrize_module(twin, {"shots": shots}):
        expected = twin(picture, index)
        wanted = torch.autograd.grad((expected * d_taken.double()).sum(), (picture, shots))
    assert (taken.double() - expected).abs().max() <= TOLERANCE
    sure = ((expected > TOLERANCE) & (expected < 1 - TOLERANCE)) | (picture < -0.1) | (picture > 1.4)
    difference = (gradients[0].double() - wanted[0]).abs()[sure]
    assert difference.max() <= TOLERANCE * wanted[0].abs().max()
    assert (gradients[1].double() - wanted[1]).abs().max() <= 2e-5 * wanted[1].abs().max() + 1e-4
    others = [other for other in range(5) if other != index]
    assert (gradients[1][others] == 0).all() and (gradients[1][index] != 0).all()
