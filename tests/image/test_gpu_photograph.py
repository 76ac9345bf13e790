# SPDX-License-Identifier: Apache-2.0
"""The kernels of a photograph's exposure on a CUDA device. `pytest -m gpu`."""

import pytest
import torch
from photograph_cases import assert_near, case

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]


@pytest.mark.parametrize("parts", [("exposure",), ("white-balance",), ("exposure", "white-balance")])
@pytest.mark.parametrize("size", [(1, 1), (97, 128), (532, 799), (1200, 1600)])
def test_values_and_gradients(parts, size):
    model, image, d_taken = case(*size, parts, 0.5, device="cuda")
    taken = model(image, 3)
    assert type(taken.grad_fn).__name__ == "ExposedBackward"
    assert_near(taken, model, image, d_taken, 3)


def test_twice_is_the_same():
    model, image, d_taken = case(270, 333, ("exposure", "white-balance"), 0.5, device="cuda")
    one, other = (torch.autograd.grad((model(image, 2) * d_taken).sum(), (image, model.shots)) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


def test_part_of_a_wider_image():
    model, image, d_taken = case(40, 57, ("exposure", "white-balance"), 0.5, device="cuda")
    wide = torch.cat([image, image[..., :1]], dim=-1)
    taken = model(wide[..., :3], 1)
    assert torch.equal(taken, model(image, 1))
    (taken * d_taken).sum().backward()
    assert image.grad.abs().max() > 0
