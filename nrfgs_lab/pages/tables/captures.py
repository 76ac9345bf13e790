# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/captures.md."""

from collections import defaultdict
from collections.abc import Iterable
from statistics import fmean, median
from typing import Any

from nrfgs_lab.held_out import effects
from nrfgs_lab.pages.tables import bold, grid, records
from nrfgs_lab.pages.tables.readme import FIELD, HARMONICS, LONG, TRAINING_VIEWS, runs_of, view_gains

SHRUNK = "nrfgs-sh, nrfgs's steps and shrinkage"
EXPOSURE_LEARNT = " *"
"""Mark of trainings that learnt each photograph's exposure, as an earlier rule had it."""
SMALL = "late start, no opacity residual, one band, noise 1"
SHOWN = {
    "field: plain": "field: noise 0.5",
    "field: late start": "and late start",
    "field: late start, no opacity residual": "and no opacity residual",
    f"field: {SMALL}": "and one band, noise 1",
    f"field: {SMALL}, shrinkage 0.15 / V": "and shrinkage 0.15 / V",
    "harmonics: shrinkage 0.15 / V": "harmonics, shrinkage 0.15 / V",
}
"""Rows of the second table of held-out views, by the names of their trials."""


def held_out(**wanted: Any) -> list[dict[str, Any]]:
    """The records of held-out views with these entries."""
    found = records("held-out").values()
    return [one for one in found if all(one.get(name) == value for name, value in wanted.items())]


def gain(decibels: float, ssim: float) -> str:
    """A difference: dB / thousandths of SSIM."""
    return f"{decibels:+.2f} / {1000 * ssim:+.0f}"


def trials() -> str:
    """How many trainings and settings there were."""
    found = records("held-out").values()
    count = {head: len({_setting(one) for one in found if _head(one) == head}) for head in ("field", "harmonics")}
    return (
        f"{len(found)} trainings: {count['field']} settings of the field, {count['harmonics']} of harmonics, which had "
        "fewer before the screening and as many in it"
    )


def _head(one: dict[str, Any]) -> str:
    return "harmonics" if one["method"] == "nrfgs-sh" else "field"


def _setting(one: dict[str, Any]) -> str:
    return str((one["group"].split(",")[0], one["steps"], one["settings"], one.get("experiment")))


def screening() -> str:
    """What each factor does to held-out views of fern."""
    body = []
    for head in ("field", "harmonics"):
        found = effects(held_out(study="screening", head=head, scene="fern"))
        body += [[head, factor, gain(*found[factor])] for factor in sorted(found, key=found.get, reverse=True)]
    return grid(["", "factor", "effect"], body)


def together() -> str:
    """What is gained over harmonics as they were, on held-out views."""
    runs = held_out(group="splatfacto")
    base = {
        (one["scene"], one["offset"], view[0]): view
        for one in runs
        for view in one["per_image"]
        if one["trial"] == "harmonics: plain"
    }
    gains, left = defaultdict(list), {}
    for one in runs:
        left.setdefault(one["scene"], TRAINING_VIEWS[one["scene"]] - len(one["per_image"]))
        for name, psnr, ssim, *_ in one["per_image"]:
            if (truth := base.get((one["scene"], one["offset"], name))) is not None:
                gains[one["trial"], one["scene"]].append((psnr - truth[1], ssim - truth[2]))
    scenes = [scene for scene in TRAINING_VIEWS if any(key[1] == scene for key in gains)]
    body = []
    for trial, label in SHOWN.items():
        views = [gains[trial, scene] for scene in scenes]
        body.append([label, *(gain(median(a for a, _ in v), fmean(b for _, b in v)) if v else "" for v in views)])
    return grid(["", *(f"{scene} ({left[scene]})" for scene in scenes)], body)


def halves() -> str:
    """Held-out views of bonsai after trainings with all, half and a quarter of the other views."""
    groups = {
        "splatfacto": "all",
        "splatfacto, every second view": "half",
        "splatfacto, every fourth view": "a quarter",
    }
    names = {
        "field: late start": "field: noise 0.5, late start",
        "field: late start, no opacity residual": "and no opacity residual",
        f"field: {SMALL}": "and one band, noise 1",
        "field: late start, shrinkage 0.15 / V": "noise 0.5, late start, shrinkage 0.15 / V",
    }
    body = []
    for trial, label in names.items():
        cells = []
        for group in groups:
            runs = [one for one in held_out(scene="bonsai", trial=trial) if one["group"] == group]
            runs = [one for one in runs if one["study"] == "together"]
            cells.append(f"{runs[-1]['psnr']:.2f} / {runs[-1]['ssim']:.3f}" if runs else "")
        body.append([label, *cells])
    return grid(["PSNR / SSIM", *groups.values()], body)


def _mean(runs: Iterable[dict[str, Any]], metric: str) -> float | None:
    values = [one[metric] for one in runs if one.get(metric)]
    return fmean(fmean(value) if isinstance(value, list) else value for value in values) if values else None


def _best(found: list[list[dict[str, Any]]]) -> dict[str, float]:
    """The best mean of each metric."""
    return {
        metric: choose([value for runs in found if (value := _mean(runs, metric)) is not None], default=0.0)
        for metric, choose in (("psnr", max), ("ssim", max), ("flip", min))
    }


def _cell(runs: list[dict[str, Any]], best: dict[str, float]) -> str:
    if not runs:
        return "-"
    flip, seeds = _mean(runs, "flip"), f" ({len(runs)})" if len(runs) > 1 else ""
    values = [
        bold(f"{_mean(runs, 'psnr'):.2f}", _mean(runs, "psnr") == best["psnr"]),
        bold(f"{_mean(runs, 'ssim'):.3f}", _mean(runs, "ssim") == best["ssim"]),
        "-" if flip is None else bold(f"{flip:.3f}", flip == best["flip"]),
    ]
    splats = _mean(runs, "splats")
    mark = EXPOSURE_LEARNT if any(one.get("photographs") == "on" for one in runs) else ""
    return " / ".join(values) + ("" if splats is None else f", {splats / 1000:.0f}k") + seeds + mark


def test_views() -> str:
    """PSNR / SSIM / FLIP and splats on test views."""
    body = []
    for scene, views in TRAINING_VIEWS.items():
        found = [runs_of(scene, name) for name in (FIELD, HARMONICS, SHRUNK, LONG)]
        body.append([scene, str(views), *(_cell(runs, _best(found)) for runs in found)])
    return grid(["", "views", "`nrfgs`", "harmonics, the same steps", "and shrinkage", "`nrfgs-sh`"], body)


def gaps() -> str:
    """Gains in the median view, and how far training views are above test views."""
    body = []
    for scene, views in TRAINING_VIEWS.items():
        field, harmonics, shrunk, long = (runs_of(scene, name) for name in (FIELD, HARMONICS, SHRUNK, LONG))
        if not field:
            continue
        cells = []
        for other in (harmonics, shrunk, long):
            gains = view_gains(field, [one for one in other if "per_image" in one])
            cells.append(f"{median(gains):+.2f}, {sum(one > 0 for one in gains)} of {len(gains)}" if gains else "-")
        for runs in (field, harmonics):
            learnt = _mean(runs, "train_psnr")
            cells.append("-" if learnt is None else f"{learnt - _mean(runs, 'psnr'):.1f}")
        body.append([scene, str(views), *cells])
    names = "over harmonics, the same steps", "with shrinkage", "over `nrfgs-sh`", "gap, `nrfgs`", "gap, harmonics"
    return grid(["", "views", *names], body)


def before() -> str:
    """What the default was before, and a late start on bonsai, on test views."""
    names = {"nrfgs without noise": "no noise", "nrfgs, noise alone": "noise alone", FIELD: "`nrfgs`"}
    late = "nrfgs, late start and shrinkage"
    scenes = "bonsai", "kitchen", "fern"
    rows = {label: [runs_of(scene, name) for scene in scenes] for name, label in names.items()}
    rows |= {"noise, late start, shrinkage": [runs_of(scene, late) for scene in scenes]}
    cells = [
        [label, *(f"{_mean(runs, 'psnr'):.2f} / {_mean(runs, 'ssim'):.3f}" if runs else "" for runs in row)]
        for label, row in rows.items()
    ]
    return grid(["PSNR / SSIM", *scenes], cells)
