# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/trade-off.md."""

from statistics import median

from nrfgs_lab.bench.table import Row
from nrfgs_lab.pages.tables import bench_rows, grid, mean_of, records, signed
from nrfgs_lab.pages.tables.readme import TRAINING_VIEWS

SCENES = "bonsai", "fox"
"""Captures of docs/bench/speed.yaml."""
PRESETS = {
    "splatfacto": "splatfacto",
    "splatfacto-10k": "the same, 10,000 steps",
    "splatfacto-big": "splatfacto-big",
    "splatfacto-big-10k": "the same, 10,000 steps",
    "nrfgs-sh": "`nrfgs-sh`",
    "nrfgs-fast": "`nrfgs-fast`",
    "nrfgs": "`nrfgs`",
    "nrfgs-best": "`nrfgs-best`",
}
ANOTHER_DAY = "*"


def _row(scene: str, run: str) -> tuple[Row | None, str]:
    """A run, and a mark if it was made on another day than most."""
    row = bench_rows("speed").get((scene, "own", run))
    if row is None and run.startswith("splatfacto"):
        return bench_rows("presets").get((scene, "own", f"nerfstudio_{run}")), ANOTHER_DAY
    if row is None and run == "nrfgs":  # it chooses 10,000 steps, and is the preset
        return bench_rows("speed").get((scene, "own", "nrfgs-fast")), ""
    return row, ""


def _seconds(row: Row) -> list[float]:
    """Of those trainings that had a GPU to themselves."""
    return list(row.values["time s"].values())


def presets() -> str:
    """PSNR, SSIM, splats and seconds of what a user would choose from."""
    body = []
    for run, label in PRESETS.items():
        cells = []
        for scene in SCENES:
            row, mark = _row(scene, run)
            if row is None:
                cells.append("-")
                continue
            seconds = _seconds(row)
            time = f", {_span(seconds, lambda one, _: f'{one:.0f}')} s" if seconds else ""
            splats = f"{mean_of(row, 'splats') / 1000:.0f}k"
            cells.append(f"{mean_of(row, 'PSNR'):.2f}/{mean_of(row, 'SSIM'):.3f}, {splats}{time}{mark}")
        if set(cells) != {"-"}:
            body.append([label, *cells])
    return grid(["PSNR/SSIM, splats, time", *(f"{scene}, {TRAINING_VIEWS[scene]} views" for scene in SCENES)], body)


def _pairs(run: str, base: str) -> list[tuple[Row, Row]]:
    """Both on each capture that has both."""
    pairs = [(_row(scene, run)[0], _row(scene, base)[0]) for scene in SCENES]
    return [(one, other) for one, other in pairs if one is not None and other is not None]


def gain(run: str, base: str) -> str:
    """The least and the largest difference in dB over captures."""
    return _span([mean_of(one, "PSNR") - mean_of(other, "PSNR") for one, other in _pairs(run, base)], signed)


def time(scene: str, run: str, base: str) -> str:
    """A run's share of another's time on a capture."""
    one, other = (_seconds(_row(scene, name)[0]) for name in (run, base))
    return f"{median(one) / median(other):.2f}"


def _span(numbers: list[float], text) -> str:
    least, most = text(min(numbers), 1), text(max(numbers), 1)
    return least if least == most else f"{least} to {most}"


def averaging() -> str:
    """PSNR of the mean over the last steps, by their number."""
    study = records("averaging")
    runs = {
        "bonsai": "bonsai, `nrfgs`",
        "bonsai-sh": "bonsai, `nrfgs-sh`",
        "bonsai-fast": "bonsai, 10,000 steps",
        "goldcape": "goldcape, `nrfgs`",
    }
    found = {run: {one["window"]: one["psnr"] for one in study[run]["windows"]} for run in runs}
    windows = [0, 50, 200, 800]
    body = [
        ["one" if window == 0 else f"{window:,}", *(f"{found[run][window]:.2f}" for run in runs)] for window in windows
    ]
    return grid(["last steps", *runs.values()], body)


def averaged(run: str) -> str:
    """What the mean over the last 200 steps gains."""
    found = {one["window"]: one["psnr"] for one in records("averaging")[run]["windows"]}
    return f"{found[200] - found[0]:.2f}"
