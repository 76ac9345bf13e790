# SPDX-License-Identifier: Apache-2.0
"""What is read from EXIF, and what goes into copies."""

import pytest
from PIL import ExifTags, Image

from nrfgs_ns.data.exif import exif_of_copy, read_exif

TAKEN = {"exposure_time": 1 / 250, "f_number": 2.4, "iso": 50.0, "focal_length": 4.3, "make": "Maker", "model": "Phone"}


def rounded(found: dict) -> dict:
    return {key: round(value, 6) if isinstance(value, float) else value for key, value in found.items()}


def photographed(path, **details):
    exif = Image.Exif()
    exif[ExifTags.Base.Make], exif[ExifTags.Base.Model], exif[ExifTags.Base.Orientation] = "Maker", "Phone\0", 6
    exif[ExifTags.Base.ImageDescription] = "a thousand words"
    exif.get_ifd(ExifTags.IFD.Exif).update(
        {
            ExifTags.Base.ExposureTime: 1 / 250,
            ExifTags.Base.FNumber: 2.4,
            ExifTags.Base.ISOSpeedRatings: 50,
            ExifTags.Base.FocalLength: 4.3,
            ExifTags.Base.ExifImageWidth: 4000,
        }
        | {getattr(ExifTags.Base, name): value for name, value in details.items()}
    )
    exif.get_ifd(ExifTags.IFD.GPSInfo).update({1: "N", 2: (55.0, 41.0, 53.4), 3: "E", 4: (13.0, 11.0, 43.4)})
    Image.new("RGB", (8, 6)).save(path, exif=exif)
    return path


def test_a_photograph_says_how_it_was_taken(tmp_path):
    assert rounded(read_exif(photographed(tmp_path / "a.jpg"))) == TAKEN


def test_what_is_no_number_is_left_out(tmp_path):
    path = photographed(tmp_path / "a.jpg", ExposureTime=0.0, ISOSpeedRatings=(0, 100), FNumber=-1.0)
    assert not {"exposure_time", "f_number", "iso"} & set(read_exif(path))
    Image.new("RGB", (8, 6)).save(tmp_path / "b.png")
    (tmp_path / "c.jpg").write_bytes(b"junk")
    assert read_exif(tmp_path / "b.png") == read_exif(tmp_path / "c.jpg") == read_exif(tmp_path / "none") == {}


@pytest.mark.parametrize("suffix", ["jpg", "png"])
def test_a_copy_keeps_what_holds_for_it(tmp_path, suffix):
    with Image.open(photographed(tmp_path / "a.jpg")) as image:
        image.resize((4, 3)).save(tmp_path / f"b.{suffix}", exif=exif_of_copy(image.getexif()))
    assert rounded(read_exif(tmp_path / f"b.{suffix}")) == TAKEN
    with Image.open(tmp_path / f"b.{suffix}") as image:
        exif = image.getexif()
    assert exif.get_ifd(ExifTags.IFD.GPSInfo)[4] == (13.0, 11.0, 43.4)
    gone = {ExifTags.Base.Orientation, ExifTags.Base.ImageDescription, ExifTags.Base.ExifImageWidth}
    assert not gone & {*exif, *exif.get_ifd(ExifTags.IFD.Exif)}
