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
    "**twice the residual, on the logit**: `nrfgs`": "twice on the logit",
    "residual on the logit": "on the logit",
    "four times the residual, on the logit": "four times on the logit",
    "dead by the stored opacity": "dead by the stored opacity",
    "on the logit, dead by the stored opacity": "on the logit, dead by the stored opacity",
    "harmonics, same rules": "harmonics",
    "harmonics of degree 1": "harmonics, degree 1",
    "field without opacity residual": "no opacity residual",
    "field, rates a tenth (latents), a fifth (network)": "slow field",
    "field, one band": "one band",
    "field without distance": "no distance",
}
"""Label -> trial with gaps in results/default.json; its default added the residual to the opacity."""
HALF_SIZE = {
    "**twice the residual, on the logit**": "twice on the logit",
    "**and a threshold of 0.0018**: `nrfgs` on `bonsai`": "twice on the logit, threshold 0.0018",
    "four times the residual, on the logit": "four times on the logit",
    "residual on the logit": "on the logit",
    "residual on the logit, threshold 0.0018": "on the logit, threshold 0.0018",
    "dead by the stored opacity": "dead by the stored opacity",
    "harmonics, same rules": "harmonics",
}
"""Label -> trial with every eighth training view held out, against the same default."""
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
BASE = "splatfacto's rules"
"""The trial that `RULES` are compared with."""


def default() -> str:
    """More of the same: each seed, other metrics, the worst view, splats."""
    body = []
    for scene, views in VIEWS.items():
        for label, runs in (("field", today(scene, FIELD)), ("harmonics", today(scene, SAME))):
            seeds = ", ".join(f"{one['psnr']:.2f}" for one in runs)
            means = [
                f"{mean(runs, metric):.3f}" if all(metric in one for one in runs) else "-"
                for metric in ("ssim", "ms_ssim", "flip")
            ]
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


def rules() -> str:
    """Gains of trials over splatfacto's rules on the held-out views that both have, and their share of its splats."""
    body, theirs, base = [], views_of("default", BASE), _splats(BASE)
    for label, trial in RULES.items():
        ours, cells, splats = views_of("default", trial), [], _splats(trial)
        for scene in FEW:
            pairs = [(ours[view], theirs[view]) for view in theirs if view in ours and view[0] == scene]
            psnr, ssim = ([one[number] - other[number] for one, other in pairs] for number in (0, 1))
            cells.append(f"{signed(median(psnr), 2)}/{signed(1000 * fmean(ssim), 0)}" if pairs else "")
        share = median(splats[scene] / base[scene] for scene in splats.keys() & base.keys())
        body.append([label, *cells, f"{share:.1f}"])
    return grid(["", *FEW, "splats"], body)


def _splats(trial: str) -> dict[str, float]:
    """Mean number of splats of a trial's trainings, by scene."""
    splats = defaultdict(list)
    for one in records("default").values():
        if one["name"] == trial:
            splats[one["scene"]].append(one["splats"])
    return {scene: fmean(counts) for scene, counts in splats.items()}


def _changes(sitting: str, trial: str) -> dict[str, tuple[float, float, float, int]]:
    """Changes by a trial of a sitting, against its default with the same seeds, by capture: PSNR and SSIM, the share of
    the default's splats, and the number of pairs."""
    runs = {(one["name"], one["scene"], one.get("seed")): one for one in records("default").values()}
    pairs = defaultdict(list)
    for (name, scene, seed), one in runs.items():
        base = runs.get((f"{sitting}: default", scene, seed))
        if name == f"{sitting}: {trial}" and base:
            change = *(one[metric] - base[metric] for metric in ("psnr", "ssim")), one["splats"] / base["splats"]
            pairs[scene.rpartition("/")[2]].append(change)
    return {scene: (*map(fmean, zip(*them, strict=True)), len(them)) for scene, them in pairs.items()}


def changes(trials: dict[str, str], sitting: str) -> str:
    """Changes by trials on each capture: dB/SSIM x 1000, share of splats, and pairs of trainings."""
    rows = {label: _changes(sitting, trial) for label, trial in trials.items()}
    captures = [scene for scene in VIEWS if any(scene in row for row in rows.values())]
    body = []
    for label, row in rows.items():
        cells = []
        for dB, ssim, share, number in (row.get(scene, (None,) * 4) for scene in captures):
            cells.append(f"{signed(dB, 2)}/{signed(1000 * ssim, 0)}, x{share:.1f} ({number})" if number else "-")
        body.append([label, *cells])
    return grid(["", *captures], body)


def logit() -> str:
    """Mean change by today's opacity residual on held-out views, with few and with all training views."""
    texts = []
    for sitting, where in (("gaps", "with 13 to 24 training views"), ("half size", "with 37 to 223")):
        changed = _changes(sitting, "twice on the logit").values()
        dB, ssim, share = (fmean(one[number] for one in changed) for number in range(3))
        numbers = f"{signed(dB, 2)} dB and {signed(ssim, 3)} SSIM with {share:.1f} of the splats"
        texts.append(f"{numbers} in the mean of {len(changed)} captures {where}")
    return ", and ".join(texts)


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
    "tables.rules": rules,
    "captures.logit": logit,
    "tables.gaps": lambda: changes(GAPS, "gaps"),
    "tables.half_size": lambda: changes(HALF_SIZE, "half size"),
    "tables.scale": scale,
}
