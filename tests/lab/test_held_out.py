# SPDX-License-Identifier: Apache-2.0
"""Data sets of training views alone."""

import json

import pytest
from PIL import Image

from nrfgs_lab.held_out import held_out, make
from nrfgs_ns.errors import InputError


def test_every_eighth_is_held_out_and_more_of_few():
    names = [f"{i:03}" for i in range(74)]
    assert held_out(names, 4) == ["004", "012", "020", "028", "036", "044", "052", "060", "068"]
    assert held_out(names[:17], 4) == ["004", "010", "016"]
    assert not set(held_out(names[:26], 0)) & set(held_out(names[:26], 4))


def test_a_made_capture_has_no_test_view_and_the_same_cameras_at_half_the_size(tiny_scene, tmp_path):
    whole = json.loads((tiny_scene / "transforms.json").read_text())
    names = sorted(frame["file_path"] for frame in whole["frames"])
    whole |= {"train_filenames": names[1:], "test_filenames": names[:1]}
    source = tmp_path / "captures" / "tiny"
    source.mkdir(parents=True)
    for entry in tiny_scene.iterdir():
        (source / entry.name).symlink_to(entry)
    (source / "transforms.json").unlink()
    (source / "transforms.json").write_text(json.dumps(whole))

    make(tmp_path / "captures", tmp_path / "out", offset=2)
    made = json.loads((tmp_path / "out" / "tiny" / "transforms.json").read_text())
    assert made["test_filenames"] == names[1:][2::6]
    assert sorted(made["train_filenames"] + made["test_filenames"]) == names[1:]
    assert (made["w"], made["fl_x"]) == (whole["w"] // 2, pytest.approx(whole["fl_x"] / 2))
    with Image.open(tmp_path / "out" / "tiny" / names[1]) as image:
        assert image.size == (made["w"], made["h"])
    assert not (tmp_path / "out" / "tiny" / names[0]).exists()

    make(tmp_path / "captures", tmp_path / "thin", offset=2, views=2)
    thin = json.loads((tmp_path / "thin" / "tiny" / "transforms.json").read_text())
    left = made["train_filenames"]
    assert thin == {**made, "train_filenames": [left[0], left[len(left) // 2]]}

    (source / "transforms.json").write_text(json.dumps({**whole, "train_filenames": []}))
    with pytest.raises(InputError, match="train_filenames"):
        make(tmp_path / "captures", tmp_path / "out")
