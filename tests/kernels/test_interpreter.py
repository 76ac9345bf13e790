# SPDX-License-Identifier: Apache-2.0
"""All kernels in Triton's interpreter (`*_interpreted.py` beside what they test), in one process of their own."""

import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
from packaging.version import Version

pytest.importorskip("triton")

TESTS = Path(__file__).parents[1]


@pytest.mark.skipif(
    Version(version("triton")) < Version("3.4"),
    reason="before 3.4 Triton's interpreter has neither products of fewer than 16 rows (3.2) nor single bits (3.3)",
)
def test_kernels_in_the_interpreter():
    files = sorted(set(TESTS.glob("*/*_interpreted.py")))
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *map(str, files)]
    environment = {**os.environ, "TRITON_INTERPRET": "1", "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    run = subprocess.run(command, env=environment, capture_output=True, text=True, cwd=TESTS.parent, timeout=580)
    assert run.returncode == 0, run.stdout[-4000:] + run.stderr[-2000:]
