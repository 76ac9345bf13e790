# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/captures.md."""

from collections.abc import Iterable, Mapping
from statistics import fmean, median
from typing import Any

from nrfgs_lab.pages.tables import grid, records, signed
from nrfgs_lab.pages.tables.readme import FIELD, HOST, SHRUNK, TRAINING_VIEWS, runs_of, view_gains

BASE = "harmonics: shrinkage"
TRIED = {
    "**u = V / (V + 20)**": ("field", "field: trust"),
    "u = 1": ("field: u = 1", "field: whole"),
}
"""Rows of the table of held-out views, by the names of their trials: of this version, and of one that did the same."""
INSTEAD = (
    ("`original`", "10,000 steps: 3DGS", "10,000 steps: field"),
    ("`peak`", "field: peak", "field"),
    ("`mcmc`", "mcmc: logit", "field"),
)
"""Rows of the second table: label, trial, and the trial of the default that it is compared with."""
BY_ERROR = {
    "`original`": "3DGS",
    "by error": "error",
    "wide splats stay": "error: any width",
    "the same, prune below 0.05": "error: any width, prune 0.05",
    "residual on the logit": "error: logit",
    "faster growth": "error: fast all",
    "the same, resets": "error: fast all, reset",
}
"""Rows of the third table, by their trials in results/error-guided.json."""
BUDGET = "nrfgs, 150,000 splats", "harmonics, 150,000 splats"


def trials() -> str:
    """How many trainings on held-out views there were."""
    return str(len(records("held-out")))


def tried() -> str:
    """What settings gain over harmonics with shrinkage on held-out views: median dB, mean SSIM x 1000."""
    return gains_over(BASE, TRIED)


def gains_over(harmonics: str, rows: Mapping[str, Iterable[str]]) -> str:
    """A table of what trials gain over others on held-out views that all have: median dB, mean SSIM x 1000.

    Args:
        harmonics: the others' name.
        rows: names of trials, by the row's label.
    """
    base = _views(harmonics)
    found = {label: dict(pair for name in names for pair in _views(name).items()) for label, names in rows.items()}
    common = [view for view in base if all(view in views for views in found.values())]
    places = {scene: [view for view in common if view[0] == scene] for scene in list(TRAINING_VIEWS)[1:]}
    body = [[label, *(_gain(views, base, places[scene]) for scene in places)] for label, views in found.items()]
    return grid(["views", *(f"{scene}, {len(views)}" for scene, views in places.items())], body)


def _views(trial: str) -> dict[tuple[str, str, str], tuple[float, float]]:
    """PSNR and SSIM of a trial's held-out views: (capture, which were held out, image) -> both."""
    return {
        (one["scene"].partition("/")[2], one["scene"].partition("/")[0], view[0]): (view[1], view[2])
        for one in records("held-out").values()
        if one["name"] == trial
        for view in one["per_image"]
    }


def instead() -> str:
    """What other ways for splats to come and go gain over the default's on held-out views, and their splats."""
    runs, scenes, body = list(records("held-out").values()), list(TRAINING_VIEWS)[1:], []
    for label, trial, default in INSTEAD:
        ours, theirs = _views(trial), _views(default)
        cells = [_gain(ours, theirs, [view for view in theirs if view in ours and view[0] == one]) for one in scenes]
        splats = [{one["scene"]: one["splats"] for one in runs if one["name"] == name} for name in (trial, default)]
        share = median(splats[0][scene] / splats[1][scene] for scene in splats[0].keys() & splats[1].keys())
        body.append([label, *cells, f"{share:.1f}"])
    return grid(["", *scenes, "splats"], body)


def by_error() -> str:
    """What growth by error gains over the default on held-out views, in the mean over seeds, and its splats."""
    scenes, runs = list(TRAINING_VIEWS)[1:], records("error-guided").values()

    def means(trial: str, scene: str) -> tuple[dict[str, tuple[float, float]], float]:
        seeds = [run for run in runs if run["name"] == trial and run["scene"].endswith(f"/{scene}")]
        views = zip(*(run["per_image"] for run in seeds), strict=True)
        values = {view[0][0]: (fmean(one[1] for one in view), fmean(one[2] for one in view)) for view in views}
        return values, fmean(run["splats"] for run in seeds) if seeds else 0.0

    body = []
    for label, trial in BY_ERROR.items():
        pairs = [(means(trial, scene), means("default", scene)) for scene in scenes]
        shares = [ours[1] / theirs[1] for ours, theirs in pairs if ours[1]]
        cells = [_gain(ours[0], theirs[0], sorted(ours[0])) for ours, theirs in pairs]
        body.append([label, *cells, f"{median(shares):.1f}"])
    return grid(["", *scenes, "splats"], body)


def _gain(ours: Mapping, theirs: Mapping, views: list) -> str:
    if not views:
        return ""
    psnr, ssim = ([ours[view][number] - theirs[view][number] for view in views] for number in (0, 1))
    return f"{signed(median(psnr), 2)}/{signed(1000 * fmean(ssim), 0)}"


def without(trial: str) -> str:
    """What a trial has more than the default on `bonsai` with all its views but those held out, in both ways."""
    runs = records("held-out")
    texts, better, count, splats = [], 0, 0, []
    for place in ("4/bonsai", "0/bonsai"):
        base = runs[f"field/{place}-42"]
        if (one := runs.get(f"field: {trial}/{place}-42")) is None:
            continue
        pairs = list(zip(one["per_image"], base["per_image"], strict=True))
        texts.append(f"{fmean(ours[1] - theirs[1] for ours, theirs in pairs):+.2f}")
        better += sum(ours[2] > theirs[2] for ours, theirs in pairs)
        count += len(pairs)
        splats.append(one["splats"] / base["splats"])
    more = f"{100 * fmean(splats) - 100:+.0f} % splats"
    return f"{' and '.join(texts)} dB, SSIM better in {better} of {count} views, {more}"


def _mean(runs: Iterable[dict[str, Any]], metric: str) -> float | None:
    values = [one[metric] for one in runs if one.get(metric) and one[metric] != [None] * len(one["per_image"])]
    return fmean(fmean(value) if isinstance(value, list) else value for value in values) if values else None


def _cell(runs: list[dict[str, Any]]) -> str:
    """PSNR/SSIM in the mean over seeds."""
    values = [(_mean(runs, metric), form) for metric, form in (("psnr", ".2f"), ("ssim", ".3f"))]
    return "/".join(format(value, form) for value, form in values if value is not None) or "-"


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
        field, shrunk, host = (runs_of(scene, name) for name in (FIELD, SHRUNK, HOST))
        budget = [runs_of(scene, name) for name in BUDGET]
        cells = _cell(field), _cell(host), _cell(shrunk), _ahead(field, shrunk), f"{_gap(field)}, {_gap(shrunk)}"
        body.append([f"{scene}, {views}", *cells, ", ".join(map(_cell, budget)), _ahead(*budget)])
    head = "`nrfgs`", "splatfacto", "harmonics", "gain", "gaps", "150k: field, harmonics", "gain there"
    return grid(["capture, training views", *head], body)
