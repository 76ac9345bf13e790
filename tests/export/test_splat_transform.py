# SPDX-License-Identifier: Apache-2.0
"""The commands of docs/export.md, run by PlayCanvas' splat-transform; skipped where Node or the tool is not.

npm install -g @playcanvas/splat-transform@3.7
"""

import re
import shutil
import subprocess
from pathlib import Path

import pytest
import torch
from torch.testing import assert_close

from nrfgs_ns.export.ply import read_splats, write_splats
from nrfgs_ns.model.harmonics_fit import PlainSplats

TOOL = shutil.which("splat-transform")
DOCS = Path(__file__).resolve().parents[2] / "docs" / "export.md"
COMMANDS = re.findall(r"^splat-transform (.*?)\s*(?:#.*)?$", DOCS.read_text(encoding="utf-8"), re.MULTILINE)


def test_the_page_names_commands():
    assert len(COMMANDS) >= 4


@pytest.mark.skipif(TOOL is None, reason="no splat-transform: npm install -g @playcanvas/splat-transform@3.7")
@pytest.mark.parametrize("words", COMMANDS)
def test_a_command_of_the_page_works(words, tmp_path):
    torch.manual_seed(0)
    count = 500
    quats = torch.nn.functional.normalize(torch.randn(count, 4), dim=-1)
    splats = PlainSplats(
        torch.randn(count, 3),
        quats,
        torch.randn(count, 3) * 0.3 - 3,
        torch.randn(count, 1),
        torch.randn(count, 3),
        torch.randn(count, 15, 3) * 0.1,
    )
    write_splats(splats, tmp_path / "splats.ply")
    done = subprocess.run([TOOL, *words.split()], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr + done.stdout
    out = tmp_path / next(word for word in reversed(words.split()) if word.startswith("splats."))
    assert out.stat().st_size > 1000
    back = [TOOL, out.name, "back.ply"]
    if out.suffix in (".spz", ".sog", ".ply"):
        done = subprocess.run(back, cwd=tmp_path, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr + done.stdout
        found = read_splats(tmp_path / "back.ply").means
        assert len(found) == count
        # Another order, and rounded: 24 bits of fixed point in .spz, 16 of a logarithm in .sog, 11 in compressed PLY.
        expected = splats.means[splats.means[:, 0].argsort()]
        assert_close(found[found[:, 0].argsort()].mean(0), expected.mean(0), rtol=0, atol=5e-3)
