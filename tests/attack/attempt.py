# SPDX-License-Identifier: Apache-2.0
"""One hostile input, and what comes of it.

The promise (docs/stability.md): an input that cannot be used is refused with one clear sentence, at once, before
anything is written, in less than a second of computing and a gigabyte of memory. Attempts are made in a child
process, which may be killed.
"""

import contextlib
import json
import os
import resource
import select
import shutil
import signal
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

SECONDS = 1.0
"""Of computing (not of waiting for a busy machine) that an input may take."""
PATIENCE = 30.0
"""Seconds after which an attempt hangs."""
BYTES = 2**30
"""Of memory, beyond what the program had before."""
LONGEST = 1000
"""Characters of a message."""

GOOD = ("refused", "read")


class Case(NamedTuple):
    """One input."""

    name: str
    build: Callable[[Path], Callable[[], Any]]
    """Writes the input into an empty folder; returns what reads it as a user's command would."""
    hostile: bool = True
    """It cannot be used and must be refused. Otherwise it may be read as well, but no third thing."""


class Outcome(NamedTuple):
    """What came of it."""

    kind: str
    """refused (one clear sentence); read; silent (hostile, and read without a word); traceback; unclear (refused, but
    not in one printable sentence); slow; large; wrote; hang"""
    said: str = ""


def attempt(case: Case) -> Outcome:
    """Let a child process read one input."""
    return attempts([case])[0]


def attempts(cases: Sequence[Case]) -> list[Outcome]:
    """Let a child process read the inputs, one after the other; another one goes on where it hangs or dies."""
    outcomes: list[Outcome] = []
    while len(outcomes) < len(cases):
        outcomes += _in_one_process(cases[len(outcomes) :])
    return outcomes


def _in_one_process(cases: Sequence[Case]) -> list[Outcome]:
    """The outcomes up to the first input that takes the process with it."""
    receive, send = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.close(receive)
            _child(cases, send)
        finally:
            os._exit(0)
    os.close(send)
    outcomes, rest = [], b""
    try:
        while len(outcomes) < len(cases):
            part = os.read(receive, 2**16) if select.select([receive], [], [], PATIENCE)[0] else b""
            if not part:
                outcomes.append(Outcome("hang", f"no answer in {PATIENCE:.0f} s, or the process died"))
                break
            *lines, rest = (rest + part).split(b"\n")
            outcomes += [Outcome(*json.loads(line)) for line in lines]
    finally:
        os.close(receive)
        with contextlib.suppress(ProcessLookupError):
            os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    return outcomes


def _child(cases: Sequence[Case], send: int) -> None:
    import cv2
    import torch

    torch.set_num_threads(1)
    cv2.setNumThreads(0)
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in range(3):
        os.dup2(nothing, stream)
    for case in cases:
        folder = Path(tempfile.mkdtemp(prefix="attack-"))
        try:
            outcome = _read(case, folder)
        finally:
            os.chdir("/")
            shutil.rmtree(folder, ignore_errors=True)
        os.write(send, json.dumps(outcome).encode("ascii") + b"\n")


def _read(case: Case, folder: Path) -> tuple[str, str]:
    from nrfgs_ns.errors import InputError

    data, work = folder / "data", folder / "work"
    work.mkdir()
    data.mkdir()
    os.environ["XDG_CACHE_HOME"] = str(folder / "cache")
    try:
        read = case.build(data)
    except Exception as error:
        return "broken case", f"{type(error).__name__}: {error}"
    os.chdir(work)
    before, start = _listing(folder), resource.getrusage(resource.RUSAGE_SELF)
    kind, said = "read", ""
    try:
        read()
    except InputError as error:
        said = str(error)
        clear = len(said) <= LONGEST and said.isprintable() and said.encode("utf-8", "replace").decode() == said
        kind = "refused" if clear else "unclear"
    except BaseException as error:  # SystemExit of a library, too
        kind, said = "traceback", f"{type(error).__name__}: {error}"
    end = resource.getrusage(resource.RUSAGE_SELF)
    seconds = end.ru_utime + end.ru_stime - start.ru_utime - start.ru_stime
    size = 1024 * (end.ru_maxrss - start.ru_maxrss)
    if kind in GOOD:
        if kind == "read" and case.hostile:
            kind = "silent"
        elif seconds > SECONDS:
            kind, said = "slow", f"{seconds:.1f} s; {said}"
        elif size > BYTES:
            kind, said = "large", f"{size / 2**20:.0f} MiB; {said}"
        elif _listing(folder) != before:
            kind = "wrote"
    return kind, said.replace(str(folder), "FOLDER")[: 2 * LONGEST]


def _listing(folder: Path) -> dict[str, tuple[int, int]]:
    return {str(path): (status.st_size, status.st_mtime_ns) for path in folder.rglob("*") for status in (path.lstat(),)}
