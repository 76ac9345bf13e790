# SPDX-License-Identifier: Apache-2.0
"""COLMAP's models: read as nerfstudio reads them, without its question. tests/attack breaks them."""

import numpy as np
import pytest
import torch
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParser, ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from small_colmap import MODEL, Model

from nrfgs_ns.data.colmap_parser import NrfgsColmapDataParser, checked
from nrfgs_ns.data.datamanager import NrfgsDatamanagerConfig
from nrfgs_ns.data.dataparser import NrfgsDataParser, NrfgsDataParserConfig
from nrfgs_ns.errors import InputError

LENSES = {
    "SIMPLE_PINHOLE": (0, (10.0, 6.0, 4.5)),
    "PINHOLE": (1, (10.0, 11.0, 6.0, 4.5)),
    "SIMPLE_RADIAL": (2, (10.0, 6.0, 4.5, 0.1)),
    "RADIAL": (3, (10.0, 6.0, 4.5, 0.1, 0.02)),
    "OPENCV": (4, (10.0, 11.0, 6.0, 4.5, 0.1, 0.02, 1e-3, -1e-3)),
    "OPENCV_FISHEYE": (5, (10.0, 11.0, 6.0, 4.5, 0.1, 0.02, 1e-3, 0.0)),  # nerfstudio refuses a fourth
    "SIMPLE_RADIAL_FISHEYE": (8, (10.0, 6.0, 4.5, 0.1)),
    "RADIAL_FISHEYE": (9, (10.0, 6.0, 4.5, 0.1, 0.02)),
}


@pytest.fixture
def scene(tmp_path):
    return Model().write(tmp_path / "scene")


def parse(folder, split="train", **options):
    return checked(ColmapDataParserConfig(data=folder, **options)).setup().get_dataparser_outputs(split)


def same_as_nerfstudio(folder, **options):
    for split in ("train", "val", "test"):
        ours = parse(folder, split, **options)
        theirs = ColmapDataParser(ColmapDataParserConfig(data=folder, **options)).get_dataparser_outputs(split)
        assert ours.image_filenames == theirs.image_filenames
        # One turns the world before it inverts the pose, the other after.
        torch.testing.assert_close(ours.cameras.camera_to_worlds, theirs.cameras.camera_to_worlds, atol=1e-6, rtol=1e-6)
        for name in ("fx", "fy", "cx", "cy", "width", "height", "distortion_params", "camera_type"):
            assert torch.equal(getattr(ours.cameras, name), getattr(theirs.cameras, name)), name
        # Points are about 1 away; nerfstudio multiplies them in float32.
        torch.testing.assert_close(ours.metadata["points3D_xyz"], theirs.metadata["points3D_xyz"], atol=1e-5, rtol=0)
        assert torch.equal(ours.metadata["points3D_rgb"], theirs.metadata["points3D_rgb"])
        torch.testing.assert_close(ours.dataparser_transform.float(), theirs.dataparser_transform)
        assert ours.dataparser_scale == theirs.dataparser_scale
    return ours


@pytest.mark.parametrize("lens", LENSES)
def test_binary_as_nerfstudio(tmp_path, lens):
    one = Model()
    one.cameras = [(1, LENSES[lens][0], 12, 9, LENSES[lens][1])]
    same_as_nerfstudio(one.write(tmp_path / "scene"))


@pytest.mark.parametrize("options", [
    {},
    {"orientation_method": "none", "center_method": "none", "auto_scale_poses": False},
    {"assume_colmap_world_coordinate_convention": False, "eval_mode": "fraction"},
    {"scale_factor": 0.3, "eval_interval": 3},
])  # fmt: skip
def test_text_as_nerfstudio(tmp_path, options):
    same_as_nerfstudio(Model().write(tmp_path / "scene", text=True), **options)


def test_lists_of_splits(scene, printed):
    for split, numbers in (("train", (1, 2, 5)), ("test", (0, 9))):
        (scene / f"{split}_list.txt").write_text("".join(f"{i:03d}.png\n" for i in numbers))
    assert [path.name for path in parse(scene).image_filenames] == ["001.png", "002.png", "005.png"]
    assert [path.name for path in parse(scene, "val").image_filenames] == ["000.png", "009.png"]
    assert "--eval-mode" not in printed()
    (scene / "train_list.txt").unlink()
    with pytest.raises(InputError, match=r"test_list.txt, but no train_list.txt"):
        parse(scene)


def test_it_is_what_the_colmap_command_uses(scene):
    assert checked(ColmapDataParserConfig())._target is NrfgsColmapDataParser
    assert checked(NerfstudioDataParserConfig())._target is NrfgsDataParser
    own = NrfgsDataParserConfig()
    assert checked(own) is own
    manager = NrfgsDatamanagerConfig(dataparser=ColmapDataParserConfig(data=scene)).setup(device="cpu")
    assert type(manager.dataparser) is NrfgsColmapDataParser
    assert (len(manager.cached_train), len(manager.cached_eval)) == (8, 2)


def test_cameras_of_several_models(tmp_path):
    one = Model()
    one.cameras.append((2, 4, 12, 9, LENSES["OPENCV"][1]))
    one.images[0] = (*one.images[0][:3], 2, one.images[0][4])
    outputs = parse(one.write(tmp_path / "scene"), eval_mode="all")
    assert [i for i in range(10) if outputs.cameras.distortion_params[i].any()] == [0]
    one.cameras[1] = (2, 5, 12, 9, LENSES["OPENCV_FISHEYE"][1])
    with pytest.raises(InputError, match="some cameras are fisheyes"):
        parse(one.write(tmp_path / "mixed"))


def test_names_with_spaces_and_images_without_features(tmp_path):
    scene = Model().write(tmp_path / "scene", text=True)
    (scene / "images/003.png").rename(scene / "images/a b.png")
    file = scene / MODEL / "images.txt"
    lines = file.read_text().replace("003.png", "a b.png").splitlines()
    file.write_text("\n".join(line if line.endswith("png") or line[0] == "#" else "" for line in lines) + "\n")
    assert "a b.png" in [path.name for path in parse(scene).image_filenames]
    file.write_text("\n".join(line for line in lines if line.endswith("png")))
    with pytest.raises(InputError, match="each image has two lines"):
        parse(scene)


def test_real_model(captures):
    outputs = same_as_nerfstudio(captures / "fox", colmap_path=MODEL.relative_to("colmap"))
    assert len(outputs.image_filenames) == 7 and np.isfinite(outputs.dataparser_scale)
