# SPDX-License-Identifier: Apache-2.0
"""transforms.json: every field wrong in every way, and options that fit no data set."""

import math
from functools import partial
from pathlib import Path

import numpy as np
from attempt import Case
from broken_captures import META
from hypothesis import strategies as st
from small_capture import Capture
from values import replace_in, replacements

AREA = "transforms.json"


def load(data: Path, manager: dict | None = None, **options) -> None:
    """What a training does before its first step."""
    from nrfgs_ns.data.datamanager import NrfgsDatamanagerConfig
    from nrfgs_ns.data.dataparser import NrfgsDataParserConfig

    parser = NrfgsDataParserConfig(data=data, **options)
    NrfgsDatamanagerConfig(dataparser=parser, **(manager or {})).setup(device="cpu").load_all_images()


def capture_in(folder: Path, points: bool = True) -> Capture:
    """A capture whose points are amid its cameras, with masks."""
    capture = Capture(folder / "capture", images=10)
    capture.add_masks()
    if points:
        rng = np.random.default_rng(1)
        capture.add_ply(rng.normal((5, 6, 7), 0.5, (40, 3)), rng.integers(0, 256, (40, 3), dtype=np.uint8))
    return capture


def changed(change, folder: Path, **options):
    capture = capture_in(folder)
    change(capture)
    capture.save()
    return partial(load, capture.folder, **options)


def broken(name: str, change, **options) -> Case:
    return Case(name, lambda folder: changed(change, folder, **options))


def meta(name: str, **fields) -> Case:
    return broken(name, lambda capture: capture.meta.update(fields))


def frame(name: str, **fields) -> Case:
    return broken(name, lambda capture: capture.meta["frames"][3].update(fields))


def option(name: str, **options) -> Case:
    return broken(name, lambda capture: None, **options)


def text(name: str, content: bytes) -> Case:
    def build(folder: Path):
        capture = capture_in(folder)
        capture.save().write_bytes(content)
        return partial(load, capture.folder)

    return Case(name, build)


def move(capture: Capture, factor: float) -> None:
    """Displace one camera, as far from the others' middle times `factor`."""
    matrix = capture.meta["frames"][4]["transform_matrix"]
    for row, middle in enumerate((5.0, 6.0, 7.0)):
        matrix[row][3] = middle + factor * (matrix[row][3] - middle)


def points(capture: Capture, change) -> None:
    rng = np.random.default_rng(1)
    capture.add_ply(change(rng.normal((5, 6, 7), 0.5, (40, 3))))


def blacken(capture: Capture) -> None:
    from PIL import Image

    for one in capture.meta["frames"]:
        Image.new("L", (12, 9)).save(capture.folder / one["mask_path"])


def large_file(folder: Path):
    capture = capture_in(folder)
    with capture.save().open("r+b") as file:
        file.truncate(2**31)
    return partial(load, capture.folder)


POSE = [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]]
LONG = "x" * 300

CASES = [
    *(broken(name, change) for name, (change, _) in META.items() if "mask" not in name),
    meta("fl_x 1e38", fl_x=1e38),
    meta("fl_x 1e-30", fl_x=1e-30),
    meta("fl_y of another unit", fl_y=0.8),
    meta("fl_x true", fl_x=True),
    meta("fl_x null", fl_x=None),
    meta("fl_x list", fl_x=[10.0]),
    meta("fl_x of 400 digits", fl_x=10**400),
    meta("cx 1e30", cx=1e30),
    meta("cy nan", cy=math.nan),
    meta("w 1e300", w=1e300),
    meta("w negative", w=-12),
    meta("w null", w=None),
    *(
        meta(f"camera model {model!r}", camera_model=model)
        for model in (
            "EQUIRECTANGULAR",
            "ORTHOPHOTO",
            "VR180_L",
            "OMNIDIRECTIONALSTEREO_R",
            "FISHEYE624",
            "FULL_OPENCV",
        )
    ),
    *(meta(f"camera model {model!r}", camera_model=model) for model in (["OPENCV"], None, {}, 3, "", "opencv", LONG)),
    *(meta(f"orientation_override {value!r}", orientation_override=value) for value in ("sideways", None, [], 3)),
    *(meta(f"ply_file_path {str(value)[:20]!r}", ply_file_path=value) for value in (None, 3, [], {}, True)),
    *(
        meta(f"ply_file_path {value[:20]!r}", ply_file_path=value)
        for value in ("", ".", "no.ply", "\0", "\ud800", LONG)
    ),
    *(meta(f"ply_file_path {value!r}", ply_file_path=value) for value in ("/dev/zero", "images/000.png")),
    *(
        frame(f"file_path {str(value)[:20]!r}", file_path=value)
        for value in (None, 7, [], "", ".", "images", "\0", LONG)
    ),
    *(frame(f"file_path {value!r}", file_path=value) for value in ("\ud800", "a\nb\x1b[2J", "/dev/zero", "/dev/null")),
    frame("file_path too long", file_path="x/" * 5000),
    *(frame(f"mask_path {str(value)[:20]!r}", mask_path=value) for value in (None, 7, [], "masks", "\0", LONG)),
    *(
        meta(f"distortion_params {str(value)[:30]}", distortion_params=value)
        for value in ([0.1, 0.2, 0.3], [math.nan] * 6, "abc", {}, None, 0.1, [[0.0] * 6], ["x"] * 6, [0.0] * 12)
    ),
    meta("k1 1e10", k1=1e10),
    meta("k1 -1e5", k1=-1e5),
    meta("k1 folds the image", k1=-5.0),
    meta("k1 null", k1=None),
    meta("k1 list", k1=[0.1]),
    meta("k4 of a pinhole", k4=0.1),
    meta("is_fisheye", is_fisheye=True),
    meta("k6", k6=0.1),
    frame("k5", k5=0.1),
    *(
        frame(f"{key} other than at the top level", **{key: value})
        for key, value in {"fl_x": 20.0, "camera_model": "OPENCV_FISHEYE", "w": 13}.items()
    ),
    broken("20,000 copies of a frame", lambda c: c.meta.update(frames=c.meta["frames"][:1] * 20_000)),
    meta("fisheye of 1e9", camera_model="OPENCV_FISHEYE", k1=1e9),
    *(
        frame(f"pose {str(value)[:24]}", transform_matrix=value)
        for value in (
            None,
            {},
            "I",
            [],
            [POSE],
            [[1e300] * 4] * 4,
            [["a"] * 4] * 4,
            [[10**400] * 4] * 4,
            np.eye(3).tolist(),
        )
    ),
    broken("one camera a thousand times as far", lambda c: move(c, 1e3)),
    broken("one camera ten thousand times as far", lambda c: move(c, 1e4)),
    broken("one camera 1e30 away", lambda c: move(c, 1e30)),
    broken("all masks empty", blacken),
    broken("points at 1e30", lambda c: points(c, lambda xyz: xyz * 1e30)),
    broken("points at 1e6", lambda c: points(c, lambda xyz: xyz * 1e6)),
    broken("points of another world", lambda c: points(c, lambda xyz: xyz + 300)),
    broken("points of another unit", lambda c: points(c, lambda xyz: xyz * 100)),
    broken("points behind the cameras", lambda c: points(c, lambda xyz: xyz + (0, 0, 1000))),
    *(
        meta(f"applied_transform {str(v)[:24]}", applied_transform=v)
        for v in (None, [], "x", [[math.nan] * 4] * 3, POSE)
    ),
    *(meta(f"applied_scale {v!r}", applied_scale=v) for v in (None, "x", math.nan, math.inf, -1, [])),
    meta("applied_scale of 400 digits", applied_scale=10**400),
    *(meta(f"frames {str(value)[:20]}", frames=value) for value in (None, {}, 3, "x", [None], [[]], [{}])),
    *(
        meta(f"train_filenames {str(value)[:20]}", train_filenames=value)
        for value in (None, {}, 3, [[]], [1], [None], ["\0"], [LONG], "images/000.png")
    ),
    text("empty", b""),
    text("a number", b"3"),
    text("a word", b'"frames"'),
    text("not closed", b'{"frames": ['),
    text("deep", b"[" * 200_000),
    text("deep in frames", b'{"frames": ' + b"[" * 100_000 + b"]" * 100_000 + b"}"),
    text("5,000 digits", b'{"frames": [' + b"9" * 5000 + b"]}"),
    text("UTF-16", '{"frames": []}'.encode("utf-16")),
    text("bytes", bytes(range(256))),
    text("zeros", bytes(1000)),
    Case("two gigabytes", large_file),
    *(option(f"--scale-factor {value}", scale_factor=value) for value in (0.0, -1.0, math.nan, math.inf)),
    *(option(f"--downscale-factor {value}", downscale_factor=value) for value in (0, -1, 4, 10**9)),
    *(option(f"--eval-interval {value}", eval_mode="interval", eval_interval=value) for value in (0, -1, 1)),
    *(
        option(f"--train-split-fraction {value}", eval_mode="fraction", train_split_fraction=value)
        for value in (0.0, -1.0, 2.0, math.nan)
    ),
    *(
        option(f"--camera-res-scale-factor {value}", manager={"camera_res_scale_factor": value})
        for value in (0.0, -1.0, math.nan, 1e-9, 1e9)
    ),
    option("--eval-mode filename", eval_mode="filename"),
    Case("--data not there", lambda folder: partial(load, folder / "nowhere")),
    Case("--data empty", lambda folder: partial(load, folder)),
    Case("--data too long", lambda folder: partial(load, folder / LONG)),
    Case("--data with a zero byte", lambda folder: partial(load, Path(f"{folder}/a\0b"))),
    Case("--data a device", lambda folder: partial(load, Path("/dev/zero"))),
]


def inputs() -> st.SearchStrategy[Case]:
    """A whole capture, some of whose fields are something else."""

    def case(chosen) -> Case:
        def build(folder: Path):
            return changed(lambda capture: replace_in(capture.meta, chosen), folder)

        return Case(f"fields {chosen}"[:200], build, hostile=False)

    return replacements().map(case)
