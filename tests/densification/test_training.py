# SPDX-License-Identifier: Apache-2.0
"""Densification in a training: the losses that it adds, and that a continued training cannot tell."""

from pathlib import Path

import pytest
from densification_cases import arguments
from short_trainings import assert_same_training, checkpoint_of, models_of, set_up, trained

from nrfgs_ns.densification import CHANGE, UNSEEN, memory
from nrfgs_ns.densification.strategy import GROWTH_LIMIT
from nrfgs_ns.errors import InputError
from nrfgs_ns.training.checkpoint_files import read_latest

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


HALF = 13
"""A checkpoint after this step of 26 lies between two refinements, with statistics in flight."""


@pytest.fixture
def run(tiny_scene, tmp_path):
    """A function: config.yml of a training by a strategy, whole or from a folder's checkpoint of step HALF on."""

    def run(name: str, densification: str, steps: int, load: Path | None = None, **rules) -> Path:
        args = arguments(tiny_scene, tmp_path / name, densification, steps, **rules)
        more = ["--load-dir", str(load), "--load-step", str(HALF)] if load else ["--steps-per-save", str(HALF)]
        return trained([*args, *more])

    return run


@pytest.mark.parametrize(
    "densification, seen", [("splatfacto", "peak"), ("original", "base"), ("mcmc", "peak"), ("error-guided", "peak")]
)
def test_resumed_training_is_the_unbroken_one(densification, seen, run):
    rules = {"opacity_seen": seen}
    if densification == "mcmc":
        rules["budget"] = 330  # from 300: growth of 5 % at steps 4, 8, ... reaches it in the first half
    config = run("whole", densification, 26, **rules)
    rest = checkpoint_of(run("rest", densification, 26, models_of(config), **rules))
    half, whole = (read_latest(models_of(config), step)[1] for step in (HALF, 25))
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
    whole = run("whole", densification, 26)
    rest = checkpoint_of(run("rest", densification, 26, models_of(whole)))
    assert_same_training(checkpoint_of(whole), rest, rtol=0, atol=0)
    assert 300 <= len(rest["pipeline"]["_model.gauss_params.means"]) <= 310
    assert rest["pipeline"]["_model._extra_state"]["strategy"][GROWTH_LIMIT] == (310, 0)


def test_another_strategies_checkpoint_is_refused(run):
    with pytest.raises(InputError, match="densification original"):
        run("b", "mcmc", 20, models_of(run("a", "original", HALF + 1)))
