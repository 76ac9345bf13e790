# SPDX-License-Identifier: Apache-2.0
"""`nrfgs demo` end to end, in its smallest form."""

import json
import subprocess
import sys

import pytest
import torch
from PIL import Image

from nrfgs_lab.demo import CELL, METHODS, Demo, SeenView, brightest_window, where_it_shines
from nrfgs_lab.scenes import SceneConfig
from nrfgs_ns.cli import entrypoint
from nrfgs_ns.errors import InputError


@pytest.mark.usefixtures("no_cuda")
def test_demo_trains_compares_and_writes_pictures(tmp_path, capfd, monkeypatch):
    small = SceneConfig(mirror=0.0, views=12, width=64, height=48, points=500, test_every=4)
    monkeypatch.setattr(Demo, "scene", lambda self: small)
    demo = Demo(out=tmp_path / "demo", quick=True, steps=6)
    demo.main()
    results = json.loads((tmp_path / "demo" / "results.json").read_text())
    assert results["steps"] == 6 and set(results["methods"]) == set(METHODS)
    shown = capfd.readouterr().out
    assert "ns-train nrfgs-sh --data" in shown and all(f" {label} " in shown for label in METHODS.values())
    for result in results["methods"].values():
        assert result["train"]["steps"] == 6
        assert 5 < result["eval"]["psnr"] < 60
        assert 0.02 < result["shine"]["share"] < 0.9 and 5 < result["shine"]["psnr"] < 60
    sheet = Image.open(tmp_path / "demo" / "contact_sheet.png")
    assert sheet.width >= 5 * CELL and sheet.height >= 6 * 0.7 * CELL


@pytest.mark.parametrize(
    "options, says",
    [({"steps": 0}, "--steps is 0"), ({"gloss": 1.5}, "gloss must lie in"), ({"seed": -1}, "seed must be")],
)
def test_what_cannot_be_is_told_in_a_sentence(options, says, tmp_path):
    with pytest.raises(InputError, match=says):
        Demo(out=tmp_path / "demo", **options).main()
    assert not (tmp_path / "demo").exists()


def test_where_it_shines_is_where_gloss_changes_the_truth():
    grey = torch.full((12, 15, 3), 0.5)
    truth = grey.clone()
    truth[6:9, 10:14] = 0.9
    view = SeenView(truth=truth, dull=grey, rendered=truth - 0.1, base=grey)
    score = where_it_shines([view, view])
    assert score["share"] == pytest.approx(12 / 180)
    assert score["psnr"] == pytest.approx(20.0, abs=1e-3) and score["psnr_base"] == pytest.approx(7.96, abs=1e-2)
    top, left, height, width = brightest_window(view.shine)
    assert (height, width) == (4, 5) and top <= 6 and top + height >= 9 and left <= 10 and left + width >= 14
    assert where_it_shines([SeenView(grey, grey, grey, grey)]) == {"share": 0.0, "psnr": None, "psnr_base": None}


def test_help_answers_and_names_the_commands(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["nrfgs", "--help"])
    with pytest.raises(SystemExit) as ended:
        entrypoint()
    assert ended.value.code == 0
    assert {"demo", "export", "bench"} <= set(capsys.readouterr().out.split())


def test_a_command_imports_no_other():
    code = (
        "import sys; from nrfgs_ns.cli import chosen; chosen(['demo', '--quick']);"
        "others = ('nrfgs_lab.bench', 'nrfgs_ns.export', 'nrfgs_ns.prepare');"
        "print([name for name in sys.modules if name.startswith(others)])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.split() == ["[]"]


def test_a_folder_that_is_not_ours_is_refused_in_one_line(tmp_path, monkeypatch):
    occupied = tmp_path / Demo(quick=True).scene_folder
    occupied.mkdir()
    (occupied / "precious.txt").write_text("mine")
    monkeypatch.setattr(sys, "argv", ["nrfgs", "demo", "--quick", "--out", str(tmp_path)])
    with pytest.raises(SystemExit) as ended:  # Python prints its message, and ends with status 1
        entrypoint()
    assert str(occupied) in ended.value.code and "\n" not in ended.value.code
    assert (occupied / "precious.txt").read_text() == "mine"
