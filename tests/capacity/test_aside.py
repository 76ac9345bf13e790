# SPDX-License-Identifier: Apache-2.0
"""Training views that are set aside are not trained on, and come back."""

from types import SimpleNamespace

import pytest

from nrfgs_ns.capacity.aside import ViewsAside, spread
from nrfgs_ns.errors import InputError
from nrfgs_ns.studies.run import parse

pytestmark = pytest.mark.usefixtures("no_cuda")


def manager(scene, tmp_path, strategy: str = "random"):
    """A datamanager of 8 training views."""
    config = parse(["nrfgs", "--data", str(scene), "--output-dir", str(tmp_path)])
    config.pipeline.datamanager.train_cameras_sampling_strategy = strategy
    config.pipeline.datamanager.fps_reset_every = 4
    return config.pipeline.datamanager.setup(device="cpu")


def turns(data, count: int) -> list[int]:
    return [data.next_train(0)[0].metadata["cam_idx"] for _ in range(count)]


@pytest.mark.parametrize("strategy", ["random", "fps"])
def test_they_have_no_turn_until_they_are_given_back(strategy, tiny_scene, tmp_path):
    data = manager(tiny_scene, tmp_path, strategy)
    data.set_views_aside([6, 1])
    assert data.views_aside == [1, 6]
    assert set(turns(data, 40)) == {0, 2, 3, 4, 5, 7}
    camera, batch = data.train_view(6)
    assert camera.metadata["cam_idx"] == batch["image_idx"] == 6
    data.give_back_views()
    assert set(turns(data, 40)) == set(range(8))


def test_other_views_keep_their_turns(tiny_scene, tmp_path):
    """Setting aside draws no number: the others come in the order in which they would have come."""
    one, other = manager(tiny_scene, tmp_path), manager(tiny_scene, tmp_path)
    one.set_views_aside([0, 5])
    expected = [index for index in turns(other, 80) if index not in (0, 5)]
    assert turns(one, 60) == expected


def test_setting_all_of_a_round_aside_begins_the_next(tiny_scene, tmp_path):
    data = manager(tiny_scene, tmp_path)
    data.train_unseen_cameras = [3]
    data.set_views_aside([3])
    assert len(set(turns(data, 7))) == 7


def test_they_are_part_of_the_sampling_state(tiny_scene, tmp_path):
    data, again = manager(tiny_scene, tmp_path), manager(tiny_scene, tmp_path)
    data.set_views_aside([2, 4])
    turns(data, 3)
    again.load_sampling_state(data.sampling_state())
    assert again.views_aside == [2, 4] and turns(again, 20) == turns(data, 20)
    older = data.sampling_state()
    del older["views_aside"]
    again.load_sampling_state(older)
    assert again.views_aside == []


def decider(views=None, until=9, stretched=False):
    return SimpleNamespace(
        option="an option",
        last_decision=until,
        stretched=stretched,
        views_wanted=lambda: views,
        is_done=lambda step: step >= until,
    )


class Data:
    """What `ViewsAside` asks of a datamanager."""

    def __init__(self, aside=()):
        self.train_dataset, self.views_aside = [None] * 24, list(aside)

    def set_views_aside(self, indices):
        self.views_aside = indices

    def give_back_views(self):
        self.views_aside = []


def test_they_come_back_when_the_last_decision_is_made():
    data = Data()
    aside = ViewsAside(data, [decider(2, until=5), decider(4, until=9)], 0)
    assert data.views_aside == [3, 9, 15, 21]
    for step in range(20):
        aside.after_step(step)
        assert bool(data.views_aside) == (step < 9), step


@pytest.mark.parametrize("deciders", [[], [decider(until=5)]])
def test_a_checkpoints_views_come_back_if_nobody_needs_them(deciders):
    data = Data([3, 9])
    ViewsAside(data, deciders, start=6)
    assert data.views_aside == []


def test_a_checkpoints_views_stay_aside():
    data = Data([1, 2])
    ViewsAside(data, [decider(4)], start=6)
    assert data.views_aside == [1, 2]


def test_views_that_were_trained_on_cannot_decide():
    with pytest.raises(InputError, match="an option decides by views .* for 6 steps"):
        ViewsAside(Data(), [decider()], start=6)


@pytest.mark.parametrize("count, views, expected", [(8, None, 2), (24, None, 3), (1000, None, 16), (9, 5, 5)])
def test_how_many_and_which(count, views, expected):
    chosen = spread(count, [decider(views)])
    assert len(set(chosen)) == expected and 0 <= min(chosen) and max(chosen) < count
    gaps = [b - a for a, b in zip(chosen[:-1], chosen[1:], strict=True)]
    assert max(gaps) - min(gaps) <= 1


@pytest.mark.parametrize("count, warned", [(24, False), (8, False), (7, True), (3, True)])
def test_how_many_are_set_aside_is_told(count, warned, capsys):
    data = Data()
    data.train_dataset = [None] * count
    ViewsAside(data, [decider()], 0)
    said = " ".join(capsys.readouterr().out.split())
    assert f"{len(data.views_aside)} of {count} training views are set aside until step 9" in said
    assert ("that is much" in said) == warned


def test_until_when_is_told_in_the_deciders_own_steps(capsys):
    ViewsAside(Data(), [decider(until=9), decider(until=7), decider(until=300, stretched=True)], 0)
    said = " ".join(capsys.readouterr().out.split())
    assert "are set aside until step 9 and step 300 of the schedules, to decide" in said


def test_who_has_decided_asks_for_no_view():
    data = Data()
    ViewsAside(data, [decider(6, until=-1), decider(2)], 0)
    assert len(data.views_aside) == 2


def test_not_all_views():
    with pytest.raises(InputError, match="sets 8 training views aside, of 8"):
        spread(8, [decider(8)])
