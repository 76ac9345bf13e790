# SPDX-License-Identifier: Apache-2.0
"""Densification in a training: the losses that it adds, and that a continued training cannot tell."""

import pytest
from densification_cases import arguments
from short_trainings import assert_same_training, checkpoint_of, models_of, set_up, trained

from nrfgs_ns.densification import CHANGE, UNSEEN, memory
from nrfgs_ns.densification.strategy import GROWTH_LIMIT
from nrfgs_ns.errors import InputError

pytestmark = pytest.mark.usefixtures("no_cuda")


def test_mcmc_regularises_the_loss_in_training_only(tiny_scene, tmp_path):
    trainer = set_up(arguments(tiny_scene, tmp_path, "mcmc"))
    model = trainer.pipeline.model
    camera, batch = trainer.pipeline.datamanager.next_train(0)
    model.step_cb(trainer.optimizers, 0)
    losses = model.get_loss_dict(model(camera), batch)
    assert losses["mcmc_opacity_reg"].item() == pytest.approx(0.01 * 0.1, rel=1e-5)  # splats start at 0.1
    assert losses["mcmc_scale_reg"].item() == pytest.approx(0.01 * model.scales.exp().mean().item(), rel=1e-5)
    model.eval()
    assert not any(name.startswith("mcmc") for name in model.get_loss_dict(model(camera), batch))


def test_the_extent_is_that_of_the_training_cameras(tiny_scene, tmp_path):
    trainer = set_up(arguments(tiny_scene, tmp_path, "original"))
    centers = trainer.pipeline.datamanager.train_dataset.cameras.camera_to_worlds[:, :3, 3]
    expected = 1.1 * (centers - centers.mean(0)).norm(dim=1).max().item()
    assert trainer.pipeline.model.densification.state["scene_scale"] == pytest.approx(expected)


@pytest.fixture
def run(tiny_scene, tmp_path):
    """A function: the last checkpoint of a training by a strategy, and the checkpoints' folder."""

    def run(name: str, densification: str, steps: int, load: dict | None = None, **rules) -> dict:
        args = arguments(tiny_scene, tmp_path / name, densification, steps, **rules)
        config = trained([*args, *(["--load-dir", load["folder"]] if load else [])])
        return checkpoint_of(config) | {"folder": str(models_of(config))}

    return run


@pytest.mark.parametrize(
    "densification, seen", [("splatfacto", "peak"), ("original", "base"), ("mcmc", "peak"), ("error-guided", "peak")]
)
def test_resumed_training_is_the_unbroken_one(densification, seen, run):
    """26 steps at once, and 14 and 12 more: the checkpoint lies between two refinements, with statistics in flight."""
    rules = {"opacity_seen": seen}
    if densification == "mcmc":
        rules["budget"] = 330  # from 300: growth of 5 % at steps 4, 8, ... reaches it in the first half
    whole, half = (run(name, densification, steps, **rules) for name, steps in (("whole", 26), ("half", 14)))
    rest = run("rest", densification, 26, half, **rules)
    assert whole["step"] == rest["step"] == 25
    counts = [len(part["pipeline"]["_model.gauss_params.means"]) for part in (half, whole)]
    if densification == "mcmc":
        assert counts == [330, 330]
    else:
        assert counts[0] != counts[1], "nothing was densified in the second half: the test would prove nothing"
    strategy = half["pipeline"]["_model._extra_state"]["strategy"]
    assert (CHANGE in strategy) == (seen == "peak")
    if seen == "peak":
        assert strategy[CHANGE].max() > UNSEEN
    assert_same_training(whole, rest, rtol=0, atol=0)


@pytest.mark.parametrize("densification", ["splatfacto", "mcmc", "error-guided"])
def test_growth_that_memory_holds_is_held_in_a_continued_training(densification, run, monkeypatch):
    """Whatever memory there seems to be then: it is measured otherwise in another process."""
    measured = iter([310])
    monkeypatch.setattr(memory, "most_splats", lambda *_: next(measured, 10**6))
    rest, measured = run("rest", densification, 26, run("half", densification, 14)), iter([310])
    assert_same_training(run("whole", densification, 26), rest, rtol=0, atol=0)
    assert 300 <= len(rest["pipeline"]["_model.gauss_params.means"]) <= 310
    assert rest["pipeline"]["_model._extra_state"]["strategy"][GROWTH_LIMIT] == (310, 0)


def test_another_strategies_checkpoint_is_refused(run):
    with pytest.raises(InputError, match="densification original"):
        run("b", "mcmc", 20, run("a", "original", 1))
