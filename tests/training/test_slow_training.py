# SPDX-License-Identifier: Apache-2.0
"""Whole trainings."""

import pytest
from short_trainings import PLAIN, SMOKE_STEPS, bound, command_line, gain_bound, trained

from nrfgs_lab.training_run import evaluate


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["fox", "kitchen"])
def test_real_photographs_train_and_the_field_is_ahead_of_harmonics(scene, captures, tmp_path):
    options, reached = {"--pipeline.datamanager.camera-res-scale-factor": 0.125, "--machine.seed": 42}, {}
    for method in ("nrfgs", "nrfgs-sh"):
        args = command_line(method, captures / scene, tmp_path, SMOKE_STEPS, PLAIN, options)
        reached[method] = evaluate(trained(args), tmp_path / f"{method}.json")["psnr"]
    assert all(value > bound(f"{scene}/{method}") for method, value in reached.items()), reached
    assert reached["nrfgs"] - reached["nrfgs-sh"] > gain_bound(scene), reached
