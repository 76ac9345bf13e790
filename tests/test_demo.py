# SPDX-License-Identifier: Apache-2.0
"""`nrfgs demo` end to end, in its smallest form."""

import json
import subprocess
import sys

import pytest
from PIL import Image

from nrfgs_ns.demo import METHODS, Demo


@pytest.mark.usefixtures("no_cuda")
def test_demo_trains_compares_and_writes_pictures(tmp_path, capfd):
    demo = Demo(out=tmp_path / "demo", quick=True, steps=6)
    demo.main()
    results = json.loads((tmp_path / "demo" / "results.json").read_text())
    assert results["steps"] == 6 and set(results["methods"]) == set(METHODS)
    shown = capfd.readouterr().out
    assert "ns-train nrfgs-sh --data" in shown and all(f" {label} " in shown for label in METHODS.values())
    for result in results["methods"].values():
        assert result["train"]["steps"] == 6
        assert 5 < result["eval"]["psnr"] < 60
    sheet = Image.open(tmp_path / "demo" / "contact_sheet.png")
    scene = demo.scene()
    assert sheet.width > 5 * scene.width and sheet.height > 3 * scene.height


def test_help_answers_and_names_the_commands():
    run = subprocess.run([sys.executable, "-m", "nrfgs_ns.cli", "--help"], capture_output=True, text=True, check=True)
    assert {"demo", "export", "bench"} <= set(run.stdout.split())


def test_a_command_imports_no_other():
    code = (
        "import sys; from nrfgs_ns.cli import chosen; chosen(['demo', '--quick']);"
        "print([name for name in sys.modules if name.startswith(('nrfgs_lab', 'nrfgs_ns.export', 'nrfgs_ns.prepare'))])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.split() == ["[]"]


def test_a_folder_that_is_not_ours_is_refused_in_one_line(tmp_path):
    occupied = tmp_path / Demo(quick=True).scene_folder
    occupied.mkdir()
    (occupied / "precious.txt").write_text("mine")
    run = subprocess.run(
        [sys.executable, "-m", "nrfgs_ns.cli", "demo", "--quick", "--out", str(tmp_path)],
        capture_output=True,
        text=True,
    )
    assert run.returncode == 1
    assert "Traceback" not in run.stderr and str(occupied) in run.stderr.replace("\n", "")
    assert (occupied / "precious.txt").read_text() == "mine"
