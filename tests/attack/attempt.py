# SPDX-License-Identifier: Apache-2.0
"""The outcome of one hostile input.

The promise (docs/troubleshooting.md): an input that cannot be used is refused with one clear sentence, before anything
is written, with a bounded number of calls (counted, so that the outcome does not depend on the machine) and less than a
gigabyte of memory. Attempts are made in a child process, which may be killed.
"""

import contextlib
import functools
import itertools
import json
import os
import resource
import select
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any, NamedTuple

from hypothesis import strategies as st
from small_capture import Capture, listing

CALLS = 1_000_000
"""Calls of functions, Python's and C's, that an input may take: some tenths of a second."""
PATIENCE = 300.0
"""Seconds without any answer after which an attempt counts as endless."""
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
    """It must be refused; otherwise it may be read as well."""
    says: tuple[str, ...] = ()
    """What the message must name."""


class Outcome(NamedTuple):
    """What happened, and the message."""

    kind: str
    """refused (one clear sentence); read; silent (hostile, and read without a word); traceback; unclear (refused, but
    not in one printable sentence); slow (too many calls); large; wrote; hang; broken case"""
    said: str = ""


class TooManyCalls(BaseException):
    """Reading takes more than `CALLS`. No `except Exception` stops it."""


@contextlib.contextmanager
def limited_calls() -> Iterator[None]:
    """Raise TooManyCalls in this thread."""
    calls = itertools.count()

    def count(frame, event, arg) -> None:
        if event in ("call", "c_call") and next(calls) > CALLS:
            raise TooManyCalls

    sys.setprofile(count)
    try:
        yield
    finally:
        sys.setprofile(None)


def attempts(cases: Sequence[Case]) -> list[Outcome]:
    """Let a child process read the inputs, one after the other; another one goes on where it hangs or dies."""
    _warm_up()
    outcomes: list[Outcome] = []
    while len(outcomes) < len(cases):
        outcomes += _in_one_process(cases[len(outcomes) :])
    return outcomes


@functools.cache
def _warm_up() -> None:
    """Import what reading imports, once and not in every child, whose calls are counted."""
    import nrfgs_ns.compact.decode  # noqa: F401
    from nrfgs_ns.data.datamanager import NrfgsDatamanagerConfig
    from nrfgs_ns.data.dataparser import NrfgsDataParserConfig

    with tempfile.TemporaryDirectory() as folder:
        capture = Capture(Path(folder) / "capture", images=2)
        capture.save()
        config = NrfgsDataParserConfig(data=capture.folder, load_3D_points=False)
        NrfgsDatamanagerConfig(dataparser=config).setup(device="cpu").load_all_images()


def _in_one_process(cases: Sequence[Case]) -> list[Outcome]:
    """The outcomes up to the first input that takes the process with it."""
    receive, send = os.pipe()
    child = os.fork()
    if child == 0:
        try:
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


def _read(case: Case, folder: Path) -> Outcome:
    from nrfgs_ns.errors import InputError

    data, work = folder / "data", folder / "work"
    work.mkdir()
    data.mkdir()
    os.environ["XDG_CACHE_HOME"] = str(folder / "cache")
    try:
        read = case.build(data)
    except Exception as error:
        return Outcome("broken case", f"{type(error).__name__}: {error}")
    os.chdir(work)
    before, largest = listing(folder), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    kind, said = "silent" if case.hostile else "read", ""
    try:
        with limited_calls():
            read()
    except InputError as error:
        said = str(error)
        clear = len(said) <= LONGEST and said.isprintable() and said.encode("utf-8", "replace").decode() == said
        kind = "refused" if clear else "unclear"
    except TooManyCalls:
        kind = "slow"
    except BaseException as error:  # SystemExit of a library, too
        kind, said = "traceback", f"{type(error).__name__}: {error}"
    size = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - largest)
    if kind in GOOD and size > BYTES:
        kind, said = "large", f"{size / 2**20:.0f} MiB; {said}"
    elif kind in GOOD and listing(folder) != before:
        kind = "wrote"
    return Outcome(kind, said.replace(str(folder), "FOLDER")[: 2 * LONGEST])


# Values that nobody expects, and ways to put them where something else was.
ODD = st.sampled_from(
    [None, True, False, 0, -1, 1, 2, 7, 2**31, 2**63, 10**30, 10**400, -0.0, 0.5, 1e-320, 1e38, 1e39, 1e308, -1e308]
    + [float("nan"), float("inf"), "", "x", "nan", "1e400", "\0", "\ud800", "\u202e", "a\nb", "x" * 300, "/", "..", "."]
    + ["/dev/zero", "/proc/self/mem", "~", "$HOME", "\x1b[2J", [], {}, [[]], [None], [0.0], [1, 2, 3], {"": {}}]
    + [[[[[]]]], ["x"] * 6, [float("nan")] * 6, [0.0] * 6, [[1.0] * 4] * 4, [[float("inf")] * 4] * 4]
)


def places(tree: Any, at: tuple = ()) -> list[tuple]:
    """The paths to all nodes of a tree of dicts and lists, without its root."""
    children = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    return [place for key, value in children for place in ((*at, key), *places(value, (*at, key)))]


def put(tree: Any, place: tuple, value: Any) -> None:
    """Replace one node."""
    for key in place[:-1]:
        tree = tree[key]
    tree[place[-1]] = value


REPLACEMENTS = st.lists(st.tuples(st.floats(0, 1, exclude_max=True), ODD), min_size=1, max_size=3)
"""A few odd values, and where to put each: a number in [0, 1) that chooses one of all places."""


def replace_in(tree: Any, chosen: list[tuple[float, Any]]) -> None:
    """Put them there."""
    for share, value in chosen:
        every = places(tree)
        if every:
            put(tree, every[int(share * len(every))], deepcopy(value))


HOW = st.sampled_from(["overwrite", "insert", "cut", "delete"])
CONTENT = st.binary(min_size=1, max_size=8) | st.sampled_from(
    [b"\xff" * 8, b"\0" * 8, b"\xff" * 7 + b"\x7f", b"\0\0\0\0\0\0\xf0\x7f", b"\n", b"9" * 20]
)
DAMAGES = st.lists(st.tuples(HOW, st.floats(0, 1), CONTENT), min_size=1, max_size=3)
"""What is done to the bytes of a file, and where, as a share of its length."""


def damage(data: bytes, chosen: list[tuple[str, float, bytes]]) -> bytes:
    """Do it."""
    for how, share, content in chosen:
        at = int(share * len(data))
        rest = {"overwrite": data[at + len(content) :], "insert": data[at:], "delete": data[at + len(content) :]}
        data = data[:at] + (b"" if how in ("cut", "delete") else content) + rest.get(how, b"")
    return data
