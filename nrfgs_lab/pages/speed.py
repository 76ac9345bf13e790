# SPDX-License-Identifier: Apache-2.0
"""Blocks of docs/speed.md and README.md: what trainings, steps and frames cost (`timing/scale.py`)."""

from collections import defaultdict
from statistics import median

import numpy as np

from nrfgs_lab.pages.runs import records, span

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
    """Least and most that a step of `nrfgs` has of another renderer's time."""
    cells, parts = scale_cells("step_ms").values(), []
    words = {"splatfacto": "splatfacto's time,", "nrfgs-sh": "`nrfgs-sh`'s and", "faster-gs": "Faster-GS's"}
    for other, named in words.items():
        ratios = [median(one["nrfgs"]) / median(one[other]) for one in cells]
        parts.append(f"{span(ratios, '{:.2f}'.format)} of {named}")
    return " ".join(parts)


def scale_fit(column: str, factor: str, unit: str, renderer: str) -> str:
    """Least squares of a quantity by splats and pixels."""
    cells = {place: float(factor) * median(cell[renderer]) for place, cell in scale_cells(column).items()}
    parts = np.linalg.lstsq([[1, count / 1e6, pixels] for count, pixels in cells], [*cells.values()], rcond=None)[0]
    return f"{parts[0]:.1f} {unit}, {parts[1]:.1f} for each million splats and {parts[2]:.2f} for each megapixel"


BLOCKS = {"speed.scale_fit": scale_fit, "speed.scale_ratios": scale_ratios}
