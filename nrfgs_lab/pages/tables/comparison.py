# SPDX-License-Identifier: Apache-2.0
"""The numbers of docs/comparison.md."""

from collections import defaultdict
from statistics import fmean, geometric_mean, median

from nrfgs_lab.bench.table import Row
from nrfgs_lab.pages.tables import bench_rows, bold, grid, mean_of, records, signed
from nrfgs_lab.pages.tables.readme import TRAINING_VIEWS

# Every capture.

RULES = {"original": ("methods", "3DGS's rules"), "mcmc@150000": ("budgets", "150,000 splats")}
"""Densification -> the study that has it, and what a table calls it."""
METHODS = {
    **{"VDGS": "VDGS", "VDGS_base": "VDGS, `base`", "GSNB": "GSNB", "SG": "SG"},
    **{"NRF-GS": "NRF-GS", "NRF-GS_base": "NRF-GS, `base`", "ours": "ours"},
}
"""Run -> what a table calls it."""
BASE = "3DGS"


def every() -> str:
    """3DGS's PSNR on each capture and what the others gain; gains in SSIM, and shares of its splats, in the mean over
    the captures that all methods of a group have."""
    head = ["", *(f"{scene}, {views}" for scene, views in TRAINING_VIEWS.items()), "SSIM", "splats"]
    body = []
    for rule, (_, title) in RULES.items():
        runs = [run for run in METHODS if any(psnr_gains(rule, run))]
        if not runs:
            continue
        gains = {run: psnr_gains(rule, run) for run in runs}
        shared = [scene for scene in TRAINING_VIEWS if all(scene in gains[run] for run in runs)]
        best = {scene: max(round(gains[run].get(scene, -9.0), 1) for run in runs) for scene in TRAINING_VIEWS}
        plain = _means(rule, BASE)
        psnr = [f"{plain[scene]['PSNR']:.1f}" if scene in plain else "-" for scene in TRAINING_VIEWS]
        ssim = f"{fmean(plain[scene]['SSIM'] for scene in shared):.3f}"
        count = f"{fmean(plain[scene]['splats'] for scene in shared) / 1000:.0f}k"
        body.append([f"**{title}**: 3DGS", *psnr, ssim, count])
        for run in runs:
            cells = [
                bold(signed(gains[run][scene]), round(gains[run][scene], 1) == best[scene] > 0)
                if scene in gains[run]
                else "-"
                for scene in TRAINING_VIEWS
            ]
            cells.append(signed(fmean(_difference(rule, run, scene, "SSIM") for scene in shared), 3))
            cells.append(f"{geometric_mean(_share(rule, run, scene) for scene in shared):.2f}")
            body.append([METHODS[run], *cells])
    return grid(head, body)


def _row(rule: str, run: str, scene: str) -> Row | None:
    return bench_rows(RULES[rule][0]).get((scene, rule, run))


def _means(rule: str, run: str) -> dict[str, dict[str, float]]:
    """Capture -> metric -> mean over seeds."""
    rows = {scene: _row(rule, run, scene) for scene in TRAINING_VIEWS}
    return {
        scene: {metric: mean_of(row, metric) for metric in ("PSNR", "SSIM", "splats")}
        for scene, row in rows.items()
        if row is not None
    }


def _difference(rule: str, run: str, scene: str, metric: str, base: str = BASE) -> float:
    """A metric above another run's, in the mean over the seeds that both have."""
    values = [_row(rule, name, scene).values[metric] for name in (run, base)]
    seeds = values[0].keys() & values[1].keys()
    return fmean(values[0][seed] - values[1][seed] for seed in seeds)


def _share(rule: str, run: str, scene: str) -> float:
    return mean_of(_row(rule, run, scene), "splats") / mean_of(_row(rule, BASE, scene), "splats")


def psnr_gains(rule: str, run: str, base: str = BASE) -> dict[str, float]:
    """Capture -> decibels above another run, in the mean over the seeds that both have."""
    return {
        scene: _difference(rule, run, scene, "PSNR", base)
        for scene in TRAINING_VIEWS
        if _row(rule, run, scene) and _row(rule, base, scene)
    }


def ahead(rule: str, run: str, base: str) -> str:
    """On how many captures a run is above another in its median test view, and by how much in the median capture."""
    rows = [(_row(rule, run, scene), _row(rule, base, scene)) for scene in TRAINING_VIEWS]
    gains = [median(view_gains(*pair)) for pair in rows if all(pair)]
    return f"{sum(gain > 0 for gain in gains)} of {len(gains)} ({signed(median(gains), 2)} dB)"


def view_gains(row: Row, base: Row) -> list[float]:
    """Decibels by which a row is above another in each test view, in the mean of the seeds that both have."""
    gains = defaultdict(list)
    for seed in row.records.keys() & base.records.keys():
        views = [
            {v["image"]: v["psnr"] for v in one.records[seed]["measured"]["test"]["per_image"]} for one in (row, base)
        ]
        for image, psnr in views[0].items():
            gains[image].append(psnr - views[1][image])
    return list(map(fmean, gains.values()))


# Claim by claim: captures at full size, 30,000 steps.

CLAIMS = {
    "over 3DGS (+1.01)": "3DGS",
    "over GSNB (+0.05)": "GSNB",
    "over VDGS (+0.52)": "VDGS",
    "over VDGS without resets": "VDGS_no_resets",
    "opacity residual (+0.35)": "no_opacity",
    "distance (+0.21)": "no_distance",
    "split (+0.48)": "no_split",
}
"""What the paper says the field gains, in dB -> the run without."""
PLACES = {
    "bonsai: paper's protocol": ("paper", "bonsai", "original"),
    "host's": ("comparison", "bonsai", "original"),
    "150k splats": ("comparison", "bonsai", "mcmc@150000"),
    "goldcape: host's": ("comparison", "goldcape", "original"),
    "150k splats ": ("comparison", "goldcape", "mcmc@150000"),
}
"""Column -> study, capture and densification."""


def claims() -> str:
    """What the field gains over each method and without each of its parts."""
    rows = {
        title: {run: bench_rows(study).get((*place, run)) for run in ("NRF-GS", *CLAIMS.values())}
        for title, (study, *place) in PLACES.items()
    }
    counts = [f"{mean_of(one['NRF-GS'], 'splats') / mean_of(one['3DGS'], 'splats'):.2f}" for one in rows.values()]
    body = [["splats / 3DGS's (0.46)", *counts]]
    for claim, base in CLAIMS.items():
        pairs = [(one["NRF-GS"], one[base]) for one in rows.values()]
        cells = [signed(mean_of(a, "PSNR") - mean_of(b, "PSNR"), 2) if b else "-" for a, b in pairs]
        if any(cell != "-" for cell in cells):
            body.append([claim, *cells])
    return grid(["the paper", *map(str.strip, PLACES)], body)


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
            found[scene] = median(view_gains(*pair))
    return found
