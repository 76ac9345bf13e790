# SPDX-License-Identifier: Apache-2.0
"""The study of windows says of each what a training that averages over it would be worth."""

import json

import pytest
from short_trainings import command_line, trained

from nrfgs_ns.errors import InputError
from nrfgs_ns.studies.averaging import AveragingStudy
from nrfgs_ns.studies.run import evaluate

CALM = {"--pipeline.model.num-downscales": 0, "--pipeline.model.warmup-steps": 0}


@pytest.mark.usefixtures("no_cuda")
def test_windows_of_one_training(tiny_scene, tmp_path, capsys):
    work, out = tmp_path / "work", tmp_path / "record.json"
    options = " ".join(f"{name} {value}" for name, value in CALM.items())
    AveragingStudy(tiny_scene, work, out, steps=9, windows=(3, 0, 100), options=options).main()
    record = json.loads(out.read_text())
    three, last, all_steps = record["windows"]
    assert [row["averaged"] for row in record["windows"]] == [3, 0, 9]
    assert (record["scene"], record["steps"], record["seed"]) == (tiny_scene.name, 9, 42)
    assert str(tmp_path) not in out.read_text()
    assert f"| 3 | 3 | {three['psnr']:.2f} |" in capsys.readouterr().out

    (config,) = work.rglob("config.yml")
    same = trained(command_line("nrfgs", tiny_scene, tmp_path / "same", 9, CALM, {"--average-steps": 3}))
    for row, path in ((last, config), (three, same)):
        expected = evaluate(path, tmp_path / "eval.json")
        # The very same numbers, in the same order.
        assert {name: row[name] for name in ("psnr", "ssim", "splats")} == {
            name: expected[name] for name in ("psnr", "ssim", "splats")
        }
    assert len({row["psnr"] for row in (last, three, all_steps)}) == 3


@pytest.mark.parametrize(
    "wrong, message",
    [
        ({"method": "splatfacto"}, "one of this project's"),
        ({"options": "--average-steps 5"}, "over its last 5 steps itself"),
        ({"method": "nrfgs-fast"}, 'add "--average-steps 0"'),
        ({"windows": (-1, 3)}, "zero or more"),
    ],
)
def test_what_cannot_be_studied_is_refused(wrong, message, tiny_scene, tmp_path):
    with pytest.raises(InputError, match=message):
        AveragingStudy(tiny_scene, tmp_path, tmp_path / "record.json", **wrong).main()
