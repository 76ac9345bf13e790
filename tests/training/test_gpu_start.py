# SPDX-License-Identifier: Apache-2.0
"""What a training on a GPU has done before its first step."""

import sys

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from short_trainings import command_line, set_up

from nrfgs_ns.kernels.trial import Gate
from nrfgs_ns.training.photographs import compare_photographs

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")]


def tried(model) -> dict[str, set]:
    """What has been found out about kernels, by their name; of the field's, those of this model."""
    modules = [module for name, module in sys.modules.items() if name.startswith("nrfgs_ns.")]
    gates = [value for module in modules for value in vars(module).values() if type(value) is Gate]
    return {gate.what: set(gate) for gate in (*gates, model.head.fused.ready) if gate}


def test_no_kernel_is_left_to_the_first_steps(tiny_scene, tmp_path):
    trainer = set_up(command_line("nrfgs", tiny_scene, tmp_path, 3))
    before = tried(trainer.pipeline.model)
    assert {"The field", "SSIM"} <= before.keys()
    trainer.train()
    assert tried(trainer.pipeline.model) == before


def test_photographs_are_compared_without_memory_that_stays():
    """cuBLAS keeps 32 MiB of an H100 for each thread that multiplies matrices."""
    cameras = Cameras(torch.eye(4)[:3].repeat(8, 1, 1), 30.0, 30.0, 16.0, 16.0, 32, 32)
    images = [{"image": torch.zeros(32, 32, 3, dtype=torch.uint8, device="cuda")} for _ in range(8)]
    before = torch.cuda.memory_allocated()
    compare_photographs(torch.rand(100, 3) - torch.tensor([0.5, 0.5, 2.0]), cameras, images)
    assert torch.cuda.memory_allocated() == before
