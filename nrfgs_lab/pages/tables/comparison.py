# SPDX-License-Identifier: Apache-2.0
"""The numbers of docs/comparison.md."""

from collections import defaultdict
from collections.abc import Iterable
from functools import cache
from statistics import fmean, median
from typing import Any

from nrfgs_lab.bench.table import Row, average, ranks
from nrfgs_lab.pages.tables import BY_NAME, bench_grid, bench_rows, bold, grid, mean_of, records, signed
from nrfgs_lab.pages.tables.readme import FIELD, TRAINING_VIEWS, runs_of

METHODS = ["3DGS", "VDGS", "GSNB", "SG", "NRF-GS"]
PSNR, SSIM = BY_NAME["PSNR"], BY_NAME["SSIM"]


def gain(scene: str, rule: str, run: str, base: str) -> str:
    """Decibels by which a run is above another, in the mean of their seeds."""
    rows = bench_rows("comparison")
    return signed(mean_of(rows[scene, rule, run], "PSNR") - mean_of(rows[scene, rule, base], "PSNR"))


def ssim(scene: str, rule: str, run: str, base: str) -> str:
    """The same of SSIM."""
    rows = bench_rows("comparison")
    return signed(mean_of(rows[scene, rule, run], "SSIM") - mean_of(rows[scene, rule, base], "SSIM"), 3)


def gains(scene: str, rule: str, run: str, base: str, without: str = "") -> str:
    """The same, seed by seed.

    Args:
        without: name of a test view that is left out.
    """
    rows = bench_rows("comparison")

    def psnr(name: str, seed: int) -> float:
        views = rows[scene, rule, name].records[seed]["measured"]["test"]["per_image"]
        return fmean(view["psnr"] for view in views if not without or without not in view["image"])

    return " and ".join(signed(psnr(run, seed) - psnr(base, seed)) for seed in sorted(rows[scene, rule, run].records))


def view(scene: str, rule: str, run: str, image: str) -> str:
    """PSNR of one test view, seed by seed."""
    found = [
        next(one["psnr"] for one in record["measured"]["test"]["per_image"] if image in one["image"])
        for _, record in sorted(bench_rows("comparison")[scene, rule, run].records.items())
    ]
    return " and ".join(f"{psnr:.1f}" for psnr in found)


def ratio(scene: str, run: str, base: str) -> str:
    """Splats of a run over another's, under 3DGS's rules."""
    rows = bench_rows("comparison")
    return f"{mean_of(rows[scene, 'original', run], 'splats') / mean_of(rows[scene, 'original', base], 'splats'):.2f}"


def stored_opacity(splats: str) -> str:
    """PSNR of the field on bonsai where all of MCMC's rules go by the stored opacity."""
    record = records("comparison")[f"stored-opacity/NRF-GS-mcmc@{splats}-bonsai-42"]
    return f"{record['measured']['test']['psnr']:.1f}"


# One protocol as near to the paper's as the host comes.

OF_THE_PAPER = {"3DGS": None, "VDGS": (0.49, 1.286), "GSNB": (0.96, 1.175), "NRF-GS": (1.01, 0.456)}
"""The paper's figures of bonsai: decibels over 3DGS, and splats in multiples of 3DGS's."""


def paper() -> str:
    """Gains and splats on bonsai beside the paper's: in its protocol, and in that of the claims."""
    places = [("paper", "its protocol, one seed"), ("comparison", "the claims' protocol, two seeds")]
    body = []
    for run, told in OF_THE_PAPER.items():
        cells = []
        for study, _ in places:
            rows = {name: row for (scene, rule, name), row in bench_rows(study).items() if (scene, rule) == PLACE}
            row, base = rows.get(run), rows["3DGS"]
            if row is None:
                cells.append("not run")
                continue
            cells.append(f"{mean_of(row, 'PSNR'):.2f}, {mean_of(row, 'splats') / 1000:.0f}k")
            if row is not base:
                gain = signed(mean_of(row, "PSNR") - mean_of(base, "PSNR"), 2)
                cells[-1] += f": {gain}, {mean_of(row, 'splats') / mean_of(base, 'splats'):.2f}"
        body.append([run, *cells, f"{told[0]:+.2f}, {told[1]:.2f}" if told else ""])
    return grid(
        ["PSNR, splats: gain over 3DGS, share of its splats", *(title for _, title in places), "the paper"], body
    )


PLACE = "bonsai", "original"


# Every capture.

DEFAULT = "default"
STEPS = 10_000
"""Of all trainings; the default makes more for `bonsai`."""
BASE = {"NRF-GS_base": "NRF-GS, `base`", "VDGS_base": "VDGS, `base`"}


@cache
def _rows() -> dict[tuple[str, str, str], Row]:
    """(scene, strategy, run) -> row, of all captures under every strategy; the default as docs/captures.md has it."""
    rows = {**bench_rows("methods"), **bench_rows("budgets")}
    for scene in TRAINING_VIEWS:
        made = {one["seed"]: _as_benchmarked(one) for one in runs_of(scene, FIELD) if one["made_steps"] == STEPS}
        if made:
            rows[scene, "own", DEFAULT] = Row(scene, DEFAULT, "own", made).fill()
    return rows


def _as_benchmarked(one: dict[str, Any]) -> dict[str, Any]:
    """A record of results/captures.json as `nrfgs bench` would have written it."""
    views = [{"image": image, "psnr": psnr} for image, psnr, *_ in one["per_image"]]
    test = {name: one[name] for name in ("psnr", "ssim", "ms_ssim")} | {"per_image": views}
    test["flip"] = fmean(one["flip"]) if one.get("flip") else None
    measured = {"test": test, "train": {"psnr": one["train_psnr"]}}
    measured |= {"splats": one["splats"], "parameter_bytes": one["splats_bytes"]}
    return {"jobs": 2, "machine": one["machine"], "train": {}, "measured": measured}


def _shared(strategy: str, runs: Iterable[str]) -> list[str]:
    """The captures of which all these runs have records."""
    return [scene for scene in TRAINING_VIEWS if all(_place(scene, strategy, run) in _rows() for run in runs)]


def _place(scene: str, strategy: str, run: str) -> tuple[str, str, str]:
    return scene, "own" if run == DEFAULT else strategy, run


def every(strategy: str, *more: str) -> str:
    """PSNR, SSIM and splats of each method on each capture."""
    rows, body = _rows(), []
    runs = [*METHODS, *more]
    for scene, views in TRAINING_VIEWS.items():
        found = {run: rows[place] for run in runs if (place := _place(scene, strategy, run)) in rows}
        if not found.keys() - {DEFAULT}:
            continue
        best = [
            {list(found)[n] for n, rank in ranks(list(found.values()), one).items() if rank == 1}
            for one in (PSNR, SSIM)
        ]
        cells = []
        for run in runs:
            if run not in found:
                cells.append("not run")
                continue
            row = found[run]
            psnr = bold(f"{mean_of(row, 'PSNR'):.2f}", run in best[0])
            ssim = bold(f"{mean_of(row, 'SSIM'):.3f}", run in best[1])
            seeds = f" ({len(row.records)})" if len(row.records) > 1 else ""
            cells.append(f"{psnr}, {ssim}, {mean_of(row, 'splats') / 1000:.0f}k{seeds}")
        body.append([f"{scene}, {views}", *cells])
    return grid(["capture, views", *(BASE.get(run, run) for run in runs)], body)


def averages() -> str:
    """Every metric in the mean over the captures that all methods have."""
    groups = []
    for strategy, title in (("original", "3DGS's rules"), ("mcmc@150000", "150,000 splats (MCMC)")):
        scenes, rows = _shared(strategy, METHODS), _rows()
        if len(scenes) > 1:
            means = [
                (run, average([_first(rows[_place(scene, strategy, run)]) for scene in scenes])) for run in METHODS
            ]
            groups.append((f"{title}, {len(scenes)} captures", means))
    return bench_grid(groups, ["PSNR", "SSIM", "MS-SSIM", "FLIP", "L1", "splats", "MB", "gap"])


def _first(row: Row) -> Row:
    """The same with its first seed alone, so that captures weigh alike."""
    seed = min(row.records)
    return Row(row.scene, row.run, row.strategy, {seed: row.records[seed]}).fill()


def ahead(strategy: str, run: str, base: str) -> str:
    """On how many captures a run is above another in its median test view, and by how much in the median capture."""
    gains = list(median_gains(strategy, run, base).values())
    return f"{sum(gain > 0 for gain in gains)} of {len(gains)} captures, by {signed(median(gains))}"


def median_gains(strategy: str, run: str, base: str) -> dict[str, float]:
    """Capture -> decibels by which a run is above another in the median test view, in the mean of seeds of both."""
    rows = _rows()
    return {
        scene: _median_gain(rows[_place(scene, strategy, run)], rows[_place(scene, strategy, base)])
        for scene in _shared(strategy, (run, base))
    }


def _median_gain(row: Row, base: Row) -> float:
    seeds = row.records.keys() & base.records.keys()
    gains = defaultdict(list)
    for seed in seeds:
        views = [
            {v["image"]: v["psnr"] for v in one.records[seed]["measured"]["test"]["per_image"]} for one in (row, base)
        ]
        for image, psnr in views[0].items():
            gains[image].append(psnr - views[1][image])
    return median(map(fmean, gains.values()))


# How the heads' settings were chosen.

TRIALS = {"third": "a third of its rate", "triple": "three times its rate", "shrinkage": "shrinkage"}


def heads() -> str:
    """What each trial gains over the head's own setting in the median held-out view: mean over captures, and each."""
    body = []
    for head in ("SH", "VDGS", "GSNB", "SG", "NRF"):
        gains = {trial: trial_gains(head, trial) for trial in TRIALS}
        cells = [
            f"{signed(fmean(g.values()), 2)} ({', '.join(signed(x, 2) for x in g.values())})" if g else "-"
            for g in gains.values()
        ]
        body.append([head, *cells])
    return grid(["head", *TRIALS.values()], body)


def trial_gains(head: str, trial: str) -> dict[str, float]:
    """Capture -> decibels over the head's own setting in the median held-out view."""
    rows = bench_rows("heads")
    found = {}
    for scene in TRAINING_VIEWS:
        pair = [rows.get((scene, "original", name)) for name in (f"{head}_{trial}", head)]
        if all(pair):
            found[scene] = _median_gain(*pair)
    return found
