# SPDX-License-Identifier: Apache-2.0
"""Many trainings in few processes."""

import queue
import time

import pytest

from nrfgs_lab.trials import Trial, read_plan, work
from nrfgs_ns.errors import InputError

OPTIONS = "--pipeline.model.num-downscales 0"


def done(trials, scenes, end):
    """What one worker makes of these trials, by key."""
    waiting, results = queue.Queue(), queue.Queue()
    for trial in trials:
        waiting.put(trial)
    work(waiting, results, scenes, end)
    return {trial.key: found for trial, found in (results.get_nowait() for _ in trials)}


def test_a_plan_is_read_in_its_order(tmp_path):
    file = tmp_path / "plan.yaml"
    file.write_text("- {name: a, method: nrfgs, scenes: [x, y], seeds: [1, 2]}\n- {name: b, method: m, scenes: [x]}\n")
    assert [trial.key for trial in read_plan(file)] == [
        *(("a", "x", 1), ("a", "y", 1), ("a", "x", 2), ("a", "y", 2), ("b", "x", 42))
    ]
    for bad in ("- {name: a, method: nrfgs}", "- {name: a, method: m, scenes: [x], step: 3}", "name", ""):
        file.write_text(bad)
        with pytest.raises(InputError, match="no entry of a plan"):
            read_plan(file)


def test_trainings_follow_each_other_and_one_that_fails_ends_no_other(tiny_scene, no_cuda, monkeypatch):
    trials = [
        Trial("field", "nrfgs", tiny_scene.name, 42, 3, OPTIONS),
        Trial("broken", "nrfgs", "no such scene", 42, 3),
        Trial("harmonics", "nrfgs-sh", f"{tiny_scene.name}/transforms.json", 7, 3, OPTIONS),
    ]
    found = done(trials, tiny_scene.parent, time.time() + 1e6)
    assert "no such scene" in found.pop(trials[1].key)["left"]
    for record in found.values():
        assert record["made_steps"] == 3 and record["splats"] > 0
        assert len(record["per_image"]) == len(record["flip"]) > 0
        assert record["psnr"] == pytest.approx(sum(view[1] for view in record["per_image"]) / len(record["per_image"]))
    monkeypatch.setattr("nrfgs_lab.trials.CHECKED_EVERY", 1)
    long = Trial("long", "nrfgs-sh", tiny_scene.name, 7, 10**6, OPTIONS)
    assert "no time after 2 steps" in done([long], tiny_scene.parent, time.time() + 60)[long.key]["left"]
    assert done(trials[:1], tiny_scene.parent, time.time() - 1)[trials[0].key]["left"] == "no time"
