# SPDX-License-Identifier: Apache-2.0
"""The numbers of docs/comparison.md."""

from statistics import fmean, median
from typing import Any

from nrfgs_lab.pages.tables import bench_rows, bold, grid, mean_of, records, signed
from nrfgs_lab.pages.tables.readme import TRAINING_VIEWS, trials_of, view_gains

Runs = list[dict[str, Any]]
"""Trainings of one setting, by seed, as results/captures.json has them."""

# Every capture at half its size, in 10,000 steps.

BASE = "3DGS"
METHODS = "VDGS", "GSNB", "SG", "NRF-GS", "ours"
OF_THE_PAPER = {"VDGS": (0.49, 1.286), "GSNB": (0.96, 1.175), "NRF-GS": (1.01, 0.456)}
"""The paper's gains on bonsai, in dB, and splats in multiples of 3DGS's."""
ORIGINAL = "original"
"""3DGS's rules for how splats come and go: docs/bench/methods.yaml. All others are budgets.yaml's."""
BUDGETS = "mcmc@150000", "mcmc@75000"


def half(scene: str, run: str, rule: str = ORIGINAL) -> Runs:
    """A run of docs/bench/methods.yaml, or of budgets.yaml."""
    row = bench_rows("methods" if rule == ORIGINAL else "budgets").get((scene, rule, run))
    return trials_of(row) if row else []


def gain(ours: Runs, theirs: Runs, metric: str) -> float:
    """A metric above another setting's, in the mean over views and seeds."""
    return fmean(one[metric] for one in ours) - fmean(one[metric] for one in theirs)


def every() -> str:
    """3DGS's PSNR and SSIM, and what the others gain, dB and SSIM x 1000; the median share of its splats."""
    psnr = f"{mean_of(bench_rows('paper')['bonsai', 'original', BASE], 'PSNR'):.2f}"
    body = [[BASE, "", psnr, *_levels(), "", ""]]
    for run in METHODS:
        paper = "{:+.2f} ({:.2f})".format(*OF_THE_PAPER[run]) if run in OF_THE_PAPER else ""
        ours, base = ([_splats(half(scene, one)) for scene in TRAINING_VIEWS] for one in (run, BASE))
        share = median(one / other for one, other in zip(ours, base, strict=True))
        body.append([run, paper, _protocol(run), *_gains(run), f"{share:.2f}", _ahead(run)])
    return grid(["", "paper", "protocol", *TRAINING_VIEWS, "splats", "ahead"], body)


def equal() -> str:
    """3DGS's PSNR with 150,000 and 75,000 splats, and what the others gain."""
    levels = zip(*([level.partition("/")[0] for level in _levels(rule)] for rule in BUDGETS), strict=True)
    body = [[BASE, *map(", ".join, levels), ""]]
    for run in METHODS:
        gains = zip(*(_gains(run, rule, ssim=False) for rule in BUDGETS), strict=True)
        body.append([run, *map(", ".join, gains), ", ".join(_ahead(run, rule) for rule in BUDGETS)])
    return grid(["150,000, 75,000 splats", *TRAINING_VIEWS, "ahead"], body)


def seeds(run: str, scene: str) -> str:
    """Decibels between a run's best and worst seed under 3DGS's rules."""
    found = [one["psnr"] for one in half(scene, run)]
    return f"{max(found) - min(found):.1f}"


def _levels(rule: str = ORIGINAL) -> list[str]:
    every = [half(scene, BASE, rule) for scene in TRAINING_VIEWS]
    return [f"{fmean(one['psnr'] for one in runs):.2f}/{fmean(one['ssim'] for one in runs):.3f}" for runs in every]


def _gains(run: str, rule: str = ORIGINAL, ssim: bool = True) -> list[str]:
    """A cell for each capture, bold if the most decibels that are gained on it."""
    cells = []
    for scene in TRAINING_VIEWS:
        base = half(scene, BASE, rule)
        gains = {one: gain(half(scene, one, rule), base, "psnr") for one in METHODS}
        text = signed(gains[run], 2)
        if ssim:
            text += f"/{signed(1000 * gain(half(scene, run, rule), base, 'ssim'), 0)}"
        cells.append(bold(text, gains[run] == max(gains.values()) > 0))
    return cells


def _splats(runs: Runs) -> float:
    return fmean(one["splats"] for one in runs)


def _protocol(run: str) -> str:
    """What a method gains in the paper's protocol, and its share of 3DGS's splats; VDGS as its authors have it."""
    rows = bench_rows("paper")
    name = "VDGS_no_resets" if run == "VDGS" else run
    ours, base = (rows.get(("bonsai", ORIGINAL, name)) for name in (name, BASE))
    if not ours:
        return ""
    share = mean_of(ours, "splats") / mean_of(base, "splats")
    return f"{signed(mean_of(ours, 'PSNR') - mean_of(base, 'PSNR'), 2)} ({share:.2f})"


def _ahead(run: str, rule: str = ORIGINAL) -> str:
    """On how many captures a run is above 3DGS: in PSNR, in SSIM, in PSNR in the median test view."""
    pairs = [(half(scene, run, rule), half(scene, BASE, rule)) for scene in TRAINING_VIEWS]
    measured = [(gain(*pair, "psnr"), gain(*pair, "ssim"), median(view_gains(*pair))) for pair in pairs]
    counts = [sum(round(gain, 3) > 0 for gain in gains) for gains in zip(*measured, strict=True)]
    return "/".join(map(str, counts))


# Full size, 30,000 steps, two seeds.


def gains(rule: str) -> str:
    """What the methods gain over 3DGS on each capture."""
    rows, told = bench_rows("comparison"), []
    for scene in "bonsai", "goldcape":
        base = mean_of(rows[scene, rule, BASE], "PSNR")
        found = [f"{run} {signed(mean_of(rows[scene, rule, run], 'PSNR') - base, 2)}" for run in METHODS[:-1]]
        told.append(f"`{scene}` {', '.join(found)}")
    return "; ".join(told)


def stored_opacity() -> str:
    """PSNR of the field and GSNB on bonsai with 150,000 splats, where MCMC goes by the stored opacity."""
    field = records("comparison")["stored-opacity/NRF-GS-mcmc@150000-bonsai-42"]["measured"]["test"]["psnr"]
    other = mean_of(bench_rows("comparison")["bonsai", "mcmc@150000", "GSNB"], "PSNR")
    return f"NRF-GS {field:.1f} dB, GSNB {other:.1f}"


PARTS = {
    "opacity residual": ("no_opacity", 0.35),
    "distance": ("no_distance", 0.21),
    "split": ("no_split", 0.48),
}
"""Part of the field -> the run without, and what the paper says that the part gains, in dB."""


def parts() -> str:
    """What the field gains by each of its parts, on bonsai and goldcape under 3DGS's rules."""
    rows, told = bench_rows("comparison"), []
    for part, (without, paper) in PARTS.items():
        pairs = [[rows[scene, "original", run] for run in ("NRF-GS", without)] for scene in ("bonsai", "goldcape")]
        gained = ", ".join(signed(mean_of(one, "PSNR") - mean_of(other, "PSNR"), 2) for one, other in pairs)
        told.append(f"{part} {gained} ({paper:+.2f})")
    return "; ".join(told)


def over_gsnb() -> str:
    """What the field gains over GSNB in the median held-out view of bonsai: at the host's rates, and at GSNB's own."""
    rows = bench_rows("deviations")
    field, *others = (trials_of(rows["bonsai", ORIGINAL, run]) for run in ("NRF", "GSNB", "GSNB_rates"))
    return "{:.2f} to {:.2f} dB".format(*(median(view_gains(field, other)) for other in others))


# How the heads' settings were chosen.

TRIALS = {"third": "a third of its rate", "triple": "three times its rate", "shrinkage": "shrinkage"}
HEADS = {"SH": "3DGS", "VDGS": "VDGS", "GSNB": "GSNB", "SG": "SG", "NRF": "NRF-GS"}
"""Head, as heads.yaml calls it -> its run."""


def chosen() -> str:
    """Which heads' settings are not their own, and the gain in the median held-out view, mean over captures."""
    best = {head: best_trial(head) for head in HEADS}
    told = [
        f"{HEADS[head]} {TRIALS[trial]} ({signed(fmean(trial_gains(head, trial).values()), 2)} dB)"
        for head, trial in best.items()
        if trial
    ]
    return ", ".join(told)


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
