# SPDX-License-Identifier: Apache-2.0
"""The methods as nerfbaselines calls them, without nerfbaselines."""

import json
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch.testing import assert_close

from nrfgs_lab.nerfbaselines.method import Nrfgs, NrfgsFast, World
from nrfgs_ns.data.dataparser import NrfgsDataParserConfig
from nrfgs_ns.data.points import read_ply

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
    xyz, rgb = read_ply(scene / "sparse.ply")
    return {
        "cameras": GivenCameras(
            poses * np.array([1, -1, -1, 1], dtype=np.float32),
            np.array([[meta["fl_x"], meta["fl_y"], meta["cx"], meta["cy"]]] * len(frames), dtype=np.float32),
            np.zeros(len(frames), dtype=np.int32),
            np.array([[meta["w"], meta["h"]]] * len(frames), dtype=np.int32),
        ),
        "image_paths": [str(scene / frame["file_path"]) for frame in frames],
        "images": [np.array(Image.open(scene / frame["file_path"])) for frame in frames],
        "masks": None,
        "points3D_xyz": xyz,
        "points3D_rgb": rgb,
        "metadata": {"color_space": "srgb", "evaluation_protocol": "default"},
    }


def train(method: Nrfgs, first: int, last: int) -> None:
    for step in range(first, last):
        method.train_iteration(step)


def test_cameras_and_points_are_where_nerfstudio_has_them(tiny_scene):
    """The world of all images is that of the parser that `ns-train` uses; cameras and points in it are the same."""
    given, config = read(tiny_scene), NrfgsDataParserConfig(data=tiny_scene)
    world = World.around(given["cameras"].poses, config)
    train = config.setup().get_dataparser_outputs("train")
    cameras = world.cameras(read(tiny_scene, "train")["cameras"])
    # Coordinates of size 1 in float32, some ten roundings of 2^-24 away from one another; the intrinsics are copies.
    assert_close(cameras.camera_to_worlds, train.cameras.camera_to_worlds, rtol=0, atol=1e-6)
    for name in ("fx", "fy", "cx", "cy", "width", "height"):
        assert torch.equal(getattr(cameras, name).float(), getattr(train.cameras, name).float()), name
    points = world.points(torch.from_numpy(given["points3D_xyz"]).double()).float()
    assert_close(points, train.metadata["points3D_xyz"], rtol=0, atol=1e-6)


def test_a_checkpoint_renders_without_the_images(tiny_scene, tmp_path):
    folder = tmp_path / "first"
    method = Nrfgs(train_dataset=read(tiny_scene, "train"), config_overrides=OPTIONS)
    train(method, 0, STEPS)
    method.save(str(folder))
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
        inside = method.model.get_outputs_for_camera(method.world.cameras(camera.item()[None]))["depth"][..., 0]
        np.testing.assert_allclose(now["depth"] * method.world.scale, inside, rtol=1e-6)  # in the unit of the data
    assert loaded.render(camera, options={"outputs": ("color",)}).keys() == {"color"}
    loaded.save(str(tmp_path / "again"))
    for name in ("config.yml", "world.json"):
        assert (tmp_path / "again" / name).read_text() == (folder / name).read_text()
    (one,), (other,) = (list(path.rglob("*.ckpt")) for path in (folder, tmp_path / "again"))
    assert one.name == other.name and one.read_bytes() == other.read_bytes()
    loaded.save(str(folder))  # where it came from
    assert one.read_bytes() == other.read_bytes()
    method.close()


def test_a_training_goes_on_as_if_it_had_not_stopped(tiny_scene, tmp_path):
    """`nrfgs-fast`, whose place in its schedules, three steps for each one, is part of the checkpoint."""
    dataset = read(tiny_scene, "train")
    unbroken = NrfgsFast(train_dataset=dataset, config_overrides={"pipeline.model.num_downscales": 0})
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
