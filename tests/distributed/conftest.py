# SPDX-License-Identifier: Apache-2.0
import contextlib
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from filelock import FileLock

DEVICE = Path(__file__).with_name("device.py")
TIMEOUT = 500
"""Seconds after which processes that wait for each other for good are ended: before pytest ends the test."""


@contextlib.contextmanager
def session(*words: object) -> Iterator[subprocess.Popen]:
    """Python with these words in a session of its own, which is killed at the end, with the process's children."""
    process = subprocess.Popen(
        [sys.executable, *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        start_new_session=True,
    )
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)


@pytest.fixture(name="session")
def session_of_its_own():
    return session


def meet(job: str, scene: Path, folder: Path, device_type: str = "cpu") -> Path:
    """Run a job of `jobs.py` on two processes; `folder`, into which they save their results."""
    folder.mkdir(parents=True, exist_ok=True)
    with session(DEVICE, job, 2, scene, folder, device_type) as process:
        said, _ = process.communicate(timeout=TIMEOUT)
    assert process.returncode == 0, said[-6000:]
    return folder


@pytest.fixture(scope="session")
def two_devices(tiny_scene, tmp_path_factory) -> Path:
    """The results of `jobs.everything` on two processes with gloo; of several tests' processes the first makes them."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "two-devices"
    with FileLock(folder.with_suffix(".lock"), timeout=TIMEOUT):
        if not (folder / "done").exists():
            shutil.rmtree(folder, ignore_errors=True)  # of a meeting that failed
            meet("everything", tiny_scene, folder)
            (folder / "done").touch()
    return folder


@pytest.fixture(scope="session")
def on_gpus(tiny_scene, tmp_path_factory) -> Path:
    """The results of `jobs.fits_one_process` on two GPUs with NCCL between them."""
    return meet("fits_one_process", tiny_scene, tmp_path_factory.mktemp("two-gpus") / "devices", "cuda")
