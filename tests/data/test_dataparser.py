# SPDX-License-Identifier: Apache-2.0
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.utils.colmap_parsing_utils import Point3D, write_points3D_binary, write_points3D_text
from small_capture import Capture, listing

from nrfgs_ns.data.dataparser import NrfgsDataParserConfig
from nrfgs_ns.data.views import different_views, interior_test_images


def names(outputs) -> list[int]:
    return [int(Path(path).stem) for path in outputs.image_filenames]


def cloud(n: int = 20) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    return rng.normal((5, 6, 7), 2, (n, 3)).astype(np.float32), rng.integers(0, 256, (n, 3), dtype=np.uint8)


def seen_from(poses: np.ndarray, xyz: np.ndarray) -> np.ndarray:
    return np.einsum("cij,cni->cnj", poses[:, :, :3], xyz[None] - poses[:, None, :, 3])


def assert_points_stay_in_front_of_cameras(capture, outputs, xyz):
    """Parsing turns, moves and scales cameras and points together: what a camera sees changes by the scale only."""
    poses = {Path(f["file_path"]).stem: np.array(f["transform_matrix"])[:3] for f in capture.meta["frames"]}
    before = np.stack([poses[Path(path).stem] for path in outputs.image_filenames])
    after = outputs.cameras.camera_to_worlds.numpy().astype(np.float64)
    seen = seen_from(after, outputs.metadata["points3D_xyz"].numpy().astype(np.float64))
    # float32 poses with entries below 10: 10 x 2^-24 from rounding them, times the few sums of a product: 1e-5.
    np.testing.assert_allclose(seen, outputs.dataparser_scale * seen_from(before, xyz), atol=1e-5)


def test_every_eighth_image_by_sorted_name_is_test_but_neither_end(capture):
    assert names(capture.parse("train")) == [0, 1, 2, 3, 5, 6, 7, 8, 9]
    assert names(capture.parse("val")) == names(capture.parse("test")) == [4]
    for count, test in (1, [0]), (2, [0]), (3, [1]), (5, [2]), (8, [3]), (9, [4]), (13, [4]), (14, [4, 12]):
        assert list(interior_test_images(count)) == test


@pytest.mark.parametrize("split", ["train", "val", "test"])
@pytest.mark.parametrize("distortion", [{}, {"k1": 0.01, "p2": 0.02}])
def test_cameras_are_those_of_nerfstudio(capture, split, distortion):
    capture.meta |= distortion
    ours = capture.parse(split, eval_mode="interval")
    theirs = NerfstudioDataParserConfig(data=capture.folder, eval_mode="interval").setup().get_dataparser_outputs(split)
    assert ours.image_filenames == theirs.image_filenames
    for name in ("camera_to_worlds", "fx", "fy", "cx", "cy", "width", "height", "distortion_params"):
        assert torch.equal(getattr(ours.cameras, name), getattr(theirs.cameras, name)), name
    assert torch.equal(ours.dataparser_transform, theirs.dataparser_transform)
    assert ours.dataparser_scale == theirs.dataparser_scale


@pytest.mark.parametrize("kept, other", [("val", {}), ("val", {"test_filenames": []}), ("test", {})])
def test_val_and_test_stand_in_for_each_other_and_train_for_both(capture, printed, kept, other):
    path = [frame["file_path"] for frame in capture.meta["frames"]]
    capture.meta |= {"train_filenames": path[3:], f"{kept}_filenames": path[:3], **other}
    assert names(capture.parse("train")) == list(range(7))
    assert names(capture.parse("val")) == names(capture.parse("test")) == [7, 8, 9]
    assert "evaluated instead" not in printed()
    assert len(names(capture.parse(eval_mode="all"))) == 7 and "--eval-mode all changes nothing" in printed()
    capture.meta |= {"train_filenames": path[:4], "val_filenames": [], "test_filenames": []}
    assert names(capture.parse("test")) == [6, 7, 8, 9]
    assert "no image is kept for test" in printed()


@pytest.mark.parametrize("orientation", ["pca", "up", "vertical", "none"])
@pytest.mark.parametrize("center", ["poses", "focus", "none"])
def test_one_image(tmp_path, printed, orientation, center):
    single = Capture(tmp_path / "single", images=1)
    single.add_ply(*cloud())
    parser = single.parser(orientation_method=orientation, center_method=center)
    train, val = (parser.get_dataparser_outputs(split) for split in ("train", "val"))
    assert names(train) == names(val) == [0]
    assert "The training images are evaluated instead" in printed()
    assert_points_stay_in_front_of_cameras(single, train, cloud()[0])
    assert train.dataparser_scale == 1.0


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("kind", ["uchar", "int", "float", "none"])
def test_ply(capture, printed, monkeypatch, text, kind):
    monkeypatch.setitem(sys.modules, "open3d", None)  # importing it would raise
    xyz, rgb = cloud()
    stored = {"uchar": rgb, "int": rgb.astype(np.int32), "float": (rgb / 255).astype(np.float32), "none": None}[kind]
    capture.add_ply(xyz, stored, text)
    outputs = capture.parse()
    points, colours = outputs.metadata["points3D_xyz"], outputs.metadata["points3D_rgb"]
    assert points.shape == colours.shape == (20, 3) and points.dtype == torch.float32 and colours.dtype == torch.uint8
    assert_points_stay_in_front_of_cameras(capture, outputs, xyz)
    np.testing.assert_array_equal(colours, np.full_like(rgb, 127) if kind == "none" else rgb)
    assert ("points.ply has no colours" in printed()) == (kind == "none")


def test_points_that_are_not_finite_are_dropped_and_counted(capture, printed):
    xyz, rgb = cloud()
    colours = (rgb / 255).astype(np.float32)
    xyz[3, 1], xyz[5, 0], colours[9, 2] = np.nan, np.inf, np.nan
    capture.add_ply(xyz, colours)
    parser = capture.parser()
    for split in ("train", "val"):
        kept = parser.get_dataparser_outputs(split).metadata["points3D_rgb"]
        np.testing.assert_array_equal(kept, np.delete(rgb, [3, 5, 9], axis=0))
    assert printed().count("3 of 20 points have a NaN or infinite value") == 1


@pytest.mark.parametrize("points", [None, 0, 3])
def test_without_points_one_warning(capture, printed, points):
    if points is not None:
        capture.add_ply(*cloud(points))
    parser = capture.parser()
    for split in ("train", "val"):
        assert "points3D_xyz" not in parser.get_dataparser_outputs(split).metadata
    assert printed().count("Training starts from random points") == 1
    capture.parse(load_3D_points=False)
    assert "random points" not in printed()


@pytest.mark.parametrize("write, name, as_file, applied", [
    (write_points3D_binary, "points3D.bin", False, None),
    (write_points3D_text, "points3D.txt", True, [[0, 0, 1, 3], [1, 0, 0, 4], [0, 1, 0, 5]]),
])  # fmt: skip
def test_points_of_colmap_without_a_question(capture, monkeypatch, write, name, as_file, applied):
    """They land where nerfstudio's own conversion to a .ply puts them: moved into the world of the poses first."""
    monkeypatch.setattr("rich.prompt.Confirm.ask", lambda *_, **__: pytest.fail("asked a question"))
    xyz, rgb = cloud()
    folder = capture.folder / "colmap" / "sparse" / "0"
    folder.mkdir(parents=True)
    nothing = np.empty(0, dtype=int)
    # nerfstudio's axes for data sets from before it wrote applied_transform.
    world = np.array(applied or [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]], dtype=np.float64)
    stored = (xyz - world[:, 3]) @ world[:, :3]
    points = {i: Point3D(i, p, c, 0.5, nothing, nothing) for i, (p, c) in enumerate(zip(stored, rgb, strict=True))}
    write(points, folder / name)
    if applied is not None:
        capture.meta["applied_transform"] = applied
    parser = capture.parser(data=capture.folder / "transforms.json" if as_file else capture.folder)
    before, outputs = listing(capture.folder), parser.get_dataparser_outputs("train")
    assert listing(capture.folder) == before

    assert_points_stay_in_front_of_cameras(capture, outputs, xyz)
    np.testing.assert_array_equal(outputs.metadata["points3D_rgb"], rgb)


# The house around it.
def test_rendering_from_a_checkpoint_needs_no_files(capture):
    capture.add_masks()
    capture.add_ply(*cloud()).unlink()
    for path in [*capture.folder.rglob("*.png")]:
        path.unlink()
    parser = capture.parser()
    parser.downscale_factor = 1  # how nerfstudio's datamanager announces it
    for split in ("train", "test"):
        assert len(parser.get_dataparser_outputs(split).cameras) > 0


def test_nerfstudio_finds_the_plugin_where_it_is_imported_first():
    """nerfstudio loads plugins while it imports itself: a circle of imports would show in one of the two orders."""
    code = "import nrfgs_ns.data.dataparser; from nerfstudio.configs.dataparser_configs import all_dataparsers as a;"
    parsers = {"NERFSTUDIO_DATAPARSER_CONFIGS": "nrfgs-data=nrfgs_ns.data.dataparser:nrfgs_dataparser"}
    environment = {**os.environ, **parsers, "PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run([sys.executable, "-c", code + "a['nrfgs-data']"], env=environment, check=True, timeout=300)


@pytest.mark.parametrize("name, train, test, points, masks", [
    ("bonsai", 255, 37, 72486, False), ("goldcape", 74, 11, 21640, True), ("kitchen", 21, 3, 2630, False),
    ("fox", 43, 7, 11030, False), ("fern", 17, 3, 6407, False),
])  # fmt: skip
def test_real_captures(captures, name, train, test, points, masks):
    parser = NrfgsDataParserConfig(data=captures / name).setup()
    outputs = parser.get_dataparser_outputs("train")
    assert len(outputs.image_filenames) == different_views(outputs.cameras.camera_to_worlds) == train
    assert len(parser.get_dataparser_outputs("test").image_filenames) == test
    assert outputs.metadata["points3D_xyz"].shape == outputs.metadata["points3D_rgb"].shape == (points, 3)
    assert (outputs.mask_filenames is not None) == masks
