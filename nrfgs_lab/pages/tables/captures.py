# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/captures.md."""

from collections import defaultdict
from collections.abc import Iterable
from statistics import fmean, median
from typing import Any

from nrfgs_lab.pages.tables import grid, records
from nrfgs_lab.pages.tables.readme import FIELD, HOST, LONG, SHRUNK, TRAINING_VIEWS, runs_of, view_gains

BASE = "harmonics: shrinkage"
STORED = ", shrinkage of what is stored"
TRIED = {
    "field: trust": "**`nrfgs`**",
    "field: trust, one band": "one band",
    "field: whole": "u = 1",
    f"field: trust{STORED}": "shrinkage of stored opacity",
    f"field: whole{STORED}": "u = 1, shrinkage of stored opacity",
}
"""Rows of the table of held-out views, by the names of their trials."""


def trials() -> str:
    """How many trainings on held-out views there were."""
    return str(len(records("held-out")))


def tried() -> str:
    """What settings gain over harmonics with shrinkage on held-out views: median dB / mean SSIM x 1000."""
    runs = list(records("held-out").values())
    base = {(one["scene"], view[0]): view for one in runs if one["name"] == BASE for view in one["per_image"]}
    gains: dict[tuple[str, str], list[tuple[float, float]]] = defaultdict(list)
    for one in runs:
        for name, psnr, ssim, *_ in one["per_image"]:
            if (truth := base.get((one["scene"], name))) is not None:
                gains[one["name"], one["scene"].split("/", 1)[1]].append((psnr - truth[1], ssim - truth[2]))
    scenes = [scene for scene in ("32/bonsai", "64/bonsai", *TRAINING_VIEWS) if ("field: trust", scene) in gains]
    body = []
    for trial, label in TRIED.items():
        views = [gains[trial, scene] for scene in scenes]
        if any(views):
            body.append([label, *map(_gain, views)])
    head = (f"bonsai, {scene.split('/')[0]} views" if "/" in scene else scene for scene in scenes)
    return grid(["", *head], body)


def _gain(views: list[tuple[float, float]]) -> str:
    """Of PSNR, the median; of SSIM, the mean; and the number of views."""
    if not views:
        return ""
    return f"{median(a for a, _ in views):+.2f} / {1000 * fmean(b for _, b in views):+.0f} ({len(views)})"


def _mean(runs: Iterable[dict[str, Any]], metric: str) -> float | None:
    values = [one[metric] for one in runs if one.get(metric) and one[metric] != [None] * len(one["per_image"])]
    return fmean(fmean(value) if isinstance(value, list) else value for value in values) if values else None


def _cell(runs: list[dict[str, Any]]) -> str:
    """PSNR / SSIM / FLIP, and the number of seeds if it is more than one."""
    values = [(_mean(runs, metric), form) for metric, form in (("psnr", ".2f"), ("ssim", ".3f"), ("flip", ".3f"))]
    text = "/".join(format(value, form) for value, form in values if value is not None)
    return (f"{text} ({len(runs)})" if len(runs) > 1 else text) or "-"


def _ahead(ours: list[dict[str, Any]], theirs: list[dict[str, Any]]) -> str:
    """Gain in the median view in dB, and in how many there is one."""
    gains = view_gains(ours, theirs)
    return f"{median(gains):+.2f} ({sum(one > 0 for one in gains)}/{len(gains)})" if gains else "-"


def _gap(runs: list[dict[str, Any]]) -> str:
    learnt = _mean(runs, "train_psnr")
    return "-" if learnt is None else f"{learnt - _mean(runs, 'psnr'):.1f}"


def test_views() -> str:
    """What test views have, and by how much training views are above them."""
    body = []
    for scene, views in TRAINING_VIEWS.items():
        field, shrunk, long, host = (runs_of(scene, name) for name in (FIELD, SHRUNK, LONG, HOST))
        gaps = f"{_gap(field)}, {_gap(shrunk)}"
        body.append(
            [f"{scene}, {views}", _cell(field), _cell(shrunk), _ahead(field, shrunk), _cell(long), _cell(host), gaps]
        )
    head = "`nrfgs`", "harmonics, same steps", "gain", "`nrfgs-sh`", "splatfacto", "gaps"
    return grid(["views", *head], body)


def equal() -> str:
    """Both heads with equal numbers of splats."""
    rows: list[list[str]] = [["`nrfgs`"], ["harmonics"], ["gain"]]
    for scene in TRAINING_VIEWS:
        field, other = (runs_of(scene, f"{name}, 150,000 splats") for name in (FIELD, "harmonics"))
        for row, text in zip(rows, (_cell(field), _cell(other), _ahead(field, other)), strict=True):
            row.append(text)
    return grid(["", *TRAINING_VIEWS], rows)
