# SPDX-License-Identifier: Apache-2.0
"""The numbers of docs/comparison.md."""

from statistics import fmean, median
from typing import Any

from nrfgs_lab.pages.tables import bench_rows, bold, grid, mean_of, records, signed
from nrfgs_lab.pages.tables.readme import TRAINING_VIEWS, runs_of, trials_of, view_gains

Runs = list[dict[str, Any]]
"""Trainings of one setting, by seed, as results/captures.json has them."""

# Every capture.

RULES, BUDGET = "3DGS's rules", "150,000 splats"
GROUPS = {RULES: ("VDGS", "GSNB", "SG", "NRF-GS", "ours"), BUDGET: ("ours",)}
"""Group of rows -> what is compared with 3DGS."""
BASE = "3DGS"
WITH_A_BUDGET = {BASE: "harmonics, 150,000 splats", "ours": "nrfgs, 150,000 splats"}
"""Run -> its name in results/captures.json."""
OF_THE_PAPER = {"VDGS": (0.49, 1.286), "GSNB": (0.96, 1.175), "NRF-GS": (1.01, 0.456)}
"""The paper's gains on bonsai, in dB, and splats in multiples of 3DGS's."""


def _runs(group: str, scene: str, run: str) -> Runs:
    if group == BUDGET:
        return runs_of(scene, WITH_A_BUDGET[run])
    row = bench_rows("methods").get((scene, "original", run))
    return trials_of(row) if row else []


def _gain(ours: Runs, theirs: Runs, metric: str) -> float:
    return fmean(one[metric] for one in ours) - fmean(one[metric] for one in theirs)


def _share(ours: Runs, theirs: Runs) -> float:
    return fmean(one["splats"] for one in ours) / fmean(one["splats"] for one in theirs)


def every() -> str:
    """3DGS's PSNR and SSIM on each capture, and what the others gain: dB, SSIM x 1000, share of its splats."""
    body = []
    for group, methods in GROUPS.items():
        found = {run: {scene: _runs(group, scene, run) for scene in TRAINING_VIEWS} for run in (BASE, *methods)}
        first = [_cell(found, BASE, scene) for scene in TRAINING_VIEWS]
        psnr = f"{mean_of(bench_rows('paper')['bonsai', 'original', BASE], 'PSNR'):.2f}"
        body.append([f"**{group}**: {BASE}", "", psnr if group == RULES else "", *first, ""])
        for run in methods:
            pairs = [(found[run][scene], found[BASE][scene]) for scene in TRAINING_VIEWS]
            shares = [_share(ours, base) for ours, base in pairs if ours and base]
            own = [_of_the_paper(run), _protocol(run)] if group == RULES else ["", ""]
            cells = [_cell(found, run, scene) for scene in TRAINING_VIEWS]
            body.append([run, *own, *cells, f"{median(shares):.2f}" if shares else ""])
    titles = [f"{scene}, {views}" for scene, views in TRAINING_VIEWS.items()]
    return grid(["", "the paper: bonsai", "its protocol: bonsai", *titles, "splats"], body)


def _cell(found: dict[str, dict[str, Runs]], run: str, scene: str) -> str:
    """Bold if the most decibels that are gained on the capture."""
    ours, base = found[run][scene], found[BASE][scene]
    if not ours or not base:
        return "-"
    if run == BASE:
        return f"{fmean(one['psnr'] for one in ours):.2f}/{fmean(one['ssim'] for one in ours):.3f}"
    gains = [_gain(runs[scene], base, "psnr") for name, runs in found.items() if name != BASE and runs[scene]]
    gain = _gain(ours, base, "psnr")
    return bold(f"{signed(gain, 2)}/{signed(1000 * _gain(ours, base, 'ssim'), 0)}", gain == max(gains) > 0)


def _of_the_paper(run: str) -> str:
    return "{:+.2f} ({:.2f})".format(*OF_THE_PAPER[run]) if run in OF_THE_PAPER else ""


def _protocol(run: str) -> str:
    """What a method gains in the paper's protocol, and its share of 3DGS's splats."""
    rows = bench_rows("paper")
    ours, base = (rows.get(("bonsai", "original", name)) for name in (run, BASE))
    if not ours:
        return "-"
    share = mean_of(ours, "splats") / mean_of(base, "splats")
    return f"{signed(mean_of(ours, 'PSNR') - mean_of(base, 'PSNR'), 2)} ({share:.2f})"


def ahead(group: str, run: str, base: str, what: str) -> str:
    """On how many captures a run is ahead of another: in "PSNR", in "SSIM", or in the median test "view"."""
    gains = []
    for scene in TRAINING_VIEWS:
        ours, theirs = _runs(group, scene, run), _runs(group, scene, base)
        if ours and theirs:
            gains.append(median(view_gains(ours, theirs)) if what == "view" else _gain(ours, theirs, what.lower()))
    return f"{sum(gain > 0 for gain in gains)} of {len(gains)}"


def views_ahead(scene: str, run: str, base: str) -> str:
    """By how much a run is above another in the median test view under 3DGS's rules, and in how many views."""
    return _views(_runs(RULES, scene, run), _runs(RULES, scene, base))


def _views(ours: Runs, theirs: Runs) -> str:
    gains = view_gains(ours, theirs)
    return f"{signed(median(gains))} dB ({sum(gain > 0 for gain in gains)} of {len(gains)})"


# Full size, 30,000 steps, two seeds.


def gains(scene: str, rule: str) -> str:
    """What the methods gain over 3DGS on a capture."""
    rows = bench_rows("comparison")
    base = mean_of(rows[scene, rule, BASE], "PSNR")
    methods = "VDGS", "GSNB", "SG", "NRF-GS"
    return ", ".join(f"{run} {signed(mean_of(rows[scene, rule, run], 'PSNR') - base, 2)}" for run in methods)


def short_of(scene: str) -> str:
    """What the paper's field gains with 150,000 splats in 10,000 steps, in the median test view and in how many."""
    rows = bench_rows("comparison", "short")
    return _views(*(trials_of(rows[scene, "mcmc@150000", run]) for run in ("NRF-GS", BASE)))


PARTS = {
    "the opacity residual": ("no_opacity", 0.35),
    "distance": ("no_distance", 0.21),
    "the split": ("no_split", 0.48),
}
"""Part of the field -> the run without, and what the paper says that the part gains, in dB."""


def parts() -> str:
    """What the field gains by each of its parts, on bonsai and goldcape under 3DGS's rules."""
    rows, told = bench_rows("comparison"), []
    for part, (without, paper) in PARTS.items():
        pairs = [[rows[scene, "original", run] for run in ("NRF-GS", without)] for scene in ("bonsai", "goldcape")]
        gained = " and ".join(signed(mean_of(one, "PSNR") - mean_of(other, "PSNR"), 2) for one, other in pairs)
        told.append(f"{part} {gained} ({paper:+.2f})")
    return ", ".join(told)


def ratio(scene: str, run: str, base: str) -> str:
    """Splats of a run over another's, under 3DGS's rules."""
    rows = bench_rows("comparison")
    return f"{mean_of(rows[scene, 'original', run], 'splats') / mean_of(rows[scene, 'original', base], 'splats'):.2f}"


def view(scene: str, rule: str, run: str, image: str) -> str:
    """PSNR of one test view, seed by seed."""
    found = [
        next(one["psnr"] for one in record["measured"]["test"]["per_image"] if image in one["image"])
        for _, record in sorted(bench_rows("comparison")[scene, rule, run].records.items())
    ]
    return " and ".join(f"{psnr:.1f}" for psnr in found)


def stored_opacity(splats: str) -> str:
    """PSNR of the field on bonsai where all of MCMC's rules and its loss go by the stored opacity, and GSNB's."""
    record = records("comparison")[f"stored-opacity/NRF-GS-mcmc@{splats}-bonsai-42"]
    other = bench_rows("comparison")["bonsai", f"mcmc@{splats}", "GSNB"]
    return f"{record['measured']['test']['psnr']:.1f} against GSNB's {mean_of(other, 'PSNR'):.1f} dB"


# How the heads' settings were chosen.

TRIALS = {"third": "a third of its rate", "triple": "three times its rate", "shrinkage": "shrinkage"}
HEADS = {"SH": "3DGS", "VDGS": "VDGS", "GSNB": "GSNB", "SG": "SG", "NRF": "NRF-GS"}
"""Head, as heads.yaml calls it -> its run."""


def chosen() -> str:
    """Each head's setting of four, and what it gains over its own in the median held-out view, mean over captures."""
    best = {head: best_trial(head) for head in HEADS}
    told = [
        f"{HEADS[head]} {TRIALS[trial]} ({signed(fmean(trial_gains(head, trial).values()), 2)} dB)"
        for head, trial in best.items()
        if trial
    ]
    *first, last = [HEADS[head] for head, trial in best.items() if not trial]
    return ", ".join([*told, f"{', '.join(first)} and {last} their own"])


def best_trial(head: str) -> str:
    """The trial that gains most in the mean over captures; empty: the head's own setting."""
    gains = {trial: list(trial_gains(head, trial).values()) for trial in TRIALS}
    best = max(TRIALS, key=lambda trial: fmean(gains[trial]) if gains[trial] else 0.0)
    return best if gains[best] and fmean(gains[best]) > 0 else ""


def trial_gains(head: str, trial: str) -> dict[str, float]:
    """Capture -> decibels over the head's own setting in the median held-out view."""
    rows = bench_rows("heads")
    found = {}
    for scene in TRAINING_VIEWS:
        pair = [rows.get((scene, "original", name)) for name in (f"{head}_{trial}", head)]
        if all(pair):
            found[scene] = median(view_gains(*map(trials_of, pair)))
    return found
