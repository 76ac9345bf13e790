# SPDX-License-Identifier: Apache-2.0
"""Data sets of training views alone, and what trials on them say."""

import json
from pathlib import Path

import pytest
from PIL import Image

from nrfgs_lab.held_out import against_harmonics, effects, held_out, make, report, screening, test_views
from nrfgs_ns.errors import InputError

test_views.__test__ = False  # not a test
STUDY = Path(__file__).resolve().parents[2] / "results" / "held-out.json"


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


def test_gains_are_taken_view_by_view_within_a_group():
    def one(trial, group, views, baseline=False):
        return dict(
            trial=trial, group=group, baseline=baseline, scene="s", offset=4, psnr=1.0, ssim=0.5, per_image=views
        )

    records = [
        one("harmonics", "a", [["x", 20.0, 0.5, 0.6], ["y", 30.0, 0.7, 0.8]], baseline=True),
        one("harmonics", "b", [["x", 0.0, 0.0, 0.0], ["y", 0.0, 0.0, 0.0]], baseline=True),
        one("field", "a", [["y", 31.0, 0.8, 0.9], ["x", 24.0, 0.6, 0.7]]),
    ]
    assert against_harmonics(records)["a, from 4: field"]["s"] == pytest.approx((2.5, 0.1, 2))


def test_effects_of_factors_are_told_apart_and_a_view_that_fails_does_not_decide():
    gain = {"a": (0.3, 0.01), "b": (-0.2, 0.02), "c": (0.0, -0.01)}
    records = []
    for number in range(8):
        on = [name for bit, name in enumerate("abc") if number >> bit & 1]
        views = [
            [name, 20.0 + level + sum(gain[f][0] for f in on), 0.5 + sum(gain[f][1] for f in on), None]
            for level, name in enumerate("xyz")
        ]
        records.append(dict(factors=on, scene="s", offset=(number ^ number >> 1) & 1, per_image=views))
    found = effects(records)
    assert found == {name: pytest.approx(value, abs=1e-9) for name, value in gain.items()}

    records[3]["per_image"][1][1] -= 10.0
    found = effects(records)
    assert all(found[name][0] == pytest.approx(value[0], abs=0.15) for name, value in gain.items())


def test_the_repository_s_study_is_reported():
    table = report(STUDY)
    assert "splatfacto, 6,000 steps, from 4: noise 0.5" in table and "bonsai" in table
    table = screening(STUDY)
    assert "harmonics, fern, 18 trainings" in table and "no opacity residual          +0.25" in table


def test_test_views_are_means_over_seeds(tmp_path):
    common = {"scene": "s", "name": "nrfgs", "made_steps": 10_000, "ssim": 0.5, "ms_ssim": None, "train_psnr": 30.0}
    records = {
        "1": {**common, "psnr": 20.0, "splats": 10, "flip": [0.1, 0.3]},
        "2": {**common, "psnr": 22.0, "splats": 20, "flip": [0.4, 0.4]},
        "3": {**common, "error": "the deadline"},
    }
    (tmp_path / "study.json").write_text(json.dumps({"study": "study", "records": records}))
    row = test_views(tmp_path / "study.json").splitlines()[-1]
    assert row == "| s | nrfgs | 2 | 10,000 | 15 | 21.00 | 0.5000 | - | 0.3000 | 30.00 |"
