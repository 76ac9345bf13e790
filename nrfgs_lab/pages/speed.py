# SPDX-License-Identifier: Apache-2.0
"""Blocks of docs/speed.md and README.md: what trainings cost."""

from collections import defaultdict
from statistics import median

import numpy as np

from nrfgs_lab.pages.runs import VIEWS, bench_rows, grid, mean_of, records, span

# The choice between methods and presets.

CAPTURES = "bonsai", "fox"
PRESETS = {
    "splatfacto": "splatfacto",
    "splatfacto-big": "splatfacto-big",
    **{run: f"`{run}`" for run in ("nrfgs-sh", "nrfgs-fast", "nrfgs", "nrfgs-best")},
}


def _preset(scene: str, run: str) -> str:
    """A run's cell, with a mark if it was made on another day than most."""
    row, mark = bench_rows("speed").get((scene, "own", run)), ""
    if row is None and run.startswith("splatfacto"):
        row, mark = bench_rows("presets").get((scene, "own", f"nerfstudio_{run}")), "*"
    if row is None and run == "nrfgs":  # it chooses 10,000 steps, and is the preset
        row = bench_rows("speed").get((scene, "own", "nrfgs-fast"))
    if row is None:
        return "-"
    seconds = list(row.values["time s"].values())
    time = f", {span(seconds, '{:.0f}'.format)} s" if seconds else ""
    splats = f"{mean_of(row, 'splats') / 1000:.0f}k"
    return f"{mean_of(row, 'PSNR'):.2f}/{mean_of(row, 'SSIM'):.3f}, {splats}{time}{mark}"


def presets() -> str:
    """PSNR, SSIM, splats and seconds of a user's choices."""
    body = [[label, *(_preset(scene, run) for scene in CAPTURES)] for run, label in PRESETS.items()]
    return grid(["PSNR/SSIM, splats, time", *(f"{scene}, {VIEWS[scene]} views" for scene in CAPTURES)], body)


# Steps and frames against splats and pixels (`timing/scale.py`).

RENDERERS = {"nrfgs": "`nrfgs`", "nrfgs-sh": "`nrfgs-sh`", "splatfacto": "splatfacto"}
RENDERERS |= {"gsplat": "gsplat, bare", "faster-gs": "Faster-GS, bare"}


def scale_cells(column: str) -> dict[tuple[int, float], dict[str, list[float]]]:
    """(splats, megapixels) -> renderer -> a quantity in each repeat."""
    places: dict[tuple[int, float], dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for one in records("scale").values():
        if column in one:
            places[one["splats"], one["megapixels"]][one["method"]].append(one[column])
    return dict(sorted(places.items()))


def scale_ratios() -> str:
    """Least and most that a step of `nrfgs` has of another renderer's time over the table's cells."""
    cells, parts = scale_cells("step_ms").values(), []
    words = {"splatfacto": "splatfacto's time,", "nrfgs-sh": "`nrfgs-sh`'s and", "faster-gs": "Faster-GS's"}
    for other, named in words.items():
        ratios = [median(one["nrfgs"]) / median(one[other]) for one in cells]
        parts.append(f"{span(ratios, '{:.2f}'.format)} of {named}")
    return " ".join(parts)


def scale_fit(column: str, factor: str, unit: str, renderer: str, most: str = "inf") -> str:
    """Least squares of a quantity by splats and pixels, with at most as many millions of splats."""
    places = {place: cells[renderer] for place, cells in scale_cells(column).items() if place[0] <= 1e6 * float(most)}
    cells = {place: float(factor) * median(values) for place, values in places.items()}
    parts = np.linalg.lstsq([[1, count / 1e6, pixels] for count, pixels in cells], [*cells.values()], rcond=None)[0]
    return f"{parts[0]:.1f} {unit}, {parts[1]:.1f} for each million splats and {parts[2]:.2f} for each megapixel"


BLOCKS = {
    **{f"speed.{block.__name__}": block for block in (scale_fit, scale_ratios)},
    "trade_off.presets": presets,
}
