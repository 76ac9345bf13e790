# SPDX-License-Identifier: Apache-2.0
"""Which splats go once growth has ended, and when."""

import pytest
import torch
from densification_cases import Table, arguments, strategy, trainer_of
from torch.testing import assert_close

from nrfgs_ns.densification import Splatfacto
from nrfgs_ns.densification.thinning import ROUNDS, least_missed, missed
from nrfgs_ns.errors import InputError
from nrfgs_ns.image.robust import Trimming
from nrfgs_ns.model.training_views import TrainingPictures
from nrfgs_ns.training.trainer_config import parse

pytestmark = pytest.mark.usefixtures("no_cuda")


class Missing:
    """Training views of which view j would miss the latent of each splat, times j; they see all but the first."""

    def __init__(self, table: Table):
        self.table = table

    def __len__(self) -> int:
        return 3

    def changes_without(self, index, generator, passes):
        rows = torch.arange(1, len(self.table))
        return rows, index * self.table.splats["latents"].detach()[rows, 0]


def thinning(table: Table, name: str = "splatfacto", **options):
    chosen = strategy(name, keep=1 / 64, **options)
    chosen.begin(torch.zeros(1, 3), Missing(table), len(table))
    return chosen


def left(table: Table) -> list[int]:
    return sorted(table.splats["latents"][:, 0].long().tolist())


@pytest.mark.parametrize("name", ["splatfacto", "original"])
def test_the_least_missed_go_in_six_rounds_after_growth(name):
    table = Table(64)
    chosen = thinning(table, name)
    rounds = ((16_500, 16), (18_000, 8), (19_500, 4), (21_000, 2), (22_499, 2), (22_500, 1), (29_999, 1))
    for step, count in ((14_999, 64), (15_000, 32), (15_001, 32), (16_499, 32), *rounds):
        table.step(chosen, step)
        assert len(table) == count, step
        assert left(table) == list(range(64 - count, 64))
        table.check()


def test_rounds_follow_the_pace_and_a_continued_training():
    """In a fifth of the schedule's steps: 3,000, 3,300 and so on. What a checkpoint has done is not done again."""
    table = Table(64)
    chosen = thinning(table)
    chosen.reschedule(lambda position: round(position / 5))
    for step, count in ((2999, 64), (3000, 32), (3300, 16)):
        table.step(chosen, step)
        assert len(table) == count
    again = thinning(table)
    again.load_state(chosen.state, torch.device("cpu"))
    # Positions that are behind are at step 0 then.
    again.reschedule(lambda position: round(position / 5) if position > 16_500 else 0)
    for step, count in ((3301, 16), (3599, 16), (3600, 8), (4500, 4), (4501, 2), (4502, 1), (5999, 1)):
        table.step(again, step)
        assert len(table) == count


def test_all_stay_by_default():
    table = Table(8)
    chosen = strategy("splatfacto")
    for step in (15_000, 16_500, 22_500):
        table.step(chosen, step)
    assert len(table) == 8


def test_one_splat_is_left_at_least():
    assert least_missed(torch.tensor([1.0, 3.0, 2.0]), 1e-9).tolist() == [True, False, True]


def test_scores_are_summed_over_the_views():
    table = Table(4)
    assert missed(Missing(table), 4, torch.device("cpu")).tolist() == [0.0, 3.0, 6.0, 9.0]


@pytest.fixture(scope="module")
def training(tiny_scene, tmp_path_factory):
    trainer = trainer_of(tiny_scene, tmp_path_factory.mktemp("out"), "splatfacto")
    model = trainer.pipeline.model
    model.train()
    model.step_cb(trainer.optimizers, 0)
    return trainer


def test_a_view_misses_what_its_picture_shows(training, monkeypatch):
    """The sum over some splats of squared changes, against pictures without them. Masked pixels do not count."""
    model, data = training.pipeline.model, training.pipeline.datamanager
    mask = torch.zeros(36, 48, 1)
    mask[:, 24:] = 1.0
    monkeypatch.setitem(data.cached_train[2], "mask", mask)
    rows, changes = TrainingPictures(model, data).changes_without(2, torch.Generator().manual_seed(1), 50)
    camera, batch = data.train_view(2)
    view = model.project(camera)
    assert torch.equal(rows, view.visible) and not changes.requires_grad
    with torch.no_grad():
        appearance = model.field.seen_from(view)
        whole = model.picture(view, appearance, camera, model.background_color)[0]["rgb"]
        most = changes.topk(10).indices
        expected = []
        for row in most:
            opacities = appearance.opacities.clone()
            opacities[row] = 0.0
            fewer = model.picture(view, appearance._replace(opacities=opacities), camera, model.background_color)[0][
                "rgb"
            ]
            expected.append(((fewer - whole)[:, 24:]).square().sum())
    # 50 drawings: a standard deviation is at most sqrt(2 / 50) = 0.2 of one splat's sum, and 0.06 of ten splats'.
    assert_close(changes[most], torch.stack(expected), rtol=0.5, atol=0)
    assert_close(changes[most].sum(), torch.stack(expected).sum(), rtol=0.15, atol=0)


def test_pictures_change_less_without_the_least_missed_than_without_others(training):
    model, data = training.pipeline.model, training.pipeline.datamanager
    score = missed(TrainingPictures(model, data), model.num_points, torch.device("cpu"))
    others = torch.randperm(len(score), generator=torch.Generator().manual_seed(1)) < len(score) // 2
    least = torch.ones(len(score), dtype=torch.bool).index_fill(
        0, score.topk(len(score) - int(others.sum())).indices, 0
    )
    assert least.sum() == others.sum()

    def change(gone: torch.Tensor) -> float:
        total = 0.0
        for index in range(len(data.train_dataset)):
            camera, batch = data.train_view(index)
            view = model.project(camera)
            with torch.no_grad():
                appearance = model.field.seen_from(view)
                fewer = appearance._replace(opacities=appearance.opacities * ~gone[view.visible])
                one, other = (
                    model.picture(view, a, camera, model.background_color)[0]["rgb"] for a in (appearance, fewer)
                )
            total += (one - other).square().sum().item()
        return total

    assert change(least) < 0.3 * change(others)


def test_what_the_robust_loss_leaves_out_is_not_missed(training, monkeypatch):
    """Pixels with residuals above 0.02 do not count."""
    model, data = training.pipeline.model, training.pipeline.datamanager

    def changes():
        return TrainingPictures(model, data).changes_without(3, torch.Generator().manual_seed(1), 20)[1]

    all_pixels, trimming = changes(), Trimming(0.5)
    trimming.histogram[:20] = 1.0
    monkeypatch.setattr(model, "trimming", trimming)
    monkeypatch.setattr(model, "_scheduled", 1000)
    before = trimming.histogram.clone()
    fewer = changes()
    assert 0 < fewer.sum() < 0.9 * all_pixels.sum()
    assert torch.equal(trimming.histogram, before)


@pytest.mark.parametrize("keep", [0.0, 1.5, float("nan")])
def test_shares_that_are_none_are_refused(keep):
    with pytest.raises(InputError, match="keep is"):
        Splatfacto(keep=keep).check()


def test_a_training_that_ends_before_the_last_round_is_refused(tiny_scene, tmp_path):
    words = arguments(tiny_scene, tmp_path, "splatfacto", steps=20_000, keep=0.5)
    with pytest.raises(InputError, match="the last splats go at step 22500 of 20000"):
        parse(words).setup(local_rank=0, world_size=1)


def test_several_devices_are_refused(tiny_scene, tmp_path):
    with pytest.raises(InputError, match="keep is 0.5, which is for one device"):
        parse(arguments(tiny_scene, tmp_path, "splatfacto", steps=30_000, keep=0.5)).setup(local_rank=0, world_size=2)


def test_a_training_keeps_a_half(tiny_scene, tmp_path, monkeypatch):
    """Growth ends before it begins; the rounds are at steps 10 to 15. Which splats go, other tests look at."""
    monkeypatch.setattr("nrfgs_ns.densification.thinning.DRAWS", 8)
    trainer = trainer_of(tiny_scene, tmp_path, "splatfacto", stop_split_at=10, keep=0.5)
    model = trainer.pipeline.model
    before = model.num_points
    trainer.train()
    assert model.densification.state["thinned"] == len(ROUNDS)
    assert model.num_points == pytest.approx(before / 2, abs=3)
