# SPDX-License-Identifier: Apache-2.0
"""All kernels in Triton's interpreter (`*_interpreted.py` beside what they test), in one process of their own.

Triton decides when it is imported whether it interprets; and to start a process takes longer than most of the tests.
"""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[1]


@pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="Triton is not installed")
def test_kernels_in_the_interpreter():
    files = sorted(set(TESTS.glob("*/*_interpreted.py")) - {Path(__file__)})
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *map(str, files)]
    environment = {**os.environ, "TRITON_INTERPRET": "1", "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    run = subprocess.run(command, env=environment, capture_output=True, text=True, cwd=TESTS.parent, timeout=580)
    assert run.returncode == 0, run.stdout[-4000:] + run.stderr[-2000:]
