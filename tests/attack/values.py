# SPDX-License-Identifier: Apache-2.0
"""Values that nobody expects, and ways to put them where something else was."""

from copy import deepcopy
from typing import Any

from hypothesis import strategies as st

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
