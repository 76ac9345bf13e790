# SPDX-License-Identifier: Apache-2.0
import os
import threading
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.instant_ngp_dataparser import InstantNGPDataParserConfig
from nerfstudio.data.datasets.base_dataset import InputDataset
from PIL import Image
from small_capture import Capture

from nrfgs_ns.data.datamanager import NrfgsDatamanager, NrfgsDatamanagerConfig, NrfgsInputDataset
from nrfgs_ns.data.pictures import in_parallel
from nrfgs_ns.errors import InputError


def manager(capture, parser_options=None, **options) -> NrfgsDatamanager:
    parser_options = {"eval_mode": "interval", **(parser_options or {})}  # tests on images 0 and 8
    dataparser = capture.parser(load_3D_points=False, **parser_options).config
    return NrfgsDatamanagerConfig(dataparser=dataparser, **options).setup(device="cpu")


@pytest.mark.parametrize("scale", [1.0, 0.5])
@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L"])
@pytest.mark.parametrize("kind", ["uint8", "float32"])
def test_ordinary_images_are_read_as_nerfstudio_reads_them(capture, mode, scale, kind):
    pixels = capture.rng.integers(0, 256, (9, 12, len(mode)), dtype=np.uint8)
    Image.fromarray(pixels.squeeze()).save(capture.folder / "images/001.png")
    outputs = capture.parse()
    ours, theirs = (dataset(outputs, scale).get_data(0, kind) for dataset in (NrfgsInputDataset, InputDataset))
    assert torch.equal(ours["image"], theirs["image"])


@pytest.mark.parametrize("mode, channels", [("P", 3), ("CMYK", 3), ("1", 3), ("LA", 4), ("transparent P", 4)])
def test_other_images_are_converted_to_colour(capture, mode, channels):
    """nerfstudio takes each of these for something else, or stops without naming the file."""
    colours = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255]], dtype=np.uint8)
    if mode in ("1", "LA"):
        colours = np.array([[0] * 3, [255] * 3], dtype=np.uint8)
    pixels = colours[capture.rng.integers(0, len(colours), (9, 12))]
    image = Image.fromarray(pixels).convert(mode.split()[-1])
    options = {"transparency": 0} if mode == "transparent P" else {}
    image.save(capture.folder / "images/001.png", "TIFF" if mode == "CMYK" else "PNG", **options)
    data = NrfgsInputDataset(capture.parse()).get_data(1, "uint8")["image"]
    assert data.shape == (9, 12, channels)
    assert (data[..., :3].numpy() == pixels).all()


def test_images_are_made_smaller_to_the_size_of_their_cameras(tmp_path, monkeypatch):
    """int(50 * 0.58) is 28, of which nerfstudio's cameras, in float32, make 29."""
    monkeypatch.setattr(Capture, "width", 50)
    capture = Capture(tmp_path / "wide", images=10)
    capture.meta |= {"fl_x": 40.0, "fl_y": 40.0, "cx": 25.0}
    capture.add_masks()
    data = manager(capture, camera_res_scale_factor=0.58)
    assert data.cached_train[0]["image"].shape == (5, 28, 3) and data.cached_train[0]["mask"].shape == (5, 28, 1)
    assert (data.train_dataset.cameras.width == 28).all() and (data.train_dataset.cameras.height == 5).all()


def test_image_of_another_size_is_named(capture):
    """Other parsers than ours do not compare sizes; here the file changes after parsing."""
    data = manager(capture)
    Image.new("RGB", (9, 12)).save(capture.folder / "images/003.png")
    with pytest.raises(InputError, match=r"003.png is 9 x 12, but its camera 12 x 9"):
        data.load_all_images()


@pytest.mark.parametrize("factor", [1, 2])
def test_jpeg_masks_are_halved(capture, factor):
    """JPEG rings: outside is not quite 0."""
    inside = np.zeros((16, 24), dtype=bool)
    inside[2:11, 5:19] = True
    capture.meta |= {"w": 24, "h": 16, "cx": 12.0, "cy": 8.0}
    (capture.folder / "masks").mkdir()
    for frame in capture.meta["frames"]:
        Image.new("RGB", (24, 16)).save(capture.folder / frame["file_path"])
        frame["mask_path"] = frame["file_path"].replace("images", "masks").replace("png", "jpg")
        Image.fromarray(inside).convert("L").save(capture.folder / frame["mask_path"], quality=50)
        assert (np.array(Image.open(capture.folder / frame["mask_path"]))[~inside] > 0).any()
    data = manager(capture, {"downscale_factor": factor})
    assert np.array_equal(data.cached_train[0]["mask"][..., 0], inside[factor // 2 :: factor, factor // 2 :: factor])


@pytest.mark.parametrize("free, workers, threads", [(1e9, 4, 4), (9000, 4, 2), (16 * 108, 4, 1), (1e9, None, 4)])
def test_free_memory_and_small_pictures_bound_the_threads_that_decode(monkeypatch, free, workers, threads):
    running, most = set(), []

    def read(index):
        running.add(index)
        most.append(len(running))
        barrier.wait(timeout=60)
        running.remove(index)

    monkeypatch.setattr("os.cpu_count", lambda: 64)
    monkeypatch.setattr("psutil.virtual_memory", lambda: SimpleNamespace(available=free))
    barrier = threading.Barrier(threads)
    list(in_parallel(read, [(12, 9)] * 12, "Reading", workers))
    assert max(most) == threads
    with pytest.raises(InputError, match="image of 9000 x 9000 takes about"):
        list(in_parallel(read, [(12, 9), (9000, 9000)], "Reading"))


@pytest.mark.parametrize("lens", [
    {"k1": 0.3}, {"k1": -0.2, "k2": 0.03, "k3": 0.01, "p1": 0.01, "p2": -0.02, "cx": 7.0},
    {"camera_model": "OPENCV_FISHEYE"}, {"camera_model": "OPENCV_FISHEYE", "k1": 0.05, "k4": 0.01, "cy": 3.8},
])  # fmt: skip
def test_undistorted_images_and_their_cameras_are_nerfstudios_and_can_be_read_again(capture, lens):
    """The cameras without an image that is read, as exports and renderings want them."""
    capture.meta |= {"fl_x": 12.0, "fl_y": 12.0, **lens}
    capture.add_masks()
    ours = manager(capture, camera_res_scale_factor=2.0)
    options = {"dataparser": ours.config.dataparser, "camera_res_scale_factor": 2.0, "cache_images_type": "uint8"}
    theirs = FullImageDatamanagerConfig(**options).setup(device="cpu")
    images = theirs.cached_train
    cameras, wanted = ours.train_dataset.cameras, theirs.train_dataset.cameras
    for name in ("camera_to_worlds", "fx", "fy", "cx", "cy", "width", "height"):
        torch.testing.assert_close(getattr(cameras, name), getattr(wanted, name), rtol=1e-6, atol=1e-6)
    assert (cameras.camera_type == CameraType.PERSPECTIVE.value).all() and cameras.distortion_params is None
    assert not torch.equal(cameras.fx, ours.train_dataset.lenses.fx)
    for read in (ours.cached_train, [ours.train_dataset.get_data(index, "uint8") for index in range(len(images))]):
        torch.testing.assert_close(read, images, rtol=0, atol=0)


def next_cameras(data, count: int) -> list[int]:
    return [data.next_train(0)[0].metadata["cam_idx"] for _ in range(count)]


@pytest.mark.parametrize("steps", [7, 8, 20])  # 8 cameras: before, at and after the end of a round
def test_order_continues_after_a_restore(capture, tmp_path, steps):
    first = manager(capture)
    next_cameras(first, steps)
    torch.save(first.sampling_state(), tmp_path / "state.pt")
    expected = next_cameras(first, 30)

    second = manager(capture)
    next_cameras(second, 5)
    second.load_sampling_state(torch.load(tmp_path / "state.pt", weights_only=True))
    assert next_cameras(second, 30) == expected
    assert len(set(expected)) > 3


@pytest.mark.parametrize("distorted", [False, True])
def test_images_in_files_are_those_in_memory(capture, tmp_path, monkeypatch, printed, distorted):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    capture.add_masks()
    if distorted:
        capture.meta |= {"k1": 0.3, "fl_x": 12.0, "fl_y": 12.0}

    def loaded(**options):
        data = manager(capture, **options)
        data.load_all_images()
        return data, [data.cached_train, data.cached_eval]

    in_memory, expected = loaded()
    assert not (tmp_path / "cache").exists()
    for _ in range(2):
        in_files, found = loaded(image_memory=0.0)
        assert "read from files" in printed()
        torch.testing.assert_close(found, expected, rtol=0, atol=0)
        for step in range(20):
            camera, batch = in_files.next_train(step)
            torch.testing.assert_close(batch["image"], in_memory.cached_train[camera.metadata["cam_idx"]]["image"])
        in_files.cached_train[0]["image"].zero_()  # in memory, not in the file
    assert len(list((tmp_path / "cache").rglob("*.pt"))) == 10, "one for each photograph, made once"

    picture = Image.open(capture.folder / "images/004.png").convert("RGB")
    Image.eval(picture, lambda value: 255 - value).save(capture.folder / "images/004.png")
    anew, _ = loaded(image_memory=0.0)
    assert len(list((tmp_path / "cache").rglob("*.pt"))) == 10 + 1
    assert not torch.equal(anew.cached_train[3]["image"], in_memory.cached_train[3]["image"])


@pytest.mark.parametrize("left", [None, 0, 1, 500])
def test_files_that_are_lost_or_cut_are_made_anew(capture, tmp_path, monkeypatch, left):
    """As those who clean a cache leave them, or a system that stopped."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    capture.add_masks()
    before = [data["image"].clone() for data in manager(capture, image_memory=0.0).cached_train]
    for path in (tmp_path / "cache").rglob("*.pt"):
        path.unlink() if left is None else os.truncate(path, left)
    torch.testing.assert_close([data["image"] for data in manager(capture, image_memory=0.0).cached_train], before)


def test_data_of_another_kind_is_told(capture):
    capture.meta = {"frames": []}
    parser = InstantNGPDataParserConfig(data=capture.save().parent)
    with pytest.raises(InputError, match=f"{capture.folder} cannot be read .AssertionError.* what kind of data set"):
        NrfgsDatamanagerConfig(dataparser=parser).setup(device="cpu")


@pytest.mark.parametrize("kind", [CameraType.FISHEYE624, CameraType.EQUIRECTANGULAR])
def test_cameras_of_other_parsers_that_cannot_be_drawn_are_told(capture, kind):
    outputs = capture.parse()
    outputs.cameras.camera_type[1] = kind.value
    with pytest.raises(InputError, match=f"{kind.name} cannot be trained on.*[Uu]ndistort"):
        NrfgsInputDataset(outputs)


@pytest.mark.parametrize("kind", [AttributeError, AssertionError, KeyError, TypeError])
@pytest.mark.parametrize("place", ["dataparser.checks.check_options", "datamanager.different_views"])
def test_mistakes_of_our_own_keep_their_traceback(capture, monkeypatch, place, kind):
    def mistaken(_):
        raise kind("ours")

    monkeypatch.setattr(f"nrfgs_ns.data.{place}", mistaken)
    with pytest.raises(kind, match="ours"):
        manager(capture)


def test_no_room_for_files_is_said(capture, tmp_path, monkeypatch):
    (tmp_path / "cache").write_text("in the way")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    with pytest.raises(InputError, match="cannot be written .*image-memory"):
        manager(capture, image_memory=0.0).load_all_images()
    with pytest.raises(InputError, match="image-memory is -1"):
        manager(capture, image_memory=-1.0)
