# SPDX-License-Identifier: Apache-2.0
"""The .ply of points that a training starts from."""

import numpy as np
from area_transforms import add_points, broken
from attempt import DAMAGES, Case, damage
from hypothesis import strategies as st
from small_capture import Capture

AREA = ".ply of points"

HEAD = b"ply\nformat %s 1.0\nelement vertex %d\nproperty %s x\nproperty float y\nproperty float z\nend_header\n"


def holding(name: str, content: bytes) -> Case:
    return broken(name, lambda capture: (capture.folder / "points.ply").write_bytes(content))


def stored(name: str, xyz, rgb=None) -> Case:
    return broken(name, lambda capture: capture.add_ply(np.asarray(xyz), rgb))


TWO = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float %s\nproperty float %s\nend_header\n1 1\n"
BINARY = b"binary_little_endian"
ROWS = b"5 6 7\n" * 9
FINE = np.full((40, 3), 6.0)
CASES = [
    stored("float32 in UTM", np.float32(np.random.default_rng(1).normal((5e5, 5.6e6, 100), 0.5, (40, 3)))),
    holding("empty", b""),
    holding("no ply", b"solid\n"),
    holding("header without end", b"ply\nformat ascii 1.0\nelement vertex 9\n"),
    holding("endless header", b"ply\nformat ascii 1.0\n" + b"comment x\n" * 100_000),
    holding("no vertices", b"ply\nformat ascii 1.0\nelement face 1\nproperty float x\nend_header\n1\n"),
    *(
        holding(f"{form.decode()} of {n} vertices", HEAD % (form, n, b"float") + ROWS)
        for form in (b"ascii", BINARY)
        for n in (10**3, 10**7, 10**10, 10**30)
    ),
    holding("negative count", HEAD % (BINARY, -3, b"float") + ROWS),
    holding("unknown type", HEAD % (BINARY, 9, b"quad") + bytes(1000)),
    holding("x is a list", HEAD % (b"ascii", 9, b"list uchar float") + b"1 5 6 7\n" * 9),
    holding("list of 4 billion", HEAD % (BINARY, 9, b"list uint float") + b"\xff" * 1000),
    holding("x twice", TWO % (b"x", b"x")),
    holding("no z", TWO % (b"x", b"y")),
    holding("words", HEAD % (b"ascii", 9, b"float") + b"a b c\n" * 9),
    holding("unknown format", HEAD % (b"base64", 9, b"float") + ROWS),
    holding("bytes", bytes(range(256)) * 9),
    *(stored(f"all {value}", np.full((40, 3), value)) for value in (np.nan, np.inf, 1e300, -1e30)),
    *(
        stored(f"colours of {value}", FINE, np.full((40, 3), value))
        for value in (np.int32(300), np.int32(-1), 1e300, np.nan)
    ),
]


def inputs() -> st.SearchStrategy[Case]:
    """A point cloud, damaged."""

    def case(text: bool, chosen) -> Case:
        def change(capture: Capture) -> None:
            path = add_points(capture, text=text)
            path.write_bytes(damage(path.read_bytes(), chosen))

        return broken(f"{'text' if text else 'binary'} {chosen}"[:200], change)._replace(hostile=False)

    return st.builds(case, st.booleans(), DAMAGES)
