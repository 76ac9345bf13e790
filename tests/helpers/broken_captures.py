# SPDX-License-Identifier: Apache-2.0
"""What can be wrong with a capture of `small_capture`: what is done to it -> words of the message about it."""

from PIL import Image

LAST = "images/000.png"  # the frames are listed backwards


def pose(capture, row, column, value):
    capture.meta["frames"][2]["transform_matrix"][row][column] = value


def everywhere(value):
    def change(capture):
        for frame in capture.meta["frames"]:
            for row in range(3):
                frame["transform_matrix"][row][3] = value

    return change


def with_masks(change):
    def both(capture):
        capture.add_masks()
        change(capture)

    return both


def repaint(path, size, mode):
    def change(capture):
        Image.new(mode, size).save(capture.folder / path)

    return change


def spoil(path, content=b"nothing that can be decoded"):
    return lambda capture: (capture.folder / path).write_bytes(content)


META = {  # what is done to the data set -> what the message must say
    "empty frames": (lambda c: c.meta.update(frames=[]), "transforms.json `frames` Make"),
    "no file_path": (lambda c: c.meta["frames"][3].pop("file_path"), "transforms.json frames[3] file_path remove"),
    "no pose": (lambda c: c.meta["frames"][3].pop("transform_matrix"), "transform_matrix 006.png remove"),
    "3 x 4 pose": (lambda c: c.meta["frames"][2]["transform_matrix"].pop(), "transform_matrix 007.png 4 x 4 last row"),
    "NaN in pose": (lambda c: pose(c, 0, 3, float("nan")), "transform_matrix 007.png finite Give"),
    "last row": (lambda c: pose(c, 3, 0, 0.1), "transform_matrix 007.png last row"),
    "sheared pose": (lambda c: pose(c, 0, 0, 2.0), "transform_matrix 007.png rigid shear"),
    "one place": (everywhere(2.5), "all 10 cameras same place --auto-scale-poses"),
    "no focal length": (lambda c: c.meta.pop("fl_x"), "fl_x missing 000.png camera_angle_x"),
    "zero focal length": (lambda c: c.meta.update(fl_x=0.0), "000.png fl_x 0.0, pixels"),
    "focal length in words": (lambda c: c.meta.update(fl_x="long"), "fl_x 'long' pixels"),
    "distortion": (lambda c: c.meta.update(k1=float("inf")), "k1 inf 0 for none"),
    "camera model": (lambda c: c.meta.update(camera_model="PINE"), "camera_model 'PINE' OPENCV"),
    "fisheye of instant-ngp": (lambda c: c.meta.update(is_fisheye=True), "is_fisheye top level OPENCV_FISHEYE"),
    "sixth distortion of a frame": (lambda c: c.meta["frames"][3].update(k5=0.1), "k5 006.png 0.1 undistort"),
    "focal length twice": (lambda c: c.meta["frames"][3].update(fl_x=20.0), "fl_x 006.png top level Remove"),
    "camera model twice": (
        lambda c: (c.meta.update(camera_model="OPENCV"), c.meta["frames"][3].update(camera_model="OPENCV_FISHEYE")),
        "camera_model 006.png OPENCV_FISHEYE top level undistort",
    ),
    "applied_transform": (lambda c: c.meta.update(applied_transform=[[1, 0], [0]]), "applied_transform 3 x 4 remove"),
    "applied_scale": (lambda c: c.meta.update(applied_scale=0), "applied_scale positive"),
    "twice in disguise": (
        lambda c: c.meta["frames"].append({**c.meta["frames"][0], "file_path": "./images/009.png"}),
        "009.png more than once Keep one",
    ),
    "no train images": (lambda c: c.meta.update(train_filenames=[], test_filenames=[LAST]), "train_filenames"),
    "no train list": (lambda c: c.meta.update(test_filenames=[LAST]), "test_filenames but no train_filenames Name"),
    "split of strangers": (
        lambda c: c.meta.update(train_filenames=[LAST], test_filenames=["images/x.png"]),
        "test_filenames x.png no frame",
    ),
    "split not a list": (lambda c: c.meta.update(train_filenames=LAST), "train_filenames list"),
    "split names twice": (
        lambda c: c.meta.update(train_filenames=[LAST, LAST]),
        "train_filenames 000.png more than once",
    ),
    "exif without sense": (
        lambda c: c.meta["frames"][3].update(exif={"iso": float("inf")}),
        "transforms.json exif 006.png numbers above 0 remove",
    ),
    "exif of another kind": (lambda c: c.meta["frames"][3].update(exif={"model": ["a"]}), "exif 006.png model remove"),
    "one mask lacking": (
        with_masks(lambda c: c.meta["frames"][4].pop("mask_path")),
        "mask_path images/005.png all-white for none",
    ),
}

FILES = {
    "image missing": (lambda c: (c.folder / LAST).unlink(), "1 of 10 images missing 000.png Restore"),
    "first image unreadable": (spoil("images/009.png"), "009.png not a readable image Restore"),
    "image unreadable": (spoil("images/001.png"), "001.png not a readable image Restore"),
    "image of another size": (repaint("images/001.png", (9, 12), "RGB"), "001.png 9 x 12 12 x 9 Use the images"),
    "intrinsics of another size": (lambda c: c.meta.update(w=24, h=18), "8 images 12 x 9 24 x 18 scale w"),
    "mask missing": (with_masks(lambda c: (c.folder / "masks/001.png").unlink()), "mask_path missing masks/001.png"),
    "mask unreadable": (with_masks(spoil("masks/001.png")), "masks/001.png not a readable"),
    "mask of another size": (with_masks(repaint("masks/001.png", (6, 5), "L")), "masks masks/001.png 6 x 5 12 x 9"),
}
