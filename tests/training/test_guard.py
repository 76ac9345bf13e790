# SPDX-License-Identifier: Apache-2.0
"""The guard: what stops a training, what is said, and what is left on disk."""

import math

import pytest
import torch
from short_trainings import command_line, set_up, tensors_of

from nrfgs_ns.errors import InputError
from nrfgs_ns.training import guard
from nrfgs_ns.training.checkpoint_files import write
from nrfgs_ns.training.guard import MAX_GRADIENT, TrainingStopped


@pytest.fixture(autouse=True)
def device(request):
    """CUDA is out of reach, but for the test that is about it."""
    if request.node.get_closest_marker("gpu") is None:
        request.getfixturevalue("no_cuda")


NAN, INF = math.nan, math.inf
FULL_SIZE = {"--pipeline.model.num-downscales": 0}


@pytest.fixture
def start(tiny_scene, tmp_path):
    """A trainer that is ready for its first step; `fused` makes its CPU optimisers skip like those on a GPU."""

    def trainer(*more: dict, steps: int = 10, fused: bool = False, method: str = "nrfgs"):
        trainer = set_up(command_line(method, tiny_scene, tmp_path, steps, FULL_SIZE, *more))
        if fused:
            for optimizer in trainer.optimizers.optimizers.values():
                for group in optimizer.param_groups:
                    group["fused"], group["foreach"] = True, False
            assert trainer.optimizers.all_fused
        return trainer

    return trainer


def poison(trainer, at: int, name: str, value: float, row: int = 7) -> None:
    """Put a value into the gradient of a per-splat tensor, or into the loss if the name is "loss", at one step."""
    pipeline, check = trainer.pipeline, trainer.guard.before_optimizers
    model, original = pipeline.model, pipeline.get_train_loss_dict

    def spoilt(step, *how):
        outputs, losses, metrics = original(step, *how)
        if step == at and name == "loss":
            losses["main_loss"] = losses["main_loss"] * value
            model.watched["loss main_loss"] = losses["main_loss"].detach()
        return outputs, losses, metrics

    def checked(*args):
        if trainer.guard.step == at and name != "loss":
            model.gauss_params[name].grad[row] = value
        check(*args)

    pipeline.get_train_loss_dict, trainer.guard.before_optimizers = spoilt, checked


def checkpoints(trainer) -> dict[int, dict]:
    files = trainer.checkpoint_dir.glob("*.ckpt")
    return {int(file.stem.split("-")[1]): torch.load(file, weights_only=True) for file in files}


def numbers(state) -> dict[str, torch.Tensor]:
    """Every floating point tensor of a checkpoint, by path."""
    parts = {name: state[name] for name in ("pipeline", "optimizers")}
    return {path: value for path, value in tensors_of(parts).items() if value.is_floating_point()}


def state_of(trainer) -> dict:
    """What a checkpoint would hold now."""
    optimizers = {name: optimizer.state_dict() for name, optimizer in trainer.optimizers.optimizers.items()}
    return {"pipeline": trainer.pipeline.state_dict(), "optimizers": optimizers}


@pytest.mark.parametrize("fused, name, value", [(False, "loss", NAN), (True, "means", NAN), (True, "scales", 1e19)])
def test_a_condemned_step_leaves_parameters_and_moments_as_they_were(start, fused, name, value):
    trainer = start(fused=fused)
    poison(trainer, at=3, name=name, value=value)
    before, original = {}, trainer.guard.before_optimizers

    def remember(*args):
        if trainer.step == 3:
            before.update({path: tensor.clone() for path, tensor in numbers(state_of(trainer)).items()})
        original(*args)

    trainer.guard.before_optimizers = remember
    with pytest.raises(TrainingStopped, match="stopped at step 3") as stopped:
        trainer.train()
    assert stopped.value.step == 3
    message, count = str(stopped.value), trainer.pipeline.model.num_points
    parts = ("loss main_loss",) if name == "loss" else (f"the gradient of {name}", f"1 of {count} splats, first 7.")
    for part in (*parts, "Likely cause: ", "The update of step 3 was not made."):
        assert part in message, message
    ((step, state),) = checkpoints(trainer).items()
    assert step == 3
    after = numbers(state)
    statistics = "_extra_state/"  # densification counted the step; its numbers must be finite, not the same
    same = {path for path in after if statistics not in path}
    assert same == {path for path in before if statistics not in path}
    assert any("exp_avg_sq" in path for path in same)
    assert [path for path in same if not torch.equal(after[path], before[path])] == []
    assert all(torch.isfinite(tensor).all() for tensor in after.values())
    again = start({"--load-dir": trainer.checkpoint_dir}, steps=5)
    again.train()
    assert again._start_step == 4 and max(checkpoints(again)) == 4


def test_a_condemned_last_step_is_reported_too(start):
    trainer = start(fused=True, steps=3)
    poison(trainer, at=2, name="quats", value=INF)
    with pytest.raises(TrainingStopped, match="step 2"):
        trainer.train()
    assert set(checkpoints(trainer)) == {2}


def test_large_gradients_that_adam_can_square_pass(start):
    trainer = start()
    poison(trainer, at=3, name="scales", value=MAX_GRADIENT / 2)
    trainer.train()
    moments = trainer.optimizers.optimizers["scales"].state_dict()["state"][0]["exp_avg_sq"]
    assert torch.isfinite(moments).all() and moments.max() > 1e33


@pytest.mark.filterwarnings("error:Converting a tensor")
@pytest.mark.parametrize("name, cause", [
    ("loss", r"the image or mask is broken: .*view_\d+.png"), ("scales", "Lower --optimizers.scales.optimizer.lr")
])  # fmt: skip
def test_the_likely_cause(name, cause, start):
    trainer = start()
    if name == "scales":
        trainer.pipeline.model.scales.data[3] = 25.0
    poison(trainer, at=2, name=name, value=NAN, row=3)
    with pytest.raises(TrainingStopped, match=cause):
        trainer.train()


def test_a_splat_that_is_not_finite_is_named_and_left_out(start):
    trainer = start(steps=3)
    count = trainer.pipeline.model.num_points
    trainer.pipeline.model.gauss_params["latents"].data[11] = NAN
    with pytest.raises(TrainingStopped, match="gauss_params.latents has NaN") as stopped:
        trainer.train()
    assert f"1 of {count} splats, first 11." in str(stopped.value)
    ((_, state),) = checkpoints(trainer).items()
    found = numbers(state)
    assert len(state["pipeline"]["_model.gauss_params.means"]) == count - 1
    assert all(torch.isfinite(tensor).all() for tensor in found.values())
    start({"--load-dir": trainer.checkpoint_dir}).train()


@pytest.mark.parametrize("name", ["head.low.0.weight", "gauss_params.quats"])
def test_weights_or_all_splats_that_are_not_finite_are_never_written_nor_read(name, start):
    trainer = start(steps=2)
    trainer.train()
    ((step, state),) = checkpoints(trainer).items()
    trainer.pipeline.model.get_parameter(name).data[:, 0] = NAN
    with pytest.raises(TrainingStopped, match=f"(?s){name} has NaN.*Nothing has been written"):
        trainer.save_checkpoint(5)
    assert set(checkpoints(trainer)) == {step}
    state["pipeline"]["_model.gauss_params.means"].view(-1)[4] = INF
    write(trainer.checkpoint_dir, step, state)
    with pytest.raises(InputError, match="'gauss_params.means'.*not finite"):
        start({"--load-dir": trainer.checkpoint_dir})


def test_weights_that_overflow_stop_the_training(start):
    """Hidden units that overflow, and second weights of both signs: NaN. Splats whose colours are NaN are not drawn,
    but heard. (1e20 in both layers is NaN or saturated, by the order in which a machine adds with fused products.)"""
    trainer = start({"--pipeline.model.warmup-steps": 0})
    first, second = trainer.pipeline.model.head.low[0], trainer.pipeline.model.head.low[2]
    for layer, scale in ((first, 1e38), (second, 1.0)):
        torch.nn.init.uniform_(layer.weight.data, -3.0, 3.0)
        layer.weight.data *= scale
    with pytest.raises(TrainingStopped, match="Lower --optimizers.field.optimizer.lr"):
        trainer.train()


@pytest.mark.gpu
@pytest.mark.parametrize(("name", "value"), [("means", NAN), ("latents", INF), ("loss", NAN)])
def test_on_a_gpu(start, name, value):
    """The verdict stays on the device; parameters and moments are those of before, and training goes on."""
    trainer = start()
    assert trainer.optimizers.all_fused
    poison(trainer, at=3, name=name, value=value)
    for step in range(3):
        trainer.train_iteration(step)
    before = {path: tensor.cpu().clone() for path, tensor in numbers(state_of(trainer)).items()}
    trainer.train_iteration(3)
    with pytest.raises(TrainingStopped, match="step 3"):
        trainer.train_iteration(4)
    ((step, state),) = checkpoints(trainer).items()
    after = {path: tensor.cpu() for path, tensor in numbers(state).items()}
    assert step == 3 and after.keys() == before.keys()
    assert [path for path in before if "_extra_state" not in path and not torch.equal(after[path], before[path])] == []
    start({"--load-dir": trainer.checkpoint_dir}).train()


def test_a_training_in_which_nothing_is_visible_stops(start, monkeypatch):
    monkeypatch.setattr(guard, "PATIENCE", 5)
    trainer = start()
    with torch.no_grad():
        trainer.pipeline.model.gauss_params["means"] += 1e6
    with pytest.raises(TrainingStopped, match="No splat has been visible in the last 5 steps") as stopped:
        trainer.train()
    assert stopped.value.step == 5 and list(checkpoints(trainer)) == [5]


@pytest.mark.parametrize("method, steps", [("nrfgs", 20), ("nrfgs", 11), ("nrfgs-sh", 11)])
def test_a_training_without_splats_stops_and_saves_nothing(method, steps, start):
    """Nor at its end, nor a head without weights."""
    strategy = "splatfacto,warmup_length=1,refine_every=2,cull_alpha_thresh=0.49"
    trainer = start({"--pipeline.model.densification": strategy}, steps=steps, method=method)
    with pytest.raises(TrainingStopped, match=f"No splat is left in step {min(steps - 1, 11)}: all were") as stopped:
        trainer.train()
    assert stopped.value.origin == "nothing visible" and not checkpoints(trainer)
