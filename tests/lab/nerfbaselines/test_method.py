# SPDX-License-Identifier: Apache-2.0
"""The methods as nerfbaselines calls them. Most tests need no nerfbaselines; those that do skip where it is absent.

pip install --no-deps nerfbaselines      # its other dependencies come with nerfstudio; it asks for an older numpy
pytest tests/lab/nerfbaselines -m 'slow or not slow'
"""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass, fields
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from plyfile import PlyData
from torch.testing import assert_close

from nrfgs_lab import nerfbaselines as package
from nrfgs_lab.nerfbaselines.method import Nrfgs, NrfgsFast, World
from nrfgs_ns.data.dataparser import NrfgsDataParserConfig

needs_nerfbaselines = pytest.mark.skipif(
    find_spec("nerfbaselines") is None, reason="nerfbaselines is not installed: pip install --no-deps nerfbaselines"
)
SPEC = Path(package.__file__).parent / "spec.py"
STEPS = 6
OPTIONS = {"max_num_iterations": 50, "pipeline.model.num_downscales": 0, "logging.steps_per_log": 2}


@dataclass
class GivenCameras:
    """What nerfbaselines' cameras are, as far as a method reads them."""

    poses: np.ndarray
    intrinsics: np.ndarray
    camera_models: np.ndarray
    image_sizes: np.ndarray

    def __getitem__(self, index) -> "GivenCameras":
        return GivenCameras(*(getattr(self, field.name)[index] for field in fields(self)))

    def item(self) -> "GivenCameras":
        return self if self.poses.ndim == 2 else self[0]


def read(scene: Path, split: str | None = None) -> dict:
    """A procedural data set as nerfbaselines would load it; a split, or all images."""
    meta = json.loads((scene / "transforms.json").read_text())
    frames = [frame for frame in meta["frames"] if split is None or frame["file_path"] in meta[f"{split}_filenames"]]
    poses = np.array([frame["transform_matrix"] for frame in frames], dtype=np.float32)[:, :3]
    intrinsics = [[meta["fl_x"], meta["fl_y"], meta["cx"], meta["cy"]]] * len(frames)
    vertices = PlyData.read(scene / "sparse.ply")["vertex"]
    return {
        "cameras": GivenCameras(
            poses * np.array([1, -1, -1, 1], dtype=np.float32),
            np.array(intrinsics, dtype=np.float32),
            np.zeros(len(frames), dtype=np.int32),
            np.array([[meta["w"], meta["h"]]] * len(frames), dtype=np.int32),
        ),
        "image_paths": [str(scene / frame["file_path"]) for frame in frames],
        "images": [np.array(Image.open(scene / frame["file_path"])) for frame in frames],
        "masks": None,
        "points3D_xyz": np.stack([vertices[axis] for axis in "xyz"], axis=-1),
        "points3D_rgb": np.stack([vertices[channel] for channel in ("red", "green", "blue")], axis=-1),
        "metadata": {"color_space": "srgb", "evaluation_protocol": "default"},
    }


def train(method: Nrfgs, first: int, last: int) -> list[dict]:
    return [method.train_iteration(step) for step in range(first, last)]


@pytest.fixture(scope="module")
def trained(tiny_scene, tmp_path_factory):
    """A method after a few steps, its data, and its checkpoint."""
    dataset = read(tiny_scene, "train")
    method = Nrfgs(train_dataset=dataset, config_overrides=OPTIONS)
    metrics = train(method, 0, STEPS)
    folder = tmp_path_factory.mktemp("checkpoint") / "first"
    method.save(str(folder))
    yield method, dataset, folder, metrics
    method.close()


def test_cameras_and_points_are_where_nerfstudio_has_them(tiny_scene):
    """The world of all images is that of the parser that `ns-train` uses; cameras and points in it are the same."""
    given = read(tiny_scene)
    config = NrfgsDataParserConfig(data=tiny_scene)
    world = World.around(given["cameras"].poses, config)
    train = config.setup().get_dataparser_outputs("train")
    cameras = world.cameras(read(tiny_scene, "train")["cameras"])
    # Coordinates of size 1 in float32, some ten roundings of 2^-24 away from one another; the intrinsics are copies.
    assert_close(cameras.camera_to_worlds, train.cameras.camera_to_worlds, rtol=0, atol=1e-6)
    for name in ("fx", "fy", "cx", "cy", "width", "height"):
        assert torch.equal(getattr(cameras, name).float(), getattr(train.cameras, name).float()), name
    points = world.points(torch.from_numpy(given["points3D_xyz"]).double()).float()
    assert_close(points, train.metadata["points3D_xyz"], rtol=0, atol=1e-6)


def test_a_checkpoint_renders_without_the_images(trained, tiny_scene, tmp_path):
    method, _, folder, _ = trained
    loaded = Nrfgs(checkpoint=str(folder))
    assert loaded.get_info()["loaded_step"] == STEPS
    for split in ("train", "test"):
        camera = read(tiny_scene, split)["cameras"][0]
        now, then = loaded.render(camera), method.render(camera)
        assert now.keys() == then.keys() == {"color", "depth", "accumulation"}
        assert now["color"].shape == (36, 48, 3) and now["depth"].shape == (36, 48)
        for name in now:
            assert now[name].dtype == np.float32
            np.testing.assert_array_equal(now[name], then[name])
    assert loaded.render(camera, options={"outputs": ("color",)}).keys() == {"color"}
    loaded.save(str(tmp_path / "again"))
    for name in ("config.yml", "world.json"):
        assert (tmp_path / "again" / name).read_text() == (folder / name).read_text()
    (one,), (other,) = (list(path.rglob("*.ckpt")) for path in (folder, tmp_path / "again"))
    assert one.name == other.name and one.read_bytes() == other.read_bytes()
    loaded.save(str(folder))  # where it came from
    assert one.read_bytes() == other.read_bytes()


def test_a_training_goes_on_as_if_it_had_not_stopped(tiny_scene, tmp_path):
    """`nrfgs-fast`, whose place in its schedules, three steps for each one, is part of the checkpoint."""
    dataset, options = read(tiny_scene, "train"), {"pipeline.model.num_downscales": 0}
    unbroken = NrfgsFast(train_dataset=dataset, config_overrides=options)
    train(unbroken, 0, 3)
    unbroken.save(str(tmp_path / "checkpoint"))
    assert unbroken.trainer.pace.position == pytest.approx(9.0, abs=1e-9)
    camera = read(tiny_scene, "test")["cameras"][0]
    before = unbroken.render(camera)["color"]
    train(unbroken, 3, 6)
    continued = NrfgsFast(checkpoint=str(tmp_path / "checkpoint"), train_dataset=dataset)
    assert continued.get_info()["loaded_step"] == 3
    assert continued.get_info()["num_iterations"] == unbroken.get_info()["num_iterations"]
    train(continued, 3, 6)
    np.testing.assert_array_equal(continued.render(camera)["color"], unbroken.render(camera)["color"])
    assert not np.array_equal(continued.render(camera)["color"], before)
    rates = [one.trainer.optimizers.optimizers["means"].param_groups[0]["lr"] for one in (unbroken, continued)]
    assert rates[0] == rates[1]
    for method in (continued, unbroken):
        method.close()


def test_depth_is_in_the_unit_of_the_data(trained, tiny_scene):
    """A training on the same scene ten times as large sees the same picture, ten times as far away."""
    method, dataset, _, _ = trained
    scaled = {**dataset, "cameras": dataset["cameras"][:], "points3D_xyz": 10 * dataset["points3D_xyz"]}
    scaled["cameras"].poses = dataset["cameras"].poses * np.array([1, 1, 1, 10], dtype=np.float32)
    large = Nrfgs(train_dataset=scaled, config_overrides=OPTIONS)
    small = Nrfgs(train_dataset=dataset, config_overrides=OPTIONS)
    one, ten = small.render(dataset["cameras"][0]), large.render(scaled["cameras"][0])
    # Rounding of coordinates, 2^-24 each, moves alpha by a few 2^-24 times the splats in a pixel's row.
    np.testing.assert_allclose(ten["color"], one["color"], atol=1e-3)
    solid = one["accumulation"] > 0.5
    assert solid.sum() > 100
    np.testing.assert_allclose(ten["depth"][solid], 10 * one["depth"][solid], rtol=1e-3)
    for method in (small, large):
        method.close()


def test_masks_transparency_and_the_background(tiny_scene):
    dataset = read(tiny_scene, "train")
    alpha = np.full((36, 48, 1), 255, np.uint8)
    alpha[:, :10] = 0
    dataset["images"] = [np.concatenate([image, alpha], axis=-1) for image in dataset["images"]]
    dataset["masks"] = [alpha[..., 0] > 0 for _ in dataset["images"]]
    dataset["metadata"]["background_color"] = np.array([255, 255, 255], dtype=np.uint8)
    method = Nrfgs(train_dataset=dataset, config_overrides={**OPTIONS, "pipeline.model.num_random": 10})
    assert method.config.pipeline.model.background_color == "white"
    _, batch = method.trainer.pipeline.datamanager.next_train(0)
    assert batch["image"].shape == (36, 48, 4) and batch["mask"].shape == (36, 48, 1)
    assert not batch["mask"][:, :10].any() and batch["mask"][:, 10:].all()
    train(method, 0, 1)
    method.close()


def test_the_last_steps_are_averaged(tiny_scene, monkeypatch):
    """As `ns-train` does it, once nerfbaselines has made the last of the steps."""
    monkeypatch.setattr("nrfgs_ns.training.averaging.LARGEST_SHARE", 1.0)
    options = {**OPTIONS, "max_num_iterations": 6, "average_steps": 3}
    method = Nrfgs(train_dataset=read(tiny_scene, "train"), config_overrides=options)
    train(method, 0, 5)
    mean = method.trainer.mean
    assert mean.count == 2
    train(method, 5, 6)
    assert mean.count == 0, "the mean was not installed"
    method.close()


@pytest.mark.slow
@needs_nerfbaselines
@pytest.mark.parametrize("method", ["nrfgs", "nrfgs-fast", "nrfgs-sh"])
def test_nerfbaselines_own_test(method, tiny_scene, tmp_path):
    """`nerfbaselines test-method`: train, evaluate, save, load with and without the data, save again, train through
    its own trainer, and evaluate what that wrote. Offline there are no weights of AlexNet: LPIPS is taken for 0.
    """
    scene = shutil.copytree(tiny_scene, tmp_path / "scene")
    # Without a name there is no published checkpoint to compare with, which would have to be downloaded.
    (scene / "nb-info.json").write_text('{"loader": "nerfstudio", "id": null, "scene": null}')
    driver = tmp_path / "driver.py"
    driver.write_text(
        "import numpy, sys, nerfbaselines.metrics as metrics\n"
        "metrics.lpips = metrics.lpips_alex = lambda one, other: numpy.zeros(len(one))\n"
        "from nerfbaselines.cli import main\n"
        "main()\n"
    )
    words = ["test-method", "--method", method, "--data", str(scene), "--backend", "python", "--steps", "40"]
    words += ["--set", "pipeline.model.num_random=500"]
    environment = {**os.environ, "NERFBASELINES_REGISTER": str(SPEC), "HOME": str(tmp_path)}
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))
    found = subprocess.run(
        [sys.executable, str(driver), *words], capture_output=True, text=True, timeout=500, env=environment
    )
    verdicts = [line.strip() for line in found.stdout.splitlines() + found.stderr.splitlines() if line[:2] == "  "]
    assert found.returncode == 0, (verdicts[-25:], found.stderr[-3000:])
