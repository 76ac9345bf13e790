# SPDX-License-Identifier: Apache-2.0
"""The numbers of docs/comparison.md."""

from collections import defaultdict
from statistics import fmean, median

from nrfgs_lab.bench.table import Row
from nrfgs_lab.pages.tables import bench_rows, bold, grid, mean_of, records, signed
from nrfgs_lab.pages.tables.readme import TRAINING_VIEWS

# Every capture.

GROUPS = {
    "3DGS's rules": {
        "bonsai, its protocol": ("paper", "bonsai", "original"),
        "bonsai": ("comparison", "bonsai", "original"),
        "goldcape": ("comparison", "goldcape", "original"),
        **{scene: ("methods", scene, "original") for scene in ("caliterra", "fox", "castle", "fern")},
    },
    "150,000 splats": {
        "bonsai": ("comparison", "bonsai", "mcmc@150000"),
        "goldcape": ("comparison", "goldcape", "mcmc@150000"),
        "fox": ("budgets", "fox", "mcmc@150000"),
    },
}
"""Group -> column -> study, capture and densification."""
METHODS = "VDGS", "GSNB", "SG", "NRF-GS", "ours"
BASE = "3DGS"
OF_THE_PAPER = {"VDGS": "+0.49 (1.29)", "GSNB": "+0.96 (1.18)", "NRF-GS": "+1.01 (0.46)"}
"""The paper's gains on bonsai, and splats in multiples of 3DGS's."""


def every() -> str:
    """3DGS's PSNR on each capture and what the others gain; gain in SSIM and share of its splats in the median of the
    columns that all methods of a group have."""
    columns = list(next(iter(GROUPS.values())))
    body = []
    for group, places in GROUPS.items():
        rows = {run: {title: _row(place, run) for title, place in places.items()} for run in (BASE, *METHODS)}
        rows = {run: found for run, found in rows.items() if any(found.values())}
        shared = [title for title in places if all(found[title] for found in rows.values())]
        for run, found in rows.items():
            cells = [_cell(run, title, rows) for title in columns]
            ssim = median(_gain(found[title], rows[BASE][title] if run != BASE else None, "SSIM") for title in shared)
            splats = median(mean_of(found[title], "splats") / mean_of(rows[BASE][title], "splats") for title in shared)
            more = [f"{ssim:.3f}", ""] if run == BASE else [signed(ssim, 3), f"{splats:.2f}"]
            told = OF_THE_PAPER.get(run, "") if places is GROUPS["3DGS's rules"] else ""
            body.append([f"**{group}**: {BASE}" if run == BASE else run, told, *cells, *more])
    titles = [f"{title}, {TRAINING_VIEWS[title]}" if title in TRAINING_VIEWS else title for title in columns]
    return grid(["", "the paper, bonsai", *titles, "SSIM", "splats"], body)


def _row(place: tuple[str, str, str], run: str) -> Row | None:
    return bench_rows(place[0]).get((*place[1:], run))


def _cell(run: str, title: str, rows: dict[str, dict[str, Row | None]]) -> str:
    """A number of decibels, bold if the most that is gained in its column."""
    row, base = rows[run].get(title), rows[BASE].get(title)
    if row is None or base is None:
        return "-"
    if row is base:
        return f"{mean_of(row, 'PSNR'):.2f}"
    gains = [_gain(found[title], base, "PSNR") for found in rows.values() if found[title] not in (None, base)]
    gain = _gain(row, base, "PSNR")
    return bold(signed(gain, 2), gain == max(gains) > 0)


def _gain(row: Row, base: Row | None, metric: str) -> float:
    """A metric above another row's, in the mean over seeds; the metric itself without another."""
    return mean_of(row, metric) - (mean_of(base, metric) if base else 0.0)


def views_ahead(group: str, title: str, run: str, base: str) -> str:
    """By how much a run is above another in the median test view, and in how many views."""
    place = GROUPS[group][title]
    gains = view_gains(_row(place, run), _row(place, base))
    return f"{signed(median(gains))} dB ({sum(gain > 0 for gain in gains)} of {len(gains)})"


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


# What the field's parts are worth: captures at full size, 30,000 steps.

PARTS = {
    "opacity residual (+0.35)": "no_opacity",
    "distance (+0.21)": "no_distance",
    "split (+0.48)": "no_split",
}
"""What the paper says a part gains, in dB -> the run without."""


def parts() -> str:
    """What the field gains by each of its parts."""
    rows = bench_rows("comparison")
    places = [(scene, rule) for scene in ("bonsai", "goldcape") for rule in ("original", "mcmc@150000")]
    body = []
    for part, without in PARTS.items():
        pairs = [(rows[(*place, "NRF-GS")], rows[(*place, without)]) for place in places]
        body.append([part, *(signed(mean_of(a, "PSNR") - mean_of(b, "PSNR"), 2) for a, b in pairs)])
    titles = [scene if rule == "original" else "150,000 splats" for scene, rule in places]
    return grid(["the paper", *titles], body)


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
