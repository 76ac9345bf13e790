# SPDX-License-Identifier: Apache-2.0
"""Tests of Triton kernels in Triton's interpreter, in a process of their own: Triton decides when it is imported."""

import os
import subprocess
import sys
from pathlib import Path


def passes_in_the_interpreter(*files: Path) -> None:
    """Run every test of these files; a failure shows that process's report."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *map(str, files)]
    environment = {**os.environ, "TRITON_INTERPRET": "1", "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    run = subprocess.run(command, env=environment, capture_output=True, text=True, cwd=files[0].parents[2])
    assert run.returncode == 0, run.stdout[-4000:] + run.stderr[-2000:]
