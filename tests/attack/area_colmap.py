# SPDX-License-Identifier: Apache-2.0
"""COLMAP models, binary and text, as `ns-train nrfgs --data ... colmap` reads them."""

from functools import partial
from pathlib import Path

from area_transforms import load
from attempt import DAMAGES, Case, damage
from hypothesis import strategies as st
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from PIL import Image
from small_colmap import FILES, MODEL, Model

AREA = "COLMAP model"
load = partial(load, parser=ColmapDataParserConfig)


def model(name: str, change, text: bool = False, **options) -> Case:
    def build(folder: Path):
        one = Model()
        change(one)
        return partial(load, one.write(folder / "scene", text), **options)

    return Case(f"{'text: ' if text else ''}{name}", build)


def entry(kind: str, row: int, keys: str, title: str, text: bool = False, **fields) -> Case:
    """Other values of one camera or image."""

    def change(one: Model) -> None:
        entries = getattr(one, kind)
        entries[row] = tuple((dict(zip(keys.split(), entries[row], strict=True)) | fields).values())

    return model(f"{kind}: {title}", change, text)


camera = partial(entry, "cameras", 0, "id model w h p")
image = partial(entry, "images", 3, "id q t camera name")


def file(name: str, which: str | Path, change, text: bool = False, **options) -> Case:
    def build(folder: Path):
        scene = Model().write(folder / "scene", text)
        change(scene / which)
        return partial(load, scene, **options)

    return Case(name, build)


def cut(share: float):
    return lambda path: path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])


NAN, INF = float("nan"), float("inf")
LENSES = [(0.0, 11.0, 6.0, 4.5), (NAN, 11.0, 6.0, 4.5), (10.0, -1.0, 6.0, 4.5), (INF, 11.0, 6.0, 4.5)]
LENSES += [(1e38, 1e38, 6.0, 4.5), (10.0, 11.0, 1e30, 4.5)]
OPTIONS = [("colmap_path", Path("nowhere")), ("masks_path", Path("masks")), ("images_path", Path("nowhere"))]
CASES = [
    *(camera(f"parameters {p}", index % 2 == 0, p=p) for index, p in enumerate(LENSES)),
    *(camera(f"{w} x {h} pixels", w=w, h=h) for w, h in ((0, 9), (2**60, 9), (24, 18), (1, 1))),
    camera("three parameters", True, p=(10.0, 6.0, 4.5)),
    camera("words", True, p=("a", "b", "c", "d")),
    camera("of an unknown model", model=77),
    camera("of an unknown model", True, model="PINE"),
    camera("FULL_OPENCV", model=6, p=(10.0, 11.0, 6.0, 4.5) + (0.1,) * 8),
    camera("of number 2", id=2),
    camera("strong distortion", model=4, p=(10.0, 11.0, 6.0, 4.5, 1e10, 0.0, 0.0, 0.0)),
    *(image(f"rotation {q}", q=q) for q in ((0.0,) * 4, (NAN, 0, 0, 0), (9.0, 0, 0, 0))),
    image("rotation 0", True, q=(0.0,) * 4),
    *(image(f"position {x}", t=(x, 0.0, 0.0)) for x in (NAN, INF)),
    image("without a name", name=""),
    image("of a name that is twice", name="000.png"),
    image("of a file that is not there", name="no.png"),
    *(image(f"named {name[:20]!r}", name=name) for name in ("x" * 300, "/dev/zero", "..", "a\nb")),
    image("with words", True, t=("a", "b", "c")),
    image("with too little", True, t=()),
    *(
        model(f"{count} {which} announced", lambda one, w=which, c=count: one.counts.update({w: c}))
        for which in FILES
        for count in (11, 2**40, 2**63)
    ),
    *(model(f"tracks of {count}", lambda one, c=count: setattr(one, "tracks", c)) for count in (7, 2**40, 2**63)),
    model("no images", lambda one: one.images.clear()),
    model("no cameras", lambda one: one.cameras.clear()),
    model("points NaN", lambda one: setattr(one, "points", [(i, (NAN,) * 3, color) for i, _, color in one.points])),
    *(file(f"{which} missing", MODEL / f"{which}.bin", Path.unlink) for which in FILES),
    *(file(f"{which} cut at {x}", MODEL / f"{which}.bin", cut(x)) for which in FILES for x in (0, 0.2, 0.98)),
    file("image missing", "images/003.png", Path.unlink),
    file("image unreadable", "images/003.png", cut(0.1)),
    file("image of another size", "images/003.png", lambda path: Image.new("RGB", (9, 9)).save(path)),
    *(model(f"{name} {value}", lambda _: None, **{name: value}) for name, value in OPTIONS),
    file("a list of strangers", "train_list.txt", lambda path: path.write_text("nobody.png\n")),
    file("a list that is no text", "train_list.txt", lambda path: path.write_bytes(b"\xff\xfe\x00")),
    Case("--data not there", lambda folder: partial(load, folder / "nowhere")),
    Case("--data empty", lambda folder: partial(load, folder)),
]


def inputs() -> st.SearchStrategy[Case]:
    """One file of a model, damaged."""

    def case(which: str, text: bool, chosen) -> Case:
        path = MODEL / f"{which}.{'txt' if text else 'bin'}"
        name = f"{which} {'text' if text else 'binary'} {chosen}"
        damaged = file(name[:200], path, lambda path: path.write_bytes(damage(path.read_bytes(), chosen)), text)
        return damaged._replace(hostile=False)

    return st.builds(case, st.sampled_from(FILES), st.booleans(), DAMAGES)
