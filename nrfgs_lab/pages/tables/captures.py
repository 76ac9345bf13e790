# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/captures.md."""

from collections import defaultdict
from collections.abc import Iterable
from statistics import fmean, median
from typing import Any

from nrfgs_lab.pages.tables import bold, grid, records
from nrfgs_lab.pages.tables.readme import FIELD, HARMONICS, HOST, LONG, SHRUNK, TRAINING_VIEWS, runs_of, view_gains

BASE = "harmonics: shrinkage"
STORED = ", shrinkage of what is stored"
OLDER = " *"
"""Mark of what an earlier version trained."""
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


def _cell(runs: list[dict[str, Any]], best: dict[str, float], version: set[str]) -> str:
    if not runs:
        return "-"
    values = []
    for metric, form in (("psnr", ".2f"), ("ssim", ".3f"), ("flip", ".3f")):
        value = _mean(runs, metric)
        values.append("-" if value is None else bold(format(value, form), value == best[metric]))
    splats = _mean(runs, "splats")
    text = " / ".join(values) + ("" if splats is None else f", {splats / 1000:.0f}k")
    text += f" ({len(runs)})" if len(runs) > 1 else ""
    return text + (OLDER if any(one.get("machine", {}).get("source") not in version for one in runs) else "")


def test_views() -> str:
    """PSNR / SSIM / FLIP and splats on test views."""
    names = FIELD, SHRUNK, HARMONICS, LONG, HOST
    version = {one["machine"]["source"] for scene in TRAINING_VIEWS for one in runs_of(scene, FIELD)}
    body = []
    for scene, views in TRAINING_VIEWS.items():
        found = [runs_of(scene, name) for name in names]
        best = {
            metric: choose((value for runs in found if (value := _mean(runs, metric)) is not None), default=0.0)
            for metric, choose in (("psnr", max), ("ssim", max), ("flip", min))
        }
        body.append([scene, str(views), *(_cell(runs, best, version) for runs in found)])
    head = "`nrfgs`", "harmonics, same steps and shrinkage", "without shrinkage", "`nrfgs-sh`", "splatfacto"
    return grid(["", "views", *head], body)


def gaps() -> str:
    """Gains in the median view, and how far training views are above test views."""
    body = []
    for scene, views in TRAINING_VIEWS.items():
        field, *others = (runs_of(scene, name) for name in (FIELD, SHRUNK, LONG, HOST))
        cells = []
        for other in others:
            gains = view_gains(field, other)
            cells.append(f"{median(gains):+.2f}, {sum(one > 0 for one in gains)} of {len(gains)}" if gains else "-")
        ssim = _mean(field, "ssim"), _mean(others[0], "ssim")
        cells.insert(1, "-" if None in ssim else f"{1000 * (ssim[0] - ssim[1]):+.0f}")
        for runs in (field, others[0]):
            learnt = _mean(runs, "train_psnr")
            cells.append("-" if learnt is None else f"{learnt - _mean(runs, 'psnr'):.1f}")
        body.append([scene, str(views), *cells])
    names = "over harmonics with shrinkage, dB", "SSIM x 1000", "over `nrfgs-sh`", "over splatfacto"
    return grid(["", "views", *names, "gap, `nrfgs`", "gap, harmonics"], body)


def many() -> str:
    """What trust and shrinkage cost a capture of many views."""
    found = [runs_of("bonsai", name)[0] for name in (FIELD, "nrfgs, noise alone")]
    with_them, without = (f"{one['psnr']:.2f} dB with {one['splats'] / 1000:.0f}k splats" for one in found)
    return f"{with_them}; an earlier version with noise alone {without}"
