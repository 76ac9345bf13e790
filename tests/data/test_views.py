# SPDX-License-Identifier: Apache-2.0
"""Training views that are held out are not trained on, and come back."""

import pytest

from nrfgs_ns.data.views import evenly_spaced, held_out
from nrfgs_ns.errors import InputError
from nrfgs_ns.training.run import parse

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
    data.hold_out([6, 1])
    assert data.held_out_views == [1, 6]
    assert set(turns(data, 40)) == {0, 2, 3, 4, 5, 7}
    camera, batch = data.train_view(6)
    assert camera.metadata["cam_idx"] == batch["image_idx"] == 6
    data.give_back_views()
    assert set(turns(data, 40)) == set(range(8))


def test_other_views_keep_their_turns(tiny_scene, tmp_path):
    """Holding out draws no number: the others come in the order in which they would have come."""
    one, other = manager(tiny_scene, tmp_path), manager(tiny_scene, tmp_path)
    one.hold_out([0, 5])
    expected = [index for index in turns(other, 80) if index not in (0, 5)]
    assert turns(one, 60) == expected


def test_holding_all_of_a_round_out_begins_the_next(tiny_scene, tmp_path):
    data = manager(tiny_scene, tmp_path)
    data.train_unseen_cameras = [3]
    data.hold_out([3])
    assert len(set(turns(data, 7))) == 7


def test_they_are_part_of_the_sampling_state(tiny_scene, tmp_path):
    data, again = manager(tiny_scene, tmp_path), manager(tiny_scene, tmp_path)
    data.hold_out([2, 4])
    turns(data, 3)
    again.load_sampling_state(data.sampling_state())
    assert again.held_out_views == [2, 4] and turns(again, 20) == turns(data, 20)
    older = data.sampling_state()
    del older["views_aside"]
    again.load_sampling_state(older)
    assert again.held_out_views == []


@pytest.mark.parametrize("total, wanted, expected", [(8, None, 2), (24, None, 3), (1000, None, 16), (9, 5, 5)])
def test_how_many_and_which(total, wanted, expected):
    chosen = held_out(total, wanted)
    assert len(set(chosen)) == expected and 0 <= min(chosen) and max(chosen) < total
    gaps = [b - a for a, b in zip(chosen[:-1], chosen[1:], strict=True)]
    assert max(gaps) - min(gaps) <= 1


def test_not_all_views():
    with pytest.raises(InputError, match="8 of 8 training views cannot be held out"):
        held_out(8, 8)


@pytest.mark.parametrize(
    "total, wanted, expected", [(10, 4, [0, 2, 5, 7]), (3, 5, [0, 1, 2]), (5, 5, [0, 1, 2, 3, 4]), (5, 0, [])]
)
def test_evenly_spaced(total, wanted, expected):
    assert evenly_spaced(total, wanted) == expected
