# SPDX-License-Identifier: Apache-2.0
"""Blocks of docs/tables.md: what the sentences of other pages rest on."""

from collections import defaultdict
from statistics import fmean, median

from nrfgs_lab.pages.few_views import FEW, FIELD, SAME, SHRUNK, cell, runs_of, today, views_of
from nrfgs_lab.pages.runs import VIEWS, grid, mean, records, signed
from nrfgs_lab.pages.speed import RENDERERS, scale_cells

RIVALS = {
    "`nrfgs` with splatfacto's densification": "nrfgs",
    "harmonics, the same": SHRUNK,
    "field, MCMC": "nrfgs, 150,000 splats",
    "harmonics, MCMC": "harmonics, 150,000 splats",
}
"""Label -> trainings in results/captures.json."""
GAPS = {
    "harmonics, same rules": "harmonics",
    "field without opacity residual": "no opacity residual",
    "field, rates a tenth (latents), a fifth (network)": "slow field",
    "field, one band": "one band",
    "field without distance": "no distance",
}
"""Label -> trial with gaps in results/default.json."""
RULES = {
    "**by error, points from photographs, near plane**": "by error, dense start, near plane",
    "without the near plane": "by error, dense start",
    "without points from photographs": "by error, near plane",
    "near plane at 0.8 instead of 0.5": "default: near plane 0.8",
    "threshold 0.004 instead of 0.0025": "default: threshold 0.004",
    "dead below 0.05 instead of 0.1": "default: dead below 0.05",
    "u = 1": "default: u = 1",
    "weight of SSIM 0.3 instead of 0.2": "default: SSIM 0.3",
    "3DGS's rules, points from photographs, near plane": "3DGS's rules, dense start, near plane",
    "splatfacto's rules, near plane": "splatfacto's rules, near plane",
    "splatfacto's rules, points from photographs": "splatfacto's rules, dense start",
}
"""Label -> trial in results/default.json."""


def default() -> str:
    """More of the same: each seed, other metrics, the worst view, splats."""
    body = []
    for scene, views in VIEWS.items():
        for label, runs in (("field", today(scene, FIELD)), ("harmonics", today(scene, SAME))):
            seeds = ", ".join(f"{one['psnr']:.2f}" for one in runs)
            means = [f"{mean(runs, metric):.3f}" for metric in ("ssim", "ms_ssim", "flip")]
            middle = fmean(median(view[1] for view in one["per_image"]) for one in runs)
            worst = min(view[1] for one in runs for view in one["per_image"])
            gap = mean(runs, "train_psnr") - mean(runs, "psnr")
            numbers = f"{middle:.1f}", f"{worst:.1f}", f"{gap:.1f}", f"{mean(runs, 'splats') / 1000:.0f}k"
            body.append([f"{scene}, {views}", label, seeds, *means, *numbers])
    head = "PSNR of each seed", "SSIM", "MS-SSIM", "FLIP", "median view", "worst view", "gap", "splats"
    return grid(["capture", "", *head], body)


def rivals() -> str:
    """Today's default beside splatfacto's densification and 150,000 splats by 3DGS-MCMC, on test views."""
    body = [
        [f"{scene}, {views}", cell(today(scene, FIELD)), *(cell(runs_of(scene, name)) for name in RIVALS.values())]
        for scene, views in VIEWS.items()
    ]
    return grid(["capture, training views", "`nrfgs`", *RIVALS], body)


def _held_out_gain(ours: dict, theirs: dict, views: list) -> str:
    """Median dB, mean SSIM x 1000."""
    if not views:
        return ""
    psnr, ssim = ([ours[view][number] - theirs[view][number] for view in views] for number in (0, 1))
    return f"{signed(median(psnr), 2)}/{signed(1000 * fmean(ssim), 0)}"


def gains_of(study: str, rows: dict[str, tuple[str, str]]) -> str:
    """Gains of trials over others on the held-out views that both have, and their share of the others' splats."""
    body = []
    for label, trials in rows.items():
        ours, theirs = (views_of(study, trial) for trial in trials)
        cells = [_held_out_gain(ours, theirs, [v for v in theirs if v in ours and v[0] == scene]) for scene in FEW]
        splats = [defaultdict(list), defaultdict(list)]
        for one in records(study).values():
            for number, trial in enumerate(trials):
                if one["name"] == trial:
                    splats[number][one["scene"]].append(one["splats"])
        shares = [fmean(splats[0][scene]) / fmean(splats[1][scene]) for scene in splats[0].keys() & splats[1].keys()]
        body.append([label, *cells, f"{median(shares):.1f}"])
    return grid(["", *FEW, "splats"], body)


def gaps() -> str:
    """Changes of PSNR and SSIM by trials with gaps between training views, against the default."""
    runs = {capture: {} for capture in VIEWS}
    for one in records("default").values():
        if one["name"].startswith("gaps: "):
            where, _, capture = one["scene"].rpartition("/")
            runs[capture][one["name"][6:], where] = one
    body = []
    for label, trial in GAPS.items():
        cells = []
        for mine in runs.values():
            pairs = [(one, mine["default", where]) for (name, where), one in mine.items() if name == trial]
            gains = [
                a[1] - b[1] for one, base in pairs for a, b in zip(one["per_image"], base["per_image"], strict=True)
            ]
            dB, ssim = (fmean(one[metric] - base[metric] for one, base in pairs) for metric in ("psnr", "ssim"))
            cells.append(f"{signed(dB, 2)}/{signed(1000 * ssim, 0)} ({sum(one > 0 for one in gains)}/{len(gains)})")
        body.append([label, *cells])
    return grid(["", *runs], body)


def scale(column: str, factor: str, form: str) -> str:
    """A quantity of training steps after growth, medians of repeats."""
    body = []
    for (count, pixels), cells in scale_cells(column).items():
        values = (format(median(cells[one]) * float(factor), form) for one in RENDERERS)
        body.append([f"{count / 1e6:g}M, {pixels:g} MP", *values])
    return grid(["splats, image", *RENDERERS.values()], body)


BLOCKS = {
    "tables.default": default,
    "tables.rivals": rivals,
    "tables.rules": lambda: gains_of("default", {label: (one, "splatfacto's rules") for label, one in RULES.items()}),
    "tables.gaps": gaps,
    "tables.scale": scale,
}
