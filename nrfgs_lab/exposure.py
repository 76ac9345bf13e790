# SPDX-License-Identifier: Apache-2.0
"""What photographs as people take them cost, and what learning each one's exposure, or the robust loss, is worth.

    python -m nrfgs_lab.exposure SCENES/bonsai OUT --cases as-is-off varied-off varied-on

trains on a capture as it is, or on one whose training photographs were changed, and evaluates on the same test
photographs, which stay as they are:

    varied      random exposures and white balances (in light: decoded by sRGB's curve, multiplied, clipped, encoded,
                rounded to 8 bits), of mean zero, so that the mean look stays that of the test photographs
    told        the same, and EXIF tells the exposures
    occluded    in a quarter of the photographs, people-like shapes with what another photograph shows upside down
    unmasked    masks, where the capture has them, are left out of the training, and count in the test

`on`, `off` and `auto` are values of --pipeline.model.photographs. Each case leaves OUT/CASE-SEED.json; where exposures
were learnt, it says how far they are from those that were put on.

Several commands at once may share an OUT, each with cases of its own.
"""

import json
import math
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
import tyro
from PIL import Image

from nrfgs_lab.bench.spec import QUIET
from nrfgs_lab.lock import only_one
from nrfgs_ns.errors import InputError
from nrfgs_ns.files import write_whole

Case = Literal[
    "as-is-off", "as-is-on", "as-is-auto", "varied-off", "varied-on", "varied-auto", "told-on", "told-auto",
    "occluded-off", "unmasked-off",
]  # fmt: skip
TEST_EVERY = 8
OCCLUDED = 0.25
"""Share of the training photographs that something walks through."""
MOST_OCCLUDERS = 3
"""In such a photograph."""
HEIGHTS, WIDTHS = (0.3, 0.6), (0.3, 0.45)
"""Of an occluder, in heights of the photograph, and in heights of itself."""


@dataclass(frozen=True)
class Occluder:
    """A head and a body in front of a photograph."""

    texture: str
    """stem of the photograph whose colours it has"""
    center: tuple[float, float]
    """x and y, in widths and heights of the photograph"""
    height: float
    """in heights of the photograph"""
    width: float
    """in heights of the photograph"""

    def inside(self, height: int, width: int) -> np.ndarray:
        """Which pixels it covers, bool [H, W]."""
        y, x = np.mgrid[:height, :width].astype(np.float64)
        up = ((y + 0.5) / height - self.center[1]) / self.height  # -0.5 to 0.5
        across = ((x + 0.5) - self.center[0] * width) / height / self.width
        head = ((up + 0.38) / 0.12) ** 2 + (across / 0.3) ** 2 <= 1.0
        body = ((up - 0.12) / 0.38) ** 4 + (across / 0.5) ** 4 <= 1.0
        return head | body


@dataclass
class Study:
    """Train some cases on one scene."""

    scene: tyro.conf.Positional[Path]
    """folder with a transforms.json"""
    out: tyro.conf.Positional[Path]
    """folder for data sets, trainings and records"""
    cases: tuple[Case, ...] = ("as-is-off", "varied-off", "varied-on")
    """what to train"""
    stops: float = 1.0
    """exposures are drawn evenly from -stops to +stops"""
    white_balance: float = 0.2
    """standard deviation of red's and blue's stops against green's"""
    draw: int = 0
    """seed of the exposures, or of what walks through"""
    downscale: int = 1
    """photographs are averaged down by this factor"""
    method: str = "nrfgs-fast"
    """of ns-train"""
    steps: int = 10_000
    """of each training"""
    seed: int = 42
    """of each training"""
    options: str = ""
    """more options of ns-train, separated by blanks"""

    def main(self) -> None:
        self.out.mkdir(parents=True, exist_ok=True)
        for case in self.cases:
            record = self.out / f"{case}-{self.seed}.json"
            if not record.exists():
                write_whole(record, json.dumps(self.run(case), indent=1) + "\n")
            print(summary(case, json.loads(record.read_text(encoding="utf-8"))), flush=True)

    def run(self, case: Case) -> dict[str, Any]:
        from nrfgs_lab.bench.measure import measure
        from nrfgs_ns.training.run import machine, train

        varied, choice = case.rsplit("-", 1)
        data = self.out / f"data-{varied}"
        with only_one(self.out / f"{data.name}.lock", f"Another process makes {data}; waiting for it."):
            if not (data / "transforms.json").exists():
                exposures = self.exposures() if varied in ("varied", "told") else None
                occluders = self.occluders() if varied == "occluded" else {}
                make_data(
                    self.scene, data, self.downscale, exposures, varied == "told", occluders, varied != "unmasked"
                )
        work = self.out / "work" / f"{case}-{self.seed}"
        shutil.rmtree(work, ignore_errors=True)
        args = [self.method, "--output-dir", str(work), "--experiment-name", "x", *QUIET, *self.options.split()]
        args += ["--max-num-iterations", str(self.steps), "--steps-per-save", str(self.steps)]
        args += ["--machine.seed", str(self.seed), "--pipeline.model.photographs", choice]
        trained = train([*args, "nrfgs-data", "--data", str(data)])
        checkpoint = max(Path(trained.config_path).parent.glob("nerfstudio_models/*.ckpt"))
        content = {
            "case": case,
            "study": {**asdict(self), "scene": self.scene.name, "out": "", "cases": []},
            "machine": machine(),
            "train": {"seconds": trained.seconds, "steps": trained.steps, "splats": trained.splats[-1][1]},
            "measured": measure(Path(trained.config_path), 16),
            "photographs": recovered(checkpoint, data / "truth.json"),
        }
        shutil.rmtree(work)
        return content

    def exposures(self) -> dict[str, list[float]]:
        """Stops of red, green and blue for each training photograph, with mean zero: the capture keeps its look."""
        random = np.random.default_rng(self.draw)
        names = [Path(frame["file_path"]).stem for frame in split(read(self.scene))[0]]
        stops = random.uniform(-self.stops, self.stops, (len(names), 1)).repeat(3, axis=1)
        stops[:, [0, 2]] += self.white_balance * random.standard_normal((len(names), 2))
        stops -= stops.mean(axis=0)
        return dict(zip(names, stops.tolist(), strict=True))

    def occluders(self) -> dict[str, list[Occluder]]:
        """What walks through some of the training photographs."""
        random = np.random.default_rng(self.draw)
        names = [Path(frame["file_path"]).stem for frame in split(read(self.scene))[0]]
        chosen = random.choice(len(names), max(round(OCCLUDED * len(names)), 1), replace=False)
        found = {}
        for index in sorted(chosen.tolist()):
            others = [name for name in names if name != names[index]]
            found[names[index]] = [
                Occluder(
                    others[random.integers(len(others))],
                    tuple(random.uniform(0.1, 0.9, 2).tolist()),
                    height := float(random.uniform(*HEIGHTS)),
                    height * float(random.uniform(*WIDTHS)),
                )
                for _ in range(random.integers(1, MOST_OCCLUDERS + 1))
            ]
        return found


def read(scene: Path) -> dict[str, Any]:
    file = scene / "transforms.json"
    if not file.is_file():
        raise InputError(f"{file} is missing. Name a folder in nerfstudio's layout.")
    return json.loads(file.read_text(encoding="utf-8"))


def split(meta: dict[str, Any]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Training and test frames by name: the data set's own, or every 8th for test."""
    frames = sorted(meta["frames"], key=lambda frame: frame["file_path"])
    names = [frame["file_path"] for frame in frames]
    test = set(meta.get("test_filenames", names[::TEST_EVERY]))
    train = set(meta.get("train_filenames", set(names) - test))
    return [one for one in frames if one["file_path"] in train], [one for one in frames if one["file_path"] in test]


def make_data(
    scene: Path,
    out: Path,
    downscale: int,
    exposures: dict[str, list[float]] | None = None,
    told: bool = False,
    occluders: Mapping[str, Sequence[Occluder]] = MappingProxyType({}),
    masked: bool = True,
) -> None:
    """Copy a data set with smaller photographs, those for training changed.

    Args:
        scene: with a transforms.json, of which the first split is kept.
        out: the copy.
        downscale: an integer factor.
        exposures: stops [3] by photograph's stem; None: as they are.
        told: EXIF tells the exposures.
        occluders: by photograph's stem.
        masked: whether masks hold for the training.
    """
    meta = read(scene)
    train, test = split(meta)
    aside = out.with_name(out.name + ".writing")
    shutil.rmtree(aside, ignore_errors=True)
    (aside / "images").mkdir(parents=True)
    files = {Path(frame["file_path"]).stem: scene / frame["file_path"] for frame in (*train, *test)}

    def pixels_of(stem: str) -> np.ndarray:
        with Image.open(files[stem]) as image:
            return np.asarray(image.convert("RGB").reduce(downscale))

    training = {Path(frame["file_path"]).stem for frame in train}
    for frame in (*train, *test):
        stem = Path(frame["file_path"]).stem
        pixels = pixels_of(stem)
        for occluder in occluders.get(stem, ()):
            texture = Image.fromarray(pixels_of(occluder.texture)[::-1]).resize(pixels.shape[1::-1])
            pixels = np.where(occluder.inside(*pixels.shape[:2])[..., None], np.asarray(texture), pixels)
        if exposures is not None and stem in exposures:
            pixels = exposed(pixels, exposures[stem])
        Image.fromarray(pixels).save(aside / "images" / f"{stem}.png", compress_level=1)
        frame["file_path"] = f"images/{stem}.png"
        if exposures is not None:
            frame.pop("exif", None)  # it tells of another photograph
            if told and stem in exposures:
                frame["exif"] = {"exposure_time": 0.01 * 2.0 ** float(np.mean(exposures[stem])), "iso": 100}
        if "mask_path" in frame:
            with Image.open(scene / frame["mask_path"]) as mask:
                size = (-(-mask.width // downscale), -(-mask.height // downscale))
                (aside / "masks").mkdir(exist_ok=True)
                smaller = mask.resize(size, Image.Resampling.NEAREST)
                if not masked and stem in training:
                    smaller = smaller.point(lambda value: 255)
                smaller.save(aside / "masks" / f"{stem}.png")
            frame["mask_path"] = f"masks/{stem}.png"
    for place in (meta, *meta["frames"]):
        for key in ("fl_x", "fl_y", "cx", "cy"):
            if key in place:
                place[key] /= downscale
        for key in ("w", "h"):
            if key in place:
                place[key] = -(-place[key] // downscale)
    meta["frames"] = [*train, *test]
    meta["train_filenames"] = [frame["file_path"] for frame in train]
    meta["val_filenames"] = meta["test_filenames"] = [frame["file_path"] for frame in test]
    if "ply_file_path" in meta:
        shutil.copyfile(scene / meta["ply_file_path"], aside / "points.ply")
        meta["ply_file_path"] = "points.ply"
    (aside / "transforms.json").write_text(json.dumps(meta), encoding="utf-8")
    if exposures is not None:
        (aside / "truth.json").write_text(json.dumps(exposures), encoding="utf-8")
    os.replace(aside, out)


def exposed(pixels: np.ndarray, stops: list[float]) -> np.ndarray:
    """A photograph, uint8 [H, W, 3], as it would have been with so many stops more in each channel."""
    values = pixels / 255.0
    light = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    light = np.clip(light * 2.0 ** np.asarray(stops), 0.0, 1.0)
    values = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.rint(255.0 * values).astype(np.uint8)


def recovered(checkpoint: Path, truth: Path) -> dict[str, Any] | None:
    """What a training has learnt of its photographs; None if it has not.

    Returns:
        "rms_stops": of the exposures learnt, and if the truth is known "correlation" of exposures, "rms_error_stops",
        the same of white balance (log2 of red and blue over green), and "stops" by name.
    """
    from nrfgs_ns.image.photograph import PhotographModel
    from nrfgs_ns.training.checkpoint_files import read as read_checkpoint

    prefix = "_model.photograph."
    pipeline = read_checkpoint(checkpoint)["pipeline"]
    state = {name.removeprefix(prefix): value for name, value in pipeline.items() if name.startswith(prefix)}
    if not state:
        return None
    model = PhotographModel.from_state(state)
    stops = model.stops().numpy()
    result: dict[str, Any] = {"rms_stops": _rms(stops.mean(axis=1))}
    if truth.exists():
        known = json.loads(truth.read_text(encoding="utf-8"))
        wanted = np.array([known[Path(name).stem] for name in model.names])
        result |= {
            "rms_truth_stops": _rms(wanted.mean(axis=1)),
            "correlation": _correlation(stops.mean(axis=1), wanted.mean(axis=1)),
            "rms_error_stops": _rms(stops.mean(axis=1) - wanted.mean(axis=1)),
            "white_balance_correlation": _correlation(_ratios(stops), _ratios(wanted)),
            "white_balance_rms_error_stops": _rms(_ratios(stops) - _ratios(wanted)),
        }
    names = [Path(name).stem for name in model.names]
    rows = zip(names, stops.round(4).tolist(), strict=True)
    return {**result, "stops": dict(rows)}


def _ratios(stops: np.ndarray) -> np.ndarray:
    return (stops[:, [0, 2]] - stops[:, [1]]).flatten()


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _correlation(one: np.ndarray, other: np.ndarray) -> float | None:
    value = float(np.corrcoef(one, other)[0, 1]) if one.std() > 0 and other.std() > 0 else math.nan
    return value if math.isfinite(value) else None


def summary(case: str, record: dict[str, Any]) -> str:
    """One line."""
    test, learnt, train = record["measured"]["test"], record["photographs"], record["train"]
    text = f"{record['study']['scene']:10} {case:11} PSNR {test['psnr']:.2f} cc {test['cc_psnr']:.2f} "
    text += f"SSIM {test['ssim']:.4f} cc {test['cc_ssim']:.4f} {1e3 * train['seconds'] / train['steps']:.2f} ms/step"
    if learnt:
        text += f" | rms {learnt['rms_stops']:.3f} stops"
        if "correlation" in learnt:
            text += f", error {learnt['rms_error_stops']:.3f}, correlation {learnt['correlation']:.4f}"
            text += f", white balance error {learnt['white_balance_rms_error_stops']:.3f}"
    return text


if __name__ == "__main__":
    tyro.cli(Study).main()
