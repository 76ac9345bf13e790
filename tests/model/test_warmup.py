# SPDX-License-Identifier: Apache-2.0
"""The warm-up does what it says: a field that starts loud is taught to add nothing, and nothing else moves."""

import pytest
import torch
from nerfstudio.utils.rich_utils import CONSOLE

from nrfgs_ns.model.warmup import warm_up


@pytest.fixture
def build(tiny_scene, tmp_path, no_cuda):
    from nrfgs_ns.training.trainer_config import parse

    def pipeline(method="nrfgs", *options):
        config = parse([method, "--data", str(tiny_scene), "--output-dir", str(tmp_path), *options])
        torch.manual_seed(0)
        return config.pipeline.setup(device="cpu", test_mode="val")

    return pipeline


def residual(model, cameras) -> float:
    """Root mean square residual over all cameras."""
    losses = []
    for index in range(len(cameras)):
        view = model.project(cameras[index : index + 1])
        losses.append(model.head.neutral_loss(model.field.splats, view.visible, view.center))
    return torch.stack(losses).mean().sqrt().item()


def test_it_quiets_a_loud_field_and_moves_nothing_else(build):
    pipeline = build("nrfgs", "--pipeline.model.appearance.output-init", "default")
    model, cameras = pipeline.model, pipeline.datamanager.train_dataset.cameras
    splats = {name: value.detach().clone() for name, value in model.gauss_params.items()}
    before = residual(model, cameras)
    with CONSOLE.capture() as log:
        warm_up(model, cameras, steps=50)
    after = residual(model, cameras)
    assert before > 0.01
    assert after < before / 3
    assert f"from {before:.2g}"[:8] in log.get() and "50 steps" in log.get()
    for name, value in model.gauss_params.items():
        assert torch.equal(value, splats[name]) and value.grad is None
    assert all(weight.grad is None for weight in model.head.parameters())


def test_zero_outputs_have_nothing_to_learn(build):
    pipeline = build()
    weights = [weight.detach().clone() for weight in pipeline.model.head.parameters()]
    with CONSOLE.capture() as log:
        warm_up(pipeline.model, pipeline.datamanager.train_dataset.cameras, steps=50)
    assert log.get() == ""
    assert all(torch.equal(a, b) for a, b in zip(weights, pipeline.model.head.parameters(), strict=True))


def test_heads_without_shared_weights_are_left_alone(build):
    pipeline = build("nrfgs-sh")
    with CONSOLE.capture() as log:
        warm_up(pipeline.model, pipeline.datamanager.train_dataset.cameras, steps=50)
    assert log.get() == ""


@pytest.mark.parametrize("option, steps", [((), 8), (("--pipeline.model.warmup-steps", "3"), 3)])
def test_training_starts_with_one_step_per_view_or_as_many_as_asked(build, monkeypatch, option, steps):
    from nerfstudio.engine.callbacks import TrainingCallbackAttributes, TrainingCallbackLocation

    asked = []
    monkeypatch.setattr("nrfgs_ns.model.model.warm_up", lambda model, cameras, steps: asked.append(steps))
    pipeline = build("nrfgs", *option)
    attributes = TrainingCallbackAttributes(optimizers=None, grad_scaler=None, pipeline=pipeline, trainer=None)
    first = pipeline.get_training_callbacks(attributes)[0]
    for step in range(3):
        first.run_callback_at_location(step, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
    assert asked == [steps], "once, before step 0"
