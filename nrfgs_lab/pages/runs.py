# SPDX-License-Identifier: Apache-2.0
"""The vocabulary of the blocks: records, the trainings in them, what they gain over each other, and how it is written.

A training is a dictionary with `seed`, `psnr`, `ssim`, `ms_ssim` and `flip` (means over test views), `splats` and
`per_image`: for each test view its name, PSNR and SSIM.
"""

import json
import re
from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from statistics import fmean
from typing import Any

from nrfgs_lab.bench.table import BY_NAME, Row
from nrfgs_lab.bench.table import grid as grid

ROOT = Path(__file__).resolve().parents[2]
RUN = re.compile(
    r"runs/(?P<run>.+)-(?P<strategy>own|(original|splatfacto|mcmc|error-guided)(@\w+)?)-(?P<scene>[^-]+)-(?P<seed>\d+)"
)
"""Names of a benchmark's records. An underscore stands for a space."""
VIEWS = {"bonsai": 255, "goldcape": 74, "caliterra": 65, "fox": 43, "castle": 26, "kitchen": 21, "fern": 17}
"""Capture -> its training views."""
ORIGINAL = "original"
"""3DGS's rules for adding and removing splats."""
Trainings = list[dict[str, Any]]
"""Trainings of one setting, by seed."""


@cache
def records(*studies: str) -> dict[str, Any]:
    """The records of results/STUDY.json of one or more studies."""
    contents = (json.loads((ROOT / "results" / f"{study}.json").read_text(encoding="utf-8")) for study in studies)
    return {name: record for content in contents for name, record in content.get("records", content).items()}


@cache
def bench_rows(study: str) -> dict[tuple[str, str, str], Row]:
    """The rows of a benchmark's records: (scene, strategy, run) -> its values over seeds."""
    rows: dict[tuple[str, str, str], Row] = {}
    for name, record in records(study).items():
        if match := RUN.fullmatch(name):
            place = match["scene"], match["strategy"], match["run"]
            row = rows.setdefault(place, Row(match["scene"], match["run"], match["strategy"]))
            row.records[int(match["seed"])] = {"jobs": 1, **record}
    return {place: row.fill() for place, row in rows.items()}


def mean_of(row: Row, column: str) -> float:
    """A row's mean over seeds."""
    return row.mean(BY_NAME[column])


def trainings(study: str, scene: str, run: str, strategy: str = ORIGINAL) -> Trainings:
    """The trainings of a run of a benchmark; none of a missing one."""
    row = bench_rows(study).get((scene, strategy, run))
    trainings = []
    for seed, record in row.records.items() if row else ():
        test = record["measured"]["test"]
        views = [[view["image"], view["psnr"], view["ssim"]] for view in test["per_image"]]
        values = {metric: test.get(metric) for metric in ("psnr", "ssim", "ms_ssim", "flip")}
        trainings.append({**values, "seed": seed, "per_image": views, "splats": record["measured"]["splats"]})
    return trainings


def mean(runs: Trainings, metric: str) -> float:
    return fmean(one[metric] for one in runs)


def view_gains(ours: Trainings, theirs: Trainings, all_seeds: bool = False) -> list[float]:
    """Gain in dB in each test view, in the mean over the seeds that both have, or over all that each has."""
    seeds = {one["seed"] for one in ours} & {one["seed"] for one in theirs}
    views: dict[str, list[list[float]]] = defaultdict(lambda: [[], []])
    for number, runs in enumerate((ours, theirs)):
        for one in runs:
            for name, psnr, *_ in one["per_image"] if all_seeds or one["seed"] in seeds else ():
                views[name][number].append(psnr)
    return [fmean(one) - fmean(other) for one, other in views.values() if one and other]


def signed(difference: float, digits: int = 1) -> str:
    """A difference with its sign; without one if it rounds to 0."""
    number = f"{difference:+.{digits}f}"
    return number if float(number) else number[1:]


def span(numbers: Sequence[float], form: Callable[[float], str]) -> str:
    """Least and largest number, once if they are equal as written."""
    return " to ".join(dict.fromkeys(form(bound(numbers)) for bound in (min, max)))
