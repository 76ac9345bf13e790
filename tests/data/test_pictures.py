# SPDX-License-Identifier: Apache-2.0
"""Smaller copies of images, made where a data set has none."""

import numpy as np
import pytest
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from PIL import ExifTags, Image
from small_capture import Capture, listing
from small_colmap import Model

from nrfgs_ns.data.datamanager import NrfgsDatamanagerConfig
from nrfgs_ns.data.pictures import known_exif, read_exif
from nrfgs_ns.errors import InputError
from nrfgs_prepare.photos import exif_of_copy


@pytest.mark.parametrize("layout", ["transforms.json", "COLMAP"])
def test_images_are_resized_where_there_is_no_folder_of_them(tmp_path, layout):
    if layout == "COLMAP":
        config = ColmapDataParserConfig(data=Model().write(tmp_path / "scene"), downscale_factor=2)
    else:
        capture = Capture(tmp_path / "scene", images=10)
        capture.add_masks()
        config = capture.parser(downscale_factor=2, eval_mode="interval").config
    before = listing(tmp_path / "scene")
    manager = NrfgsDatamanagerConfig(dataparser=config).setup(device="cpu")
    assert (len(manager.cached_train), len(manager.cached_eval)) == (8, 2)
    assert listing(tmp_path / "scene") == before
    image, cameras = manager.cached_train[0], manager.train_dataset.cameras
    assert image["image"].shape == (4, 6, 3)  # 9 / 2 rounded down
    assert (cameras.width == 6).all() and (cameras.height == 4).all() and (cameras.fx == 5.0).all()
    assert [path.name for path in manager.train_dataset.image_filenames][:2] == ["001.png", "002.png"]
    truth = Image.open(tmp_path / "scene/images/001.png").resize((6, 4), Image.Resampling.LANCZOS)
    np.testing.assert_array_equal(image["image"], truth)
    if layout != "COLMAP":
        mask = Image.open(tmp_path / "scene/masks/001.png").resize((6, 4), Image.Resampling.NEAREST)
        np.testing.assert_array_equal(image["mask"][..., 0], np.array(mask) > 0)


def test_folders_of_the_data_set_come_first(tmp_path):
    capture = Capture(tmp_path / "scene", images=10)
    (capture.folder / "images_2").mkdir()
    for path in (capture.folder / "images").iterdir():
        Image.new("RGB", (6, 4), (9, 99, 199)).save(capture.folder / "images_2" / path.name)
    capture.parse(downscale_factor=2)
    Image.new("RGB", (6, 5)).save(capture.folder / "images_2" / "003.png")  # 9 / 2 rounded up
    with pytest.raises(InputError, match=r"003.png is 6 x 5, not 6 x 4.*Remove .*images_2, or.*-mode round"):
        capture.parse(downscale_factor=2)
    (capture.folder / "images_2" / "003.png").unlink()
    with pytest.raises(InputError, match=r"1 of 10 images are missing: .*images_2/003.png"):
        capture.parse(downscale_factor=2)


def test_large_photographs_of_colmap_need_no_answer(tmp_path, monkeypatch):
    monkeypatch.setattr("rich.prompt.Confirm.ask", lambda *_, **__: pytest.fail("asked a question"))
    one = Model()
    one.cameras = [(1, 1, 1700, 8, (1500.0, 1500.0, 850.0, 4.0))]
    scene = one.write(tmp_path / "scene")
    for path in (scene / "images").iterdir():
        Image.new("RGB", (1700, 8)).save(path)
    manager = NrfgsDatamanagerConfig(dataparser=ColmapDataParserConfig(data=scene)).setup(device="cpu")
    assert manager.train_dataset[0]["image"].shape == (4, 850, 3)


TAKEN = {"exposure_time": 1 / 250, "f_number": 2.4, "iso": 50.0, "focal_length": 4.3, "model": "Phone"}


def photographed(path, **details):
    exif = Image.Exif()
    exif[ExifTags.Base.Make], exif[ExifTags.Base.Model], exif[ExifTags.Base.Orientation] = "Maker", "Phone\0", 6
    exif[ExifTags.Base.ImageDescription] = "a thousand words"
    usual = {"ExposureTime": 1 / 250, "FNumber": 2.4, "ISOSpeedRatings": 50, "FocalLength": 4.3, "ExifImageWidth": 4000}
    tags = {getattr(ExifTags.Base, name): value for name, value in (usual | details).items()}
    exif.get_ifd(ExifTags.IFD.Exif).update(tags)
    exif.get_ifd(ExifTags.IFD.GPSInfo).update({1: "N", 2: (55.0, 41.0, 53.4), 3: "E", 4: (13.0, 11.0, 43.4)})
    Image.new("RGB", (8, 6)).save(path, exif=exif)
    return path


def test_a_photograph_says_how_it_was_taken_and_what_is_no_number_is_left_out(tmp_path):
    assert read_exif(photographed(tmp_path / "a.jpg")) == pytest.approx(TAKEN)
    path = photographed(tmp_path / "a.jpg", ExposureTime=0.0, ISOSpeedRatings=(0, 100), FNumber=-1.0)
    assert not {"exposure_time", "f_number", "iso"} & set(read_exif(path))
    Image.new("RGB", (8, 6)).save(tmp_path / "b.png")
    (tmp_path / "c.jpg").write_bytes(b"junk")
    assert read_exif(tmp_path / "b.png") == read_exif(tmp_path / "c.jpg") == read_exif(tmp_path / "none") == {}
    assert known_exif({"iso": 50, "f_number": float("inf"), "exposure_time": 10**400}) == {"iso": 50.0}
    assert known_exif("junk") == {}


@pytest.mark.parametrize("suffix", ["jpg", "png"])
def test_a_copy_keeps_what_holds_for_it(tmp_path, suffix):
    with Image.open(photographed(tmp_path / "a.jpg")) as image:
        image.resize((4, 3)).save(tmp_path / f"b.{suffix}", exif=exif_of_copy(image.getexif()))
    assert read_exif(tmp_path / f"b.{suffix}") == pytest.approx(TAKEN)
    with Image.open(tmp_path / f"b.{suffix}") as image:
        exif = image.getexif()
    assert exif.get_ifd(ExifTags.IFD.GPSInfo)[4] == (13.0, 11.0, 43.4)
    gone = {ExifTags.Base.Orientation, ExifTags.Base.ImageDescription, ExifTags.Base.ExifImageWidth}
    assert not gone & {*exif, *exif.get_ifd(ExifTags.IFD.Exif)}


@pytest.fixture(params=[".heic", ".jpg"])
def renamed(capture, request) -> list:
    for frame in capture.meta["frames"]:
        frame["file_path"] = frame["file_path"].replace(".png", request.param)
    return [capture.folder / frame["file_path"] for frame in capture.meta["frames"]]


def test_photographs_of_a_data_set_may_be_heic(capture, renamed):
    pillow_heif = pytest.importorskip("pillow_heif", reason="needs pillow-heif")
    flat = Image.new("RGB", (capture.width, capture.height), (9, 99, 199))
    [pillow_heif.from_pillow(flat).save(path, quality=-1) for path in renamed]
    manager = NrfgsDatamanagerConfig(dataparser=capture.parser(eval_mode="interval").config).setup(device="cpu")
    manager.load_all_images()
    np.testing.assert_allclose(manager.cached_train[0]["image"].int(), flat, atol=2)


def test_without_pillow_heif_the_message_says_what_to_install(capture, renamed, no_heif):
    [path.write_bytes(b"\0\0\0\x18ftypheic") for path in renamed]
    with pytest.raises(InputError, match=r"images/\d+.(heic|jpg) is .*Run `pip install pillow-heif`"):
        capture.parse()
