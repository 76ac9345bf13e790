# SPDX-License-Identifier: Apache-2.0
"""transforms.json: every field wrong in every way, and options that fit no data set."""

import math
import os
from functools import partial
from pathlib import Path

import numpy as np
from attempt import REPLACEMENTS, Case, replace_in
from hypothesis import strategies as st
from small_capture import Capture

from nrfgs_ns.data.datamanager import NrfgsDatamanagerConfig
from nrfgs_ns.data.dataparser import NrfgsDataParserConfig

AREA = "transforms.json"


def load(data: Path, parser=NrfgsDataParserConfig, manager: dict | None = None, **options) -> None:
    """What a training does before its first step."""
    config = NrfgsDatamanagerConfig(dataparser=parser(data=data, **options), **(manager or {}))
    config.setup(device="cpu").load_all_images()


def add_points(capture: Capture, change=lambda xyz: xyz, text: bool = False) -> Path:
    """Points amid the cameras."""
    rng = np.random.default_rng(1)
    xyz, rgb = rng.normal((5, 6, 7), 0.5, (40, 3)), rng.integers(0, 256, (40, 3), dtype=np.uint8)
    return capture.add_ply(change(xyz), rgb, text)


def broken(name: str, change, then=lambda path: None, **options) -> Case:
    """A capture with masks and points, changed before its transforms.json is written, and `then` after that."""

    def build(folder: Path):
        capture = Capture(folder / "capture", images=10)
        capture.add_masks()
        add_points(capture)
        change(capture)
        then(capture.save())
        return partial(load, capture.folder, **options)

    return Case(name, build)


def option(key: str, values, **options) -> list[Case]:
    title = f"--{key.replace('_', '-')}"
    return [broken(f"{title} {value}", lambda capture: None, **{key: value}, **options) for value in values]


def text(name: str, content: bytes) -> Case:
    return broken(name, lambda capture: None, lambda path: path.write_bytes(content))


def move(capture: Capture, factor: float) -> None:
    """Displace one camera, as far from the others' middle times `factor`."""
    matrix = capture.meta["frames"][4]["transform_matrix"]
    for row, middle in enumerate((5.0, 6.0, 7.0)):
        matrix[row][3] = middle + factor * (matrix[row][3] - middle)


POSE = [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]]
LONG = "x" * 300

FIELDS = {
    "fl_x": (0.0, 1e38, 1e-30, "long", True, None, [10.0], 10**400),
    "fl_y": (0.8,),
    "cx": (1e30,),
    "cy": (math.nan,),
    "w": (1e300, -12, None),
    "camera_model": ("PINE", "EQUIRECTANGULAR", "FISHEYE624", ["OPENCV"], None, {}, "opencv", LONG),
    "orientation_override": ("sideways", None, [], 3),
    "ply_file_path": (None, 3, [], {}, True, "", ".", "no.ply", "\0", "\ud800", LONG, "/dev/zero", "images/000.png"),
    "distortion_params": ([0.1, 0.2, 0.3], [math.nan] * 6, "abc", {}, None, 0.1, [[0.0] * 6], ["x"] * 6, [0.0] * 12),
    "k1": (math.inf, 1e10, -1e5, -5.0, None, [0.1]),  # -5 folds the image
    "k4": (0.1,),
    "k6": (0.1,),
    "is_fisheye": (True,),
    "applied_transform": (None, [], [[1, 0], [0]], "x", [[math.nan] * 4] * 3, POSE),
    "applied_scale": (0, None, "x", math.nan, math.inf, -1, [], 10**400),
    "frames": ([], None, {}, 3, "x", [None], [[]], [{}]),
    "train_filenames": ([], None, {}, 3, [[]], [1], [None], ["\0"], [LONG], "images/000.png"),
}
OF_A_FRAME = {
    "file_path": (None, 7, [], "", ".", "images", "\0", LONG, "\ud800", "a\nb\x1b[2J", "/dev/zero", "x/" * 5000),
    "mask_path": (None, 7, [], "masks", "\0", LONG),
    "transform_matrix": (None, {}, "I", [], [POSE], [[1e300] * 4] * 4, [["a"] * 4] * 4, [[10**400] * 4] * 4),
    "k5": (0.1,),
    "fl_x": (20.0,),  # other than at the top level
    "camera_model": ("OPENCV_FISHEYE",),
    "w": (13,),
}
NAMES = {"distortion_params": "distortion", "k1": "distortion", "file_path": "path"}
"""Of fields that messages call otherwise."""


def fields(values: dict, frame: int | None = None) -> list[Case]:
    """Other values of a field at the top level, or of one frame, which the message must name."""

    def case(key: str, value) -> Case:
        def change(capture: Capture) -> None:
            (capture.meta if frame is None else capture.meta["frames"][frame])[key] = value

        says = "transforms.json", NAMES.get(key, key), *(["006.png"] if frame == 3 and "path" not in key else [])
        return broken(f"{key} {ascii(value)[:30]}{' of one frame' * (frame is not None)}", change)._replace(says=says)

    return [case(key, value) for key, them in values.items() for value in them]


CASES = [
    *fields(FIELDS),
    *fields(OF_A_FRAME, frame=3),
    broken("20,000 copies of a frame", lambda c: c.meta.update(frames=c.meta["frames"][:1] * 20_000)),
    broken("fisheye of 1e9", lambda c: c.meta.update(camera_model="OPENCV_FISHEYE", k1=1e9)),
    broken("one camera a thousand times as far", lambda c: move(c, 1e3)),
    broken("one camera 1e30 away", lambda c: move(c, 1e30)),
    broken("points at 1e30", lambda c: add_points(c, lambda xyz: xyz * 1e30)),
    broken("points of another unit", lambda c: add_points(c, lambda xyz: xyz * 100)),
    broken("points of another world", lambda c: add_points(c, lambda xyz: xyz + 300)),
    broken("points behind the cameras", lambda c: add_points(c, lambda xyz: xyz + (0, 0, 1000))),
    text("a number", b"3"),
    text("not closed", b'{"frames": ['),
    text("deep in frames", b'{"frames": ' + b"[" * 100_000 + b"]" * 100_000 + b"}"),
    text("5,000 digits", b'{"frames": [' + b"9" * 5000 + b"]}"),
    text("UTF-16", '{"frames": []}'.encode("utf-16")),
    text("bytes", bytes(range(256))),
    broken("two gigabytes", lambda capture: None, lambda path: os.truncate(path, 2**31)),
    *option("scale_factor", (0.0, -1.0, math.nan, math.inf)),
    *option("downscale_factor", (0, 4, 10**9)),
    *option("eval_interval", (0, 1), eval_mode="interval"),
    *option("train_split_fraction", (0.0, -1.0, 2.0, math.nan), eval_mode="fraction"),
    *option("manager", [{"camera_res_scale_factor": value} for value in (0.0, -1.0, math.nan, 1e-9, 1e9)]),
    *option("eval_mode", ("filename",)),
    Case("--data not there", lambda folder: partial(load, folder / "nowhere")),
    Case("--data empty", lambda folder: partial(load, folder)),
    Case("--data too long", lambda folder: partial(load, folder / LONG)),
    Case("--data with a zero byte", lambda folder: partial(load, Path(f"{folder}/a\0b"))),
    Case("--data a device", lambda folder: partial(load, Path("/dev/zero"))),
]


def inputs() -> st.SearchStrategy[Case]:
    """A whole capture, some of whose fields are something else."""

    def case(chosen) -> Case:
        name = f"fields {chosen}"[:200]
        return broken(name, lambda capture: replace_in(capture.meta, chosen))._replace(hostile=False)

    return REPLACEMENTS.map(case)
