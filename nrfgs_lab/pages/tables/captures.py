# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/captures.md."""

from collections import defaultdict
from collections.abc import Iterable, Mapping
from statistics import fmean, median
from typing import Any

from nrfgs_lab.pages.tables import grid, records
from nrfgs_lab.pages.tables.readme import FIELD, HOST, SHRUNK, TRAINING_VIEWS, runs_of, view_gains

BASE = "harmonics: shrinkage"
FIELDS = "field", "field: trust"
"""The default, of this version and of one whose field was the same."""
TRIED = {
    "**`nrfgs`**": FIELDS,
    "u = 1": ("field: u = 1", "field: whole"),
    "`peak`": ("field: peak",),
}
"""Rows of the table of held-out views, by the names of their trials."""
BUDGET = "nrfgs, 150,000 splats", "harmonics, 150,000 splats"


def trials() -> str:
    """How many trainings on held-out views there were."""
    return str(len(records("held-out")))


def tried() -> str:
    """What settings gain over harmonics with shrinkage on held-out views: median dB, mean SSIM x 1000."""
    return gains_over(BASE, TRIED)


def gains_over(harmonics: str, rows: Mapping[str, Iterable[str]]) -> str:
    """A table of what trials gain over others on held-out views: median dB, mean SSIM x 1000.

    Args:
        harmonics: the others' name.
        rows: names of trials, by the row's label.
    """
    runs = list(records("held-out").values())
    base = {(one["scene"], view[0]): view for one in runs if one["name"] == harmonics for view in one["per_image"]}
    gains: dict[tuple[str, str], list[tuple[float, float]]] = defaultdict(list)
    for one in runs:
        for view in one["per_image"]:
            if (truth := base.get((one["scene"], view[0]))) is not None:
                gains[one["name"], one["scene"].split("/", 1)[1]].append((view[1] - truth[1], view[2] - truth[2]))
    scenes = list(TRAINING_VIEWS)[1:]
    body = []
    for label, names in rows.items():
        found = [[pair for name in names for pair in gains[name, scene]] for scene in scenes]
        body.append([label, *map(_gain, found)])
    return grid(["", *scenes], body)


def over(trial: str, base: str) -> str:
    """What a trial gains over another on held-out views, as the table has it, and the median of its share of splats."""
    table = gains_over(base, {"": (trial,)}).splitlines()
    scenes, cells = ([cell.strip() for cell in table[line].split("|")[2:-1]] for line in (0, 2))
    runs = list(records("held-out").values())
    splats = [{one["scene"]: one["splats"] for one in runs if one["name"] == name} for name in (trial, base)]
    share = median(splats[0][scene] / splats[1][scene] for scene in splats[0].keys() & splats[1].keys())
    told = ", ".join(f"`{scene}` {cell}" for scene, cell in zip(scenes, cells, strict=True))
    return f"{told}, with {share:.1f} times the splats"


def _gain(views: list[tuple[float, float]]) -> str:
    return f"{median(a for a, _ in views):+.2f}/{1000 * fmean(b for _, b in views):+.0f}" if views else ""


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
        cells = _cell(field), _cell(host), _cell(shrunk), _ahead(field, shrunk), f"{_gap(field)} {_gap(shrunk)}"
        body.append([f"{scene}, {views}", *cells, " ".join(map(_cell, budget)), _ahead(*budget)])
    head = "`nrfgs`", "splatfacto", "harmonics", "gain", "gaps", "150k", "gain"
    return grid(["views", *head], body)
