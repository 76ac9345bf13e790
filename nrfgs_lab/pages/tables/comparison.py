# SPDX-License-Identifier: Apache-2.0
"""The numbers of docs/comparison.md."""

from collections import defaultdict
from statistics import fmean, median

from nrfgs_lab.bench.table import Row
from nrfgs_lab.pages.tables import bench_grid, bench_rows, grid, mean_of, records, signed
from nrfgs_lab.pages.tables.readme import TRAINING_VIEWS


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


# Equal numbers of splats on a capture of few views.


def fox() -> str:
    """Every metric of 3DGS and of the paper's field with 150,000 splats of fox."""
    found = [(run, bench_rows("budgets")["fox", "mcmc@150000", run]) for run in ("3DGS", "NRF-GS")]
    return bench_grid([("fox", found)], ["PSNR", "SSIM", "MS-SSIM", "FLIP", "L1", "train PSNR", "gap"])


def fox_views() -> str:
    """By how much the field is above 3DGS there in the median test view, and in how many views."""
    base, row = (bench_rows("budgets")["fox", "mcmc@150000", run] for run in ("3DGS", "NRF-GS"))
    gains = _view_gains(row, base)
    return (
        f"{signed(median(gains))} dB in the median test view, ahead in {sum(one > 0 for one in gains)} of {len(gains)}"
    )


def _view_gains(row: Row, base: Row) -> list[float]:
    """Decibels by which a row is above another in each test view, in the mean of the seeds of both."""
    gains = defaultdict(list)
    for seed in row.records.keys() & base.records.keys():
        views = [
            {v["image"]: v["psnr"] for v in one.records[seed]["measured"]["test"]["per_image"]} for one in (row, base)
        ]
        for image, psnr in views[0].items():
            gains[image].append(psnr - views[1][image])
    return list(map(fmean, gains.values()))


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
            found[scene] = median(_view_gains(*pair))
    return found


def best_trial(head: str) -> str:
    """The trial that gains most in the mean over captures; empty: the head's own setting."""
    gains = {trial: list(trial_gains(head, trial).values()) for trial in TRIALS}
    best = max(TRIALS, key=lambda trial: fmean(gains[trial]) if gains[trial] else 0.0)
    return best if gains[best] and fmean(gains[best]) > 0 else ""
