# SPDX-License-Identifier: Apache-2.0
"""Photographs to a posed scene: what is collected, what is refused, what is taken up again, and whether it is right."""

import io
import json
import math
import shutil
import struct
import sys
from pathlib import Path
from unittest.mock import DEFAULT, Mock

import numpy as np
import pytest
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational
from rich.console import Console
from scipy.spatial.transform import Rotation

from nrfgs_ns.data.dataparser import NrfgsDataParserConfig
from nrfgs_ns.data.points import read_ply
from nrfgs_ns.errors import InputError
from nrfgs_prepare import photos, structure
from nrfgs_prepare.command import Prepare, Run
from nrfgs_prepare.scene import write_scene

pytest.importorskip("pycolmap")


def photo(path: Path, size: tuple[int, int] = (40, 30), colour: str = "grey", **options) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size, colour).save(path, **options)
    return path


@pytest.fixture
def three(tmp_path) -> Path:
    return [photo(tmp_path / "in" / f"{i}.png") for i in range(3)][0].parent


# Two textured walls, one before the other, seen by cameras that step sideways and turn a little.
WIDTH, HEIGHT, FOCAL = 320, 240, 300.0


def walk(count: int) -> list[np.ndarray]:
    """Camera-to-world matrices, x right, y down, z forward."""
    poses = []
    for i in range(count):
        pose, turn = np.eye(4), -0.05 * (i - (count - 1) / 2)
        pose[:3, :3] = [[math.cos(turn), 0, math.sin(turn)], [0, 1, 0], [-math.sin(turn), 0, math.cos(turn)]]
        pose[:3, 3] = 0.45 * (i - (count - 1) / 2), 0.15 * (-1) ** i, 0.1 * (i % 3)
        poses.append(pose)
    return poses


def render_walls(pose: np.ndarray) -> Image.Image:
    """Noise of three sizes on a wall at depth 6 and on a smaller one at depth 4, looked up at the nearest texel."""
    rng = np.random.default_rng(0)
    noise = [Image.fromarray(rng.random((n, n)).astype(np.float32)) for n in (32, 96, 256)]
    texture = sum(np.asarray(image.resize((1024, 1024), Image.Resampling.BICUBIC)) for image in noise)
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    rays = np.stack([u / FOCAL, v / FOCAL, np.ones_like(u)], axis=-1) @ pose[:3, :3].T
    image = np.zeros((HEIGHT, WIDTH))
    for depth, half in ((6.0, 20.0), (4.0, 1.0)):
        hit = pose[:3, 3] + rays * ((depth - pose[2, 3]) / rays[..., 2:])
        inside = (np.abs(hit[..., :2]) < half).all(axis=-1)
        texel = (hit[..., :2] * 110 + 37 * depth).astype(int) % 1024
        image = np.where(inside, texture[texel[..., 1], texel[..., 0]], image)
    return Image.fromarray(np.uint8(np.clip(255 * (image / 3 * 1.8 - 0.4), 0, 255))).convert("RGB")


@pytest.fixture(scope="module")
def walls(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("walls") / "photos"
    folder.mkdir()
    for i, pose in enumerate(walk(6)):
        exif = Image.Exif()
        exif.get_ifd(ExifTags.IFD.Exif).update({ExifTags.Base.ExposureTime: 1 / (100 + i)})
        render_walls(pose).save(folder / f"IMG {i:02d}.png", exif=exif.tobytes())  # a blank in the name, as of phones
    return folder


@pytest.fixture(scope="module")
def prepared(walls, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("out") / "scene"
    Prepare(walls, out).main()
    return out


def run_quietly(source: Path, out: Path, **options) -> str:
    screen = Console(record=True, width=200, file=io.StringIO())
    Run(Prepare(source, out, **options), screen).all()
    return screen.export_text()


def aligned(found: np.ndarray, given: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position errors [V] in the units of `given`, and angles [V] in degrees, of poses [V, 4, 4] after the similarity
    that brings their centres closest (Umeyama 1991)."""
    x, y = (poses[:, :3, 3] - poses[:, :3, 3].mean(0) for poses in (found, given))
    rotation = Rotation.align_vectors(y, x)[0]
    errors = np.linalg.norm((rotation.apply(x) * y).sum() / (x**2).sum() * rotation.apply(x) - y, axis=1)
    ours, theirs = (Rotation.from_matrix(poses[:, :3, :3]) for poses in (found, given))
    return errors, np.degrees((rotation * ours * theirs.inv()).magnitude())


def frames_of(scene: Path) -> tuple[dict, np.ndarray]:
    meta = json.loads((scene / "transforms.json").read_text())
    return meta, np.array([frame["transform_matrix"] for frame in meta["frames"]])


def verdict_of(scene: Path) -> dict:
    return json.loads((scene / "prepare.json").read_text())


def check_walk(poses: np.ndarray) -> None:
    """Texels are 1/110 wide: looked up at the nearest, features lie within half of one of the truth, 0.3 px at depth
    4.5, and hundreds of them leave less. A pixel is 0.2 degrees, and 0.02 at depth 6; the path is 2.25 long."""
    errors, angles = aligned(poses @ np.diag([1, -1, -1, 1]), np.stack(walk(6)))
    assert errors.max() < 0.05 and angles.max() < 0.6


# The whole way, in small.
def test_recovered_cameras_are_those_that_rendered(prepared):
    meta, poses = frames_of(prepared)
    for i, frame in enumerate(meta["frames"]):
        assert frame["exif"] == {"exposure_time": pytest.approx(1 / (100 + i))}
    assert meta["fl_x"] / meta["w"] == pytest.approx(FOCAL / WIDTH, rel=0.03)
    check_walk(poses)


def test_the_scene_is_read_by_the_data_parser(prepared):
    parser = NrfgsDataParserConfig(data=prepared).setup()
    outputs, test = (parser.get_dataparser_outputs(split) for split in ("train", "test"))
    assert [path.name for path in outputs.image_filenames] == [f"IMG_{i:02d}.png" for i in (0, 1, 3, 4, 5)]
    assert [path.name for path in test.image_filenames] == ["IMG_02.png"]
    assert len(outputs.metadata["points3D_xyz"]) > 100
    verdict = verdict_of(prepared)
    assert verdict["registered"] == verdict["photographs"] == 6
    assert verdict["points"] == len(outputs.metadata["points3D_xyz"]) and 0 < verdict["mean_reprojection_error_px"] < 1
    for factor in (2, 4, 8):  # the cameras of a copy have its size
        smaller = NrfgsDataParserConfig(data=prepared, downscale_factor=factor).setup().get_dataparser_outputs("train")
        with Image.open(smaller.image_filenames[0]) as image:
            assert image.size == (int(smaller.cameras.width[0]), int(smaller.cameras.height[0]))
            assert f"images_{factor}" in str(smaller.image_filenames[0])


def test_points_are_where_the_cameras_see_them(prepared):
    """The foremost wall is at two thirds of the depth of the other, in the file's own units."""
    xyz, rgb = read_ply(prepared / "sparse.ply")
    world_to_camera = np.linalg.inv(frames_of(prepared)[1][2])
    depth = -(xyz @ world_to_camera[:3, :3].T + world_to_camera[:3, 3])[:, 2]
    assert (depth > 0).all(), "nerfstudio's cameras look along -z"
    near = depth[depth < 0.85 * (far := np.median(depth))]
    # Camera 2 stands 0.2 before the origin and turns by 1.4 degrees: depths 3.8 and 5.8 on its axis.
    assert len(near) > 20 and len(np.unique(rgb)) > 20 and np.median(near) / far == pytest.approx(3.8 / 5.8, abs=0.05)


def test_finished_work_is_not_repeated_and_changes_are_noticed(prepared, walls, three, tmp_path, monkeypatch):
    out = shutil.copytree(prepared, tmp_path / "scene")
    source = shutil.copytree(walls, tmp_path / "photos")
    for name in ("extract_features", "match_features", "find_cameras"):
        monkeypatch.setattr(structure, name, Mock(side_effect=TypeError))
    said = run_quietly(source, out)
    assert "6 of 6 photographs" in said and "ns-train nrfgs" in said and "Without a camera" not in said
    photo(out / "work" / "photos" / "pet.jpg")
    left, wide = Run(Prepare(source, out))._advice(19, 20, 0.5, 0.2)
    assert left == "Without a camera: pet.jpg. They are left out." and "0.20 of the longer side" in wide
    (out / "work" / "photos" / "pet.jpg").unlink()

    # Another option: all from the features on, whose function is gone; and back: what was overwritten is not finished.
    for options in ({"features": 100}, {}):
        with pytest.raises(TypeError):
            run_quietly(source, out, **options)
    shutil.rmtree(out)
    shutil.copytree(prepared, out)
    with pytest.raises(InputError, match=f"{out} has the scene of other photographs, {walls}. Name another"):
        run_quietly(three, out)
    run_quietly(source, out)  # the same ones elsewhere: from now on changes there count
    (source / "IMG 03.png").write_bytes((source / "IMG 02.png").read_bytes())
    with pytest.raises(TypeError):
        run_quietly(source, out)
    stored = [path.read_bytes() for path in sorted((out / "work" / "photos").iterdir())]
    assert stored[2] == stored[3], "the changed photograph was taken in"
    assert json.loads((out / "prepare.json").read_text())["features"]["done"] is False


def test_interrupted_features_are_taken_up(walls, tmp_path, monkeypatch):
    """Killed after the upright photograph and four others: COLMAP, asked for all, keeps these; one camera is shared."""
    dying = Mock(wraps=structure.colmap().extract_features, side_effect=[DEFAULT, DEFAULT, KeyboardInterrupt])
    monkeypatch.setattr(structure.os, "cpu_count", lambda: 4)
    mixed = shutil.copytree(walls, tmp_path / "photos")
    render_walls(walk(6)[0]).rotate(90, expand=True).save(mixed / "IMG 00.png")
    run = Run(Prepare(mixed, tmp_path / "scene"), Console(quiet=True))
    run.import_input()
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(structure.colmap(), "extract_features", dying)
        run.find_features()

    def with_features() -> list[bool]:
        with structure.colmap().Database.open(run.database) as database:
            assert database.num_cameras() == 2
            return [database.exists_keypoints(image.image_id) for image in database.read_all_images()]

    assert with_features() == [True] * 5
    run = Run(Prepare(mixed, tmp_path / "scene"), Console(quiet=True))
    run.import_input()
    run.find_features()
    assert with_features() == [True] * 6


# Advice where it fails.
def test_photographs_that_show_nothing_in_common_are_told(three, tmp_path):
    with pytest.raises(InputError, match="no two of the 3 photographs show the same"):
        run_quietly(three, tmp_path / "out")


def matches_in(database: Path) -> int:
    with structure.colmap().Database.open(database) as opened:
        return sum(opened.read_two_view_geometry_num_inliers()[1])


def with_turned(folder: Path, *names: str):
    """The model of a scene with cameras turned by six degrees, 30 pixels, which their matches contradict."""
    model = structure.colmap().Reconstruction(folder / "work" / "model")
    for image in map(model.find_image_with_name, names):
        turned = Rotation.from_rotvec([6, 0, 0], degrees=True).as_matrix() @ image.cam_from_world().matrix()
        image.frame.set_cam_from_world(image.camera_id, structure.colmap().Rigid3d(turned))
    return model


def test_global_mapping_helps_out_and_finds_the_same(prepared, walls, tmp_path, monkeypatch):
    """As where incremental mapping, with doubtful matches, too, finds no model, or one that is wrong in half."""
    out = shutil.copytree(prepared, tmp_path / "scene")
    tried = []

    def half_wrong(database, *_):
        tried.append(matches_in(database))
        return [with_turned(prepared, "IMG_01.png", "IMG_03.png", "IMG_05.png")]

    monkeypatch.setattr(structure, "_map_incrementally", half_wrong)
    shutil.rmtree(out / "work" / "model")
    assert "6 of 6 photographs" in run_quietly(walls, out)
    verdict, before = verdict_of(out), verdict_of(prepared)
    assert verdict["mapping"] == "global" and before["mapping"] == "incremental" and tried[1] > tried[0] > 0
    assert verdict["mean_reprojection_error_px"] < 1.2 * before["mean_reprojection_error_px"]
    check_walk(frames_of(out)[1])
    monkeypatch.setattr(structure, "_map_globally", lambda *_: [])
    shutil.rmtree(out / "work" / "model")
    with pytest.raises(InputError, match="too little to tell where"):
        run_quietly(walls, out)


def test_a_camera_that_its_matches_contradict_is_left_out(prepared, walls, tmp_path, monkeypatch):
    out = shutil.copytree(prepared, tmp_path / "scene")
    monkeypatch.setattr(structure, "_map_incrementally", lambda *_: [with_turned(prepared, "IMG_03.png")])
    shutil.rmtree(out / "work" / "model")
    assert "Without a camera: IMG_03.png. They are left out." in run_quietly(walls, out)
    assert verdict_of(out)["registered"] == 5 and len(frames_of(out)[1]) == 5


@pytest.mark.parametrize(("make", "said"), [
    (lambda d: None, "no such folder"),
    (lambda d: photo(d / "more" / "a.jpg"), "directly holds 0 photographs"),
    (lambda d: (d.mkdir(), (d / "a.mp4").touch()), "name that file itself"),
    (lambda d: [photo(d / "a.jpg"), (d / "b.HEIC").touch()], "b.HEIC is .*Run `pip install pillow-heif`"),
    (lambda d: (photo(d / "images" / "a.jpg"), (d / "transforms.json").touch()), "scene already.*ns-train nrfgs"),
    (lambda d: d.write_text("no video"), "neither a folder of photographs nor a video"),
])  # fmt: skip
def test_inputs_that_cannot_do_are_refused(make, said, tmp_path, no_heif):
    make(tmp_path / "in")
    with pytest.raises(InputError, match=said):
        photos.find_inputs(tmp_path / "in")


def test_photographs_of_an_iphone_are_stored_upright(three):
    pillow_heif = pytest.importorskip("pillow_heif", reason="needs pillow-heif")
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.ExposureTime] = IFDRational(1, 50)
    halves = Image.new("RGB", (40, 20), "red")
    halves.paste("blue", (0, 0, 20, 20))
    pillow_heif.from_pillow(halves).save(three / "IMG_0.HEIC", exif=exif.tobytes(), quality=100)
    inputs = photos.find_inputs(three)
    assert [path.name for path in inputs] == ["0.png", "1.png", "2.png", "IMG_0.HEIC"]
    photos.import_photos(inputs, three / "stored", lambda _: None)
    assert photos.read_exif(three / "stored" / "IMG_0.png") == {"exposure_time": pytest.approx(1 / 50)}
    with Image.open(three / "stored" / "IMG_0.png") as stored:
        assert stored.size == (20, 40) and stored.getexif().get(ExifTags.Base.Orientation, 1) == 1
        top, bottom = np.asarray(stored)[[2, -3], 10].astype(int)
        np.testing.assert_allclose([top, bottom], [(0, 0, 255), (255, 0, 0)], atol=4)


def test_what_is_refused_before_any_work(three, tmp_path, monkeypatch):
    photo(tmp_path / "mine" / "precious.txt", format="PNG")
    with pytest.raises(InputError, match="was not made by"):
        Run(Prepare(three, tmp_path / "mine"))
    with pytest.raises(InputError, match="--features is 1"):
        Run(Prepare(three, tmp_path / "out", features=1))
    with pytest.raises(InputError, match="precious.txt/out cannot be finished .*Not a directory"):
        Prepare(three, tmp_path / "mine" / "precious.txt" / "out").main()
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(InputError, match="pip install pycolmap"):
        Run(Prepare(three, tmp_path / "out"))


@pytest.mark.parametrize(("file", "content", "said"), [
    ("prepare.json", "[1, 2]", "prepare.json is damaged"),
    ("prepare.json", "{", "prepare.json is damaged"),
    ("work/features/database.db", "no database", "COLMAP stops with"),
])  # fmt: skip
def test_damaged_work_is_told_in_one_sentence(prepared, walls, tmp_path, file, content, said):
    out = shutil.copytree(prepared, tmp_path / "scene")
    shutil.rmtree(out / "work" / "model")
    (out / file).write_text(content)
    with pytest.raises(InputError, match=said):
        Prepare(walls, out).main()
    shutil.rmtree(out / "work" if file.startswith("work") else out)
    Run(Prepare(walls, out))  # as the message says


def test_an_undistorted_photograph_that_colmap_could_not_write_whole_is_not_built_on(prepared, tmp_path, monkeypatch):
    """As on a disk that is full, of which COLMAP says nothing."""
    work, undistort = prepared / "work", structure.colmap().undistort_images

    def cut_one(folder: Path, *args, **options) -> None:
        undistort(folder, *args, **options)
        path = folder / "images" / "IMG_00.png"
        path.write_bytes(path.read_bytes()[:20_000])

    monkeypatch.setattr(structure.colmap(), "undistort_images", cut_one)
    with pytest.raises(InputError, match=r"IMG_00.png cannot be decoded"):
        write_scene(work / "model", work / "photos", tmp_path / "undistorted", tmp_path, lambda steps: None)


# Collecting.
def test_photographs_are_kept_or_made_upright(tmp_path):
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation], exif[ExifTags.Base.Model] = 6, "Camera"
    plain, turned = photo(tmp_path / "a b.JPG"), photo(tmp_path / "c.jpg", (40, 30), exif=exif)
    Image.new("RGBA", (40, 30), (255, 0, 0, 0)).save(tmp_path / "d.png")
    renamed, done = photo(tmp_path / "f.jpg", format="WEBP"), []
    entries = struct.pack("<HHIIHHIII", 0x112, 3, 1, 6, 0x131, 5, 1, 38, 0)  # orientation, and software as a fraction
    odd = b"Exif\0\0II*\0" + struct.pack("<IH", 8, 2) + entries + struct.pack("<II", 1, 1)
    strange = photo(tmp_path / "g.jpg", (40, 30), exif=odd)
    paths = [plain, turned, tmp_path / "d.png", photo(tmp_path / "e.bmp"), renamed, strange]
    photos.import_photos(paths, tmp_path / "stored" / "photos", done.append)
    stored = {path.name: path for path in (tmp_path / "stored" / "photos").iterdir()}
    assert set(stored) == {"a_b.jpg", "c.jpg", "d.png", "e.png", "f.jpg", "g.jpg"} and len(done) == 6
    assert stored["a_b.jpg"].read_bytes() == plain.read_bytes(), "not encoded a second time"
    with Image.open(stored["c.jpg"]) as image:
        assert image.size == (30, 40) and image.getexif().get(ExifTags.Base.Orientation, 1) == 1
        assert image.getexif()[ExifTags.Base.Model] == "Camera", "the lens is a first guess of the focal length"
    assert Image.open(stored["f.jpg"]).format == "JPEG", "COLMAP reads by the suffix"
    with Image.open(stored["d.png"]) as image:
        assert image.mode == "RGB" and image.getpixel((0, 0)) == (255, 255, 255)


@pytest.mark.parametrize("make, width, tags, focal_length", [
    ("", 160, {"FocalPlaneXResolution": IFDRational(1000), "FocalPlaneResolutionUnit": 2}, 314.96),  # pixels an inch
    ("", 640, {"FocalPlaneXResolution": IFDRational(1000), "FocalPlaneResolutionUnit": 2}, 78.74),
    ("Canon", 640, {}, 222.22),  # whose sensor COLMAP knows, so that the width in EXIF does not matter
])  # fmt: skip
def test_focal_lengths_follow_photographs_that_were_made_smaller(tmp_path, make, width, tags, focal_length):
    exif = Image.Exif()
    exif[ExifTags.Base.Make], exif[ExifTags.Base.Model] = make, f"{make} EOS 5D Mark II"
    tags = {"FocalLength": IFDRational(8 if tags else 50), "ExifImageWidth": width} | tags
    tags["ExifImageHeight"] = width * 3 // 4
    exif.get_ifd(ExifTags.IFD.Exif).update({getattr(ExifTags.Base, name): value for name, value in tags.items()})
    photo(tmp_path / "a.jpg", (160, 120), exif=exif.tobytes())
    database = tmp_path / "database.db"
    structure.extract_features(database, tmp_path, [["a.jpg"]], lambda _: None, "SIMPLE_RADIAL", 100)
    with structure.colmap().Database.open(database) as opened:
        (camera,) = opened.read_all_cameras()
    assert camera.has_prior_focal_length and camera.mean_focal_length() == pytest.approx(focal_length, abs=0.01)


def test_a_photograph_that_colmap_leaves_out_is_named_and_so_is_a_full_disk(tmp_path, monkeypatch):
    photo(tmp_path / "a.jpg", (160, 120))
    photo(tmp_path / "b.jpg", (120, 160))  # not of the one camera
    both, database = [["a.jpg", "b.jpg"]], tmp_path / "database.db"
    full, left = "0.1 MB, and 0.1 MB are free. Make room", "b.jpg is left out by COLMAP"
    for free, said in (60_000, full), (10**9, left), (60_000, left):  # at last the room is taken by the same work
        monkeypatch.setattr(structure.shutil, "disk_usage", lambda _, free=free: Mock(free=free))
        with pytest.raises(InputError, match=said):
            structure.extract_features(database, tmp_path, both, lambda _: None, "SIMPLE_RADIAL", 100)


def test_names_stay_different_and_those_that_agree_share_a_camera_with_damaged_exif_as_none(tmp_path):
    given = ["00002_a_b.jpg", "a b.jpg", "a_b.jpg", "a_b.jpeg"]
    given += [f"{letters}.jpg" for letters in ("\udcff", "ä" * 100, "ö" * 100, "x" * 250)]
    names = photos.stored_names([Path(name) for name in given])
    assert len(set(names)) == len(given)
    assert all(name.isascii() and len(name) < 150 and "?" not in name for name in names)
    exif = b"Exif\0\0II*\0\x08\0\0\0\xff\xff" + bytes(range(200))
    paths = [photo(tmp_path / "in" / f"{i}.jpg", size, exif=exif) for i, size in enumerate([(40, 30)] * 2 + [(30, 40)])]
    photos.import_photos(paths, tmp_path / "stored", lambda _: None)
    assert photos.same_cameras(tmp_path / "stored", ["0.jpg", "2.jpg", "1.jpg"]) == [["0.jpg", "1.jpg"], ["2.jpg"]]


@pytest.mark.parametrize(("make", "said"), [
    (lambda p: p.write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 50 50\nshowpage\n"), "not a readable image"),
    (lambda path: Image.new("RGB", (1, 3000)).save(path), "1 x 3000 pixels"),
    (lambda path: Image.new("I;16", (40, 30)).save(path), "more than 8 bits"),
    (lambda path: path.write_bytes(path.read_bytes()[:-40]), "cannot be decoded"),
])  # fmt: skip
def test_what_is_no_photograph_is_named(three, tmp_path, make, said):
    make(three / "1.png")
    with pytest.raises(InputError, match=f"1.png.*{said}"):
        Run(Prepare(three, tmp_path / "out"), Console(quiet=True)).import_input()


def test_the_sharpest_frame_of_each_piece_of_a_video_is_taken(tmp_path):
    cv2 = pytest.importorskip("cv2")
    writer = cv2.VideoWriter(str(tmp_path / "v.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10, (64, 48))
    rng = np.random.default_rng(0)
    for index in range(12):  # in each piece of 3 the second frame is sharp, the others are grey
        grey = np.full((48, 64, 3), 40 + 10 * (index // 3), np.uint8)
        writer.write(rng.integers(0, 255, grey.shape, dtype=np.uint8) if index % 3 == 1 else grey)
    writer.release()
    photos.import_video(tmp_path / "v.avi", tmp_path / "frames", 4, (done := []).append)
    frames = sorted((tmp_path / "frames").iterdir())
    assert [path.name for path in frames] == [f"frame_{i:05d}.jpg" for i in range(4)] and len(done) == 4
    assert all(np.asarray(Image.open(path)).std() > 30 for path in frames)
    (tmp_path / "broken.mp4").write_bytes(b"no video")
    with pytest.raises(InputError, match=r"broken\.mp4: OpenCV decodes 0 frames"):
        photos.import_video(tmp_path / "broken.mp4", tmp_path / "none", 4, lambda _: None)


# The whole way, on real photographs.
@pytest.mark.slow
@pytest.mark.parametrize(("scene", "first", "step"), [("kitchen", 0, 2), ("castle", 1, 3)])
def test_few_photographs_are_all_placed(captures, tmp_path, scene, first, step):
    """Usual matches place fewer of `kitchen`, around a table, and one of `castle` beyond its path."""
    photographs = [shutil.copy(path, tmp_path) for path in sorted((captures / scene / "images").iterdir())[first::step]]
    Prepare(tmp_path, tmp_path / "scene").main()
    verdict = verdict_of(tmp_path / "scene")
    assert verdict["registered"] == len(photographs) and verdict["mapping"] == "doubtful matches"


@pytest.mark.slow
def test_a_real_capture_is_recovered(captures, tmp_path):
    """Every second photograph of `fox` at two thirds of its size, against the poses that the capture came with."""
    given, _ = frames_of(captures / "fox")
    frames = sorted(given["frames"], key=lambda frame: frame["file_path"])[::2]
    (tmp_path / "photos").mkdir()
    for frame in frames:
        with Image.open(captures / "fox" / frame["file_path"]) as image:
            small = image.resize((image.width * 2 // 3, image.height * 2 // 3), Image.Resampling.LANCZOS)
            small.save(tmp_path / "photos" / Path(frame["file_path"]).name, quality=95)
    Prepare(tmp_path / "photos", tmp_path / "scene").main()
    verdict, (meta, found) = verdict_of(tmp_path / "scene"), frames_of(tmp_path / "scene")
    assert verdict["registered"] == len(frames) and verdict["mean_reprojection_error_px"] < 1
    assert meta["fl_x"] / meta["w"] == pytest.approx(given["fl_x"] / given["w"], rel=0.02)
    truth = np.array([frame["transform_matrix"] for frame in frames])
    errors, angles = aligned(found, truth)
    # Each reconstruction is right to half a pixel, 0.15 degrees for one of hundreds of features. What remains: 2 % of
    # focal length trade against depth, half a degree against the principal point. Hence 1 % of the path, 1.5 degrees.
    assert errors.max() < 0.01 * np.ptp(truth[:, :3, 3], axis=0).max() and angles.max() < 1.5
    outputs = NrfgsDataParserConfig(data=tmp_path / "scene").setup().get_dataparser_outputs("train")
    assert len(outputs.image_filenames) == 22 and len(outputs.metadata["points3D_xyz"]) == verdict["points"]
