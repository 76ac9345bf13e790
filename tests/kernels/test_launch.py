# SPDX-License-Identifier: Apache-2.0
"""`Launcher`: when a compiled variant is launched again, and when Triton is asked anew, without a GPU. All kernels."""

import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
import torch
from packaging.version import Version

pytest.importorskip("triton")

from nrfgs_ns.kernels import launch as module
from nrfgs_ns.kernels.launch import Launcher


class Kernel:
    """Stands for a function under triton.jit, or for a compiled variant: notes each launch."""

    arg_names = ("x", "count", "scale", "B", "KIND")

    def __init__(self, compiles: bool = True, kind: str = "triton"):
        self.launches: list[tuple] = []
        self.kind, self.compiles = kind, compiles

    def __getitem__(self, grid):
        def launch(*arguments, **constants):
            self.launches.append((self.kind, grid, arguments, constants))
            if self.compiles:
                variant = Kernel(kind="compiled")
                variant.launches = self.launches
                return variant

        return launch


@pytest.fixture(autouse=True)
def keeps_constants(monkeypatch):
    monkeypatch.setattr(module, "KEEPS_CONSTANTS", True)


CONSTANTS = {"KIND": "bf16", "B": 64, "num_warps": 4}


def test_the_second_launch_is_the_compiled_variants_with_constants_in_the_kernels_order():
    kernel, x = Kernel(), torch.zeros(8)
    launch = Launcher(kernel)
    launch((1, 1, 1), x, 8, 0.5, **CONSTANTS)
    launch((2, 1, 1), x, 7, 0.25, **CONSTANTS)
    assert kernel.launches == [
        ("triton", (1, 1, 1), (x, 8, 0.5), CONSTANTS),
        ("compiled", (2, 1, 1), (x.data_ptr(), 7, 0.25, 64, "bf16"), {}),
    ]


@pytest.mark.parametrize("arguments, constants", [
    ((torch.zeros(9)[1:], 8, 0.5), {}),  # 4 bytes into an allocation
    ((torch.zeros(8), 2**31, 0.5), {}),
    ((torch.zeros(8), 8, 1), {}),  # an integer where others had a float
    ((torch.zeros(8), 8, 0.5), {"B": 128}),
    ((torch.zeros(8), 8, 0.5), {"num_warps": 8}),
], ids=["unaligned", "64 bits", "another type", "another constant", "another option"])  # fmt: skip
def test_what_asks_for_another_variant_goes_to_triton(arguments, constants):
    ordinary, other = ((torch.zeros(8), 8, 0.5), CONSTANTS), (arguments, CONSTANTS | constants)
    for order, expected in (
        ((ordinary, other, ordinary), ["triton", "triton", "compiled"]),
        ((other, ordinary), ["triton", "triton"]),
    ):
        kernel = Kernel()
        launch = Launcher(kernel)
        for words, named in order:
            launch((1, 1, 1), *words, **named)
        assert [kind for kind, *_ in kernel.launches] == expected


@pytest.mark.parametrize("old", [True, False])
def test_the_interpreter_and_old_tritons_are_asked_each_time(monkeypatch, old):
    monkeypatch.setattr(module, "KEEPS_CONSTANTS", not old)
    kernel = Kernel(compiles=old)
    launch = Launcher(kernel)
    for _ in range(2):
        launch((1, 1, 1), torch.zeros(8), 8, 0.5, **CONSTANTS)
    assert [kind for kind, *_ in kernel.launches] == ["triton", "triton"]


# All kernels in Triton's interpreter (`*_interpreted.py` beside what they test), in one process of their own.
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
