# SPDX-License-Identifier: Apache-2.0
"""Kernels of several rooms in Triton's interpreter, in one process: to start it takes longer than most of the tests."""

import importlib.util
from pathlib import Path

import pytest
from interpreted import passes_in_the_interpreter

TESTS = Path(__file__).parents[1]
FILES = "appearance/harmonics", "densification/statistics", "rasterizer/tile_lists", "training/adam"


@pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="Triton is not installed")
def test_kernels_in_the_interpreter():
    passes_in_the_interpreter(*(TESTS / f"{file}_interpreted.py" for file in FILES))
