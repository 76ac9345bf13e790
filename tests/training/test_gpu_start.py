# SPDX-License-Identifier: Apache-2.0
"""What a training on a GPU has done before its first step."""

import sys

import pytest
import torch
from short_trainings import command_line

from nrfgs_ns.kernels.trial import Gate
from nrfgs_ns.training.run import parse

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")]


def tried(model) -> dict[str, set]:
    """What has been found out about kernels, by their name; of the field's, those of this model."""
    modules = [module for name, module in sys.modules.items() if name.startswith("nrfgs_ns.")]
    gates = [value for module in modules for value in vars(module).values() if type(value) is Gate]
    return {gate.what: set(gate) for gate in (*gates, model.head.fused.ready) if gate}


def test_no_kernel_is_left_to_the_first_steps(tiny_scene, tmp_path):
    trainer = parse(command_line("nrfgs", tiny_scene, tmp_path, 3)).setup(local_rank=0, world_size=1)
    trainer.setup()
    before = tried(trainer.pipeline.model)
    assert {"The field", "SSIM"} <= before.keys()
    trainer.train()
    assert tried(trainer.pipeline.model) == before
