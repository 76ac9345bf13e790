# SPDX-License-Identifier: Apache-2.0
"""Blocks of docs/tables.md: what the sentences of other pages rest on."""

from collections import defaultdict
from collections.abc import Iterator
from statistics import fmean, median, stdev

from nrfgs_lab.bench.spec import OWN
from nrfgs_lab.pages.few_views import FIELD, SAME, alone, today
from nrfgs_lab.pages.runs import ORIGINAL, VIEWS, Trainings, grid, mean, records, signed
from nrfgs_lab.pages.speed import RENDERERS, scale_cells

RIVALS = {"3DGS's": ORIGINAL, "splatfacto's": "splatfacto", "MCMC's, 150,000 splats": "mcmc@150000_refine_every_50"}
"""Label -> strategy in results/default.json."""
BETWEEN = "linear basis", "field without opacity residual", "linear basis with opacity residual", "field"
RATES = {"harmonics, 4 times the rate": "4 times the rate", "16 times, decaying": "16 times the rate, decaying to one"}
HEADS = {label: [("rates: default", f"rates: {trial}")] for label, trial in (RATES | {n: n for n in BETWEEN}).items()}
HEADS["field"] += [(f"{plan} of harmonics: default", f"{plan}: default") for plan in ("geometry", "ridge")]
"""Label -> harmonics and trial, one pair for each seed."""
GAPS = {
    "**twice the residual, on the logit**: `nrfgs`": [("gaps: default", "gaps: twice on the logit")],
    "harmonics without noise": [("gaps: default", "gaps: harmonics")],
}
"""Label -> trials with gaps; their default added the residual to the opacity."""


def default() -> str:
    """The field and harmonics on test views: each seed, other metrics, the worst view, splats."""
    body = []
    for scene in VIEWS:
        both = today(scene, FIELD), today(scene, SAME)
        seeds = [", ".join(f"{one['psnr']:.2f}" for one in runs) for runs in both]
        body.append([scene, *seeds, *map("/".join, zip(*map(_metrics, both), strict=True))])
    head = "SSIM", "FLIP", "median view", "worst view", "splats"
    return grid(["", "PSNR of the field", "of harmonics", *head], body)


def _metrics(runs: Trainings) -> list[str]:
    """Means over trainings, and the worst view of all."""
    flip = "-" if any(one["flip"] is None for one in runs) else f"{mean(runs, 'flip'):.3f}"
    middle = fmean(median(view[1] for view in one["per_image"]) for one in runs)
    worst = min(view[1] for one in runs for view in one["per_image"])
    return [f"{mean(runs, 'ssim'):.3f}", flip, f"{middle:.1f}", f"{worst:.1f}", f"{mean(runs, 'splats') / 1000:.0f}k"]


def rivals() -> str:
    """Each densification without a twin on test views: PSNR (mean, median view) and SSIM; harmonics' mean PSNR."""
    rules, body = (OWN, *RIVALS.values()), []
    for scene in VIEWS:
        field = [(mean(runs, "psnr"), _metrics(runs)) for runs in (alone(scene, FIELD, rule) for rule in rules)]
        harmonics = "/".join(f"{mean(alone(scene, SAME, rule), 'psnr'):.2f}" for rule in rules)
        body.append([scene, *(f"{psnr:.2f}/{cells[2]}/{cells[0]}" for psnr, cells in field), harmonics])
    return grid(["", "`nrfgs`", *RIVALS, "harmonics, these four"], body)


def _changes(sides: list[tuple[str, str]]) -> dict[str, tuple[float, float, float]]:
    """Changes from a default to a trial, same seeds, by capture: PSNR, SSIM, share of splats."""
    runs = {(one["name"], one["scene"], one.get("seed")): one for one in records("trials", "geometry").values()}
    pairs = defaultdict(list)
    for (name, scene, seed), one in runs.items():
        for default, trial in sides:
            base = runs.get((default, scene, seed))
            if name == trial and base:
                change = *(one[metric] - base[metric] for metric in ("psnr", "ssim")), one["splats"] / base["splats"]
                pairs[scene.rpartition("/")[2]].append(change)
    return {scene: tuple(map(fmean, zip(*them, strict=True))) for scene, them in pairs.items()}


def changes(trials: dict[str, list[tuple[str, str]]]) -> str:
    """Changes by trials on each capture, dB/SSIM x 1000, and the median share of splats over captures."""
    body = []
    for label, sides in trials.items():
        row = _changes(sides)
        changed = (row.get(scene) for scene in VIEWS)
        cells = [f"{signed(one[0], 2)}/{signed(1000 * one[1], 0)}" if one else "" for one in changed]
        body.append([label, *cells, f"{median(one[2] for one in row.values()):.1f}"])
    return grid(["", *VIEWS, "splats"], body)


def trial_changes(sitting: str, best: int | None = None, only: str = "") -> str:
    """Mean changes by a sitting's trials, its best ones or one of them, dB with standard errors over splits."""
    runs, changes = records("trials", "geometry"), defaultdict(list)
    for key, one in runs.items():
        at, _, trial = one.get("name", "").partition(": ")
        base = runs.get(key.replace(trial, "default", 1)) if at == sitting else None
        if base and base is not one and only in ("", trial):
            changes[trial].append(one["psnr"] - base["psnr"])
    texts = []
    for name, dB in sorted(changes.items(), key=lambda one: -fmean(one[1]))[:best]:
        spread = f"±{stdev(dB) / len(dB) ** 0.5:.2f}" if len(dB) > 1 else ""
        texts.append(("" if only else f"{name} ") + signed(fmean(dB), 2) + spread)
    return "; ".join(texts)


def best_rate(head: str) -> str:
    """Mean change by the best learning rate of the splats' values, and by the same rate on other held-out views."""
    suffix = "" if head == "field" else f" of {head}"
    best, other = trial_changes(f"geometry{suffix}", best=1), trial_changes(f"ridge{suffix}", only="scales twice")
    return f"{best}, on other views {other}"


def watched() -> str:
    """Mean change by the threshold that is best on a set of held-out views, on the capture's other set."""
    runs, changes = defaultdict(dict), []
    for one in records("trials").values():
        if one.get("name", "").startswith("watch: "):
            runs[one["scene"]][one["name"]] = one["psnr"], one["ssim"]
    for seen, shown in ((f"{a}/{scene}", f"{b}/{scene}") for a, b in ("14", "41") for scene in VIEWS):
        best = max(runs[seen], key=runs[seen].__getitem__)
        changes.append([one - base for one, base in zip(runs[shown][best], runs[shown]["watch: default"], strict=True)])
    dB, ssim = zip(*changes, strict=True)
    return f"{signed(fmean(dB), 2)}±{stdev(dB) / len(dB) ** 0.5:.2f} dB, {signed(fmean(ssim), 3)} SSIM"


def scale() -> str:
    """Steps after growth: milliseconds, the GPU's, gigabytes at the peak; then frames per second. All are medians."""

    def rows(label: str, columns: dict[str, tuple[float, str]]) -> Iterator[list[str]]:
        cells = {column: scale_cells(column) for column in columns}

        def value(place: tuple[float, float], renderer: str) -> str:
            medians = {column: median(cells[column][place][renderer]) for column in columns}
            return "/".join(format(medians[column] * factor, form) for column, (factor, form) in columns.items())

        for place in next(iter(cells.values())):
            yield [label.format(place[0] / 1e6, place[1]), *(value(place, renderer) for renderer in RENDERERS)]

    steps = rows("{:g}M, {:g} MP", {"step_ms": (1, ".2f"), "gpu_ms": (1, ".2f"), "peak_mb": (0.001, ".1f")})
    frames = rows("{:g}M, frames", {"1080p": (1, ".0f"), "4K": (1, ".0f")})
    return grid(["splats, image", *RENDERERS.values()], [*steps, *frames])


BLOCKS = {
    "tables.default": default,
    "tables.rivals": rivals,
    "tables.gaps": lambda: changes(GAPS),
    "tables.today": lambda: trial_changes("today", best=1),
    "tables.fewest": lambda: trial_changes("9 to 12 views"),
    "tables.spread": lambda: trial_changes("spread", best=2),
    "tables.narrow": lambda: trial_changes("narrow"),
    "tables.watched": watched,
    "tables.geometry": best_rate,
    "tables.heads": lambda: changes(HEADS),
    "tables.scale": scale,
}
