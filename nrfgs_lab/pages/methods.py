# SPDX-License-Identifier: Apache-2.0
"""Blocks of docs/comparison.md and docs/deviations.md: methods, their parts, and single differences from the papers."""

from collections import defaultdict
from statistics import fmean, median

from nrfgs_lab.pages.few_views import cell, verdict, verdicts
from nrfgs_lab.pages.runs import (
    ORIGINAL,
    VIEWS,
    Trainings,
    bench_rows,
    grid,
    mean,
    mean_of,
    records,
    signed,
    trainings,
    view_gains,
)

# Every capture at half its size, in 10,000 steps.

BASE = "3DGS"
METHODS = "VDGS", "GSNB", "SG", "NRF-GS"
OF_THE_PAPER = {"VDGS": (0.49, 1.286), "GSNB": (0.96, 1.175), "NRF-GS": (1.01, 0.456)}
"""The paper's gains on bonsai, in dB, and splats in multiples of 3DGS's."""


def half(scene: str, run: str) -> Trainings:
    """A run of the plan `methods` under 3DGS's rules."""
    return trainings("methods", scene, run)


def gain(ours: Trainings, theirs: Trainings, metric: str) -> float:
    """Gain in a metric's mean over views and seeds."""
    return mean(ours, metric) - mean(theirs, metric)


def every() -> str:
    """3DGS's PSNR and SSIM, and the others' gains, dB and SSIM x 1000; the median share of its splats."""
    psnr = f"{mean_of(bench_rows('paper')['bonsai', ORIGINAL, BASE], 'PSNR'):.2f}"
    body = [[BASE, "", psnr, *(cell(half(scene, BASE)) for scene in VIEWS), ""]]
    for run in METHODS:
        paper = "{:+.2f} ({:.2f})".format(*OF_THE_PAPER[run]) if run in OF_THE_PAPER else ""
        share = median(mean(half(one, run), "splats") / mean(half(one, BASE), "splats") for one in VIEWS)
        body.append([run, paper, _protocol(run), *_gains(run), f"{share:.2f}"])
    return grid(["", "paper", "protocol", *VIEWS, "splats"], body)


def _gains(run: str) -> list[str]:
    """A cell for each capture, bold if it is the capture's largest gain in dB."""
    cells = []
    for scene in VIEWS:
        base = half(scene, BASE)
        gains = {one: gain(half(scene, one), base, "psnr") for one in METHODS}
        both = f"{signed(gains[run], 2)}/{signed(1000 * gain(half(scene, run), base, 'ssim'), 0)}"
        cells.append(f"**{both}**" if gains[run] == max(gains.values()) > 0 else both)
    return cells


def _protocol(run: str) -> str:
    """A method's gain in the paper's protocol, and its share of 3DGS's splats; VDGS as its authors have it."""
    rows = bench_rows("paper")
    name = "VDGS_no_resets" if run == "VDGS" else run
    ours, base = (rows.get(("bonsai", ORIGINAL, name)) for name in (name, BASE))
    if not ours:
        return ""
    share = mean_of(ours, "splats") / mean_of(base, "splats")
    return f"{signed(mean_of(ours, 'PSNR') - mean_of(base, 'PSNR'), 2)} ({share:.2f})"


# Full size, 30,000 steps, two seeds.

PARTS = {"opacity residual": ("no_opacity", 0.35), "distance": ("no_distance", 0.21), "split": ("no_split", 0.48)}
"""Part of the field -> the run without, and the part's gain in the paper, in dB."""


def parts() -> str:
    """Gain of the field by each of its parts, on bonsai and goldcape under 3DGS's rules."""
    rows, sentences = bench_rows("comparison"), []
    for part, (without, paper) in PARTS.items():
        pairs = [[rows[scene, ORIGINAL, run] for run in ("NRF-GS", without)] for scene in ("bonsai", "goldcape")]
        gained = ", ".join(signed(mean_of(one, "PSNR") - mean_of(other, "PSNR"), 2) for one, other in pairs)
        sentences.append(f"{part} {gained} ({paper:+.2f})")
    return "; ".join(sentences)


def over_gsnb() -> str:
    """Gain over GSNB in the median held-out view of bonsai: at the host's rates, and at GSNB's own."""
    field, *others = (trainings("deviations", "bonsai", run) for run in ("NRF", "GSNB", "GSNB_rates"))
    return "{:.2f} to {:.2f} dB".format(*(median(view_gains(field, other)) for other in others))


# Equal numbers of splats, at half size, in 10,000 steps; one seed, at the seats three.

COUNTS, CURVES = (75_000, 150_000, 300_000, 600_000), ("bonsai", "goldcape", "caliterra")
Labels = dict[str, tuple[str, str]]
"""Label of a line in a figure -> its run and rule."""
BY_ERROR, FROZEN = "error-guided", "field, its network frozen at random"
HEADS_OF = {
    run: (run, BY_ERROR) for run in ("field", "field without opacity residual", "GSNB", "VDGS", "harmonics", FROZEN)
}
RULES_OF = {
    "growth by error (nrfgs)": ("field", BY_ERROR),
    "splatfacto's rules": ("field", "splatfacto"),
    "3DGS's rules": ("field", ORIGINAL),
    "3DGS-MCMC": ("field", "mcmc"),
}
SEATS_OF = {run: (run, BY_ERROR) for run in ("field", "harmonics", "network at the pixel", "convolutions at the pixel")}


def equal(scene: str, run: str, count: int = COUNTS[1], rule: str = BY_ERROR) -> Trainings:
    """A run of the plan `numbers`."""
    name = "".join(letter if letter.isalnum() else "_" for letter in run)
    return trainings("numbers", scene, name, f"{rule}@{count}")


def at_equal_numbers() -> str:
    """Harmonics with 150,000 splats, and what the others gain over them, dB and SSIM x 1000."""
    scenes = *CURVES, "castle"
    bases = [equal(scene, "harmonics") for scene in scenes]
    body = [["harmonics", *map(cell, bases)]]
    for run in ("VDGS", "GSNB", FROZEN, "field without opacity residual", "field without distance", "field"):
        pairs = [(equal(scene, run), base) for scene, base in zip(scenes, bases, strict=True)]
        both = [f"{signed(gain(*pair, 'psnr'), 2)}/{signed(1000 * gain(*pair, 'ssim'), 0)}" for pair in pairs]
        body.append([f"**{run}**" if run == "field" else run, *both])
    return grid(["", *scenes], body)


def first_rule() -> str:
    """Pairs with another rule, at one number, in which growth by error is better, worse, and higher in mean SSIM."""
    others = [rule for _, rule in RULES_OF.values() if rule != BY_ERROR]
    found, higher = [], []
    for scene in (*CURVES, "castle"):
        pairs = [(equal(scene, "field", n), equal(scene, "field", n, rule)) for n in COUNTS for rule in others]
        said = [verdict(view_gains(*pair)) for pair in pairs if all(pair)]
        higher += [gain(*pair, "ssim") > 0 for pair in pairs if all(pair)]
        if scene in CURVES:
            worse = f", worse in {said.count('worse')}" if "worse" in said else ""
            found.append(f"{said.count('better')}{worse} of {len(said)} on `{scene}`")
    return f"better in {', '.join(found)}; its SSIM is higher in {sum(higher)} of {len(higher)}"


def seated(scene: str, run: str) -> Trainings:
    """A run with 150,000 splats, and with the rates that were chosen for its head."""
    return trainings("rates", scene, run.replace(" ", "_"), f"{BY_ERROR}@{COUNTS[1]}")


def over(other: str, run: str = "field") -> str:
    """Verdicts on a run and another head with 150,000 splats, on captures with enough test views."""
    return verdicts({f"`{scene}`": [seated(scene, name) for name in (run, other)] for scene in list(VIEWS)[:4]})


def setting_gains(head: str) -> dict[str, float]:
    """Mean gain over captures of each setting tried for a head at the pixel, in dB, by knob and setting."""
    tried: dict[str, dict[str, float]] = defaultdict(dict)
    for name, one in records("rates").items():
        if name.startswith(f"{head}/"):
            tried[one["cell"]["run"]][one["cell"]["scene"]] = one["measured"]["test"]["psnr"]
    plain = tried.pop("default")
    return {run: fmean(psnr[scene] - plain[scene] for scene in plain) for run, psnr in tried.items()}


def rates(head: str) -> str:
    """The settings chosen for a head at the pixel: of each knob the best, with its gain."""
    best: dict[str, tuple[float, str]] = {}
    for run, won in setting_gains(head).items():
        knob, _, setting = run.partition(" ")
        best[knob] = max(best.get(knob, (0.1, "")), (won, setting))
    return ", ".join(f"{setting} {signed(won, 2)}" for won, setting in best.values() if setting)


def seats() -> str:
    """Networks at the splat and at the pixel: PSNR/SSIM of each capture, and mean MS-SSIM and FLIP."""
    body = []
    for run in SEATS_OF:
        runs = [seated(scene, run) for scene in VIEWS]
        means = [f"{fmean(mean(of, metric) for of in runs):.3f}" for metric in ("ms_ssim", "flip")]
        body.append([run, *map(cell, runs), "/".join(means)])
    return grid(["", *VIEWS, "MS-SSIM/FLIP"], body)


# The choice of the heads' settings.

TRIALS = {"third": "a third of its rate", "triple": "three times its rate", "shrinkage": "shrinkage"}
HEADS = {"SH": "3DGS", "VDGS": "VDGS", "GSNB": "GSNB", "SG": "SG", "NRF": "NRF-GS"}
"""Head, as the plan `heads` calls it -> its run."""


def chosen() -> str:
    """Heads whose settings are not their own, and the gain in the median held-out view, mean over captures."""
    best = {head: best_trial(head) for head in HEADS}
    return ", ".join(
        f"{HEADS[head]} {TRIALS[trial]} ({signed(fmean(trial_gains(head, trial)), 2)} dB)"
        for head, trial in best.items()
        if trial
    )


def best_trial(head: str) -> str:
    """The trial with the largest gain in the mean over captures; empty: the head's own setting."""
    gains = {trial: fmean(trial_gains(head, trial) or [0.0]) for trial in TRIALS}
    best = max(gains, key=gains.get)
    return best if gains[best] > 0 else ""


def trial_gains(head: str, trial: str) -> list[float]:
    """Gain over the head's own setting in the median held-out view, for each capture."""
    pairs = [[trainings("heads", scene, name) for name in (f"{head}_{trial}", head)] for scene in VIEWS]
    return [median(view_gains(*pair)) for pair in pairs if all(pair)]


# Single differences from the papers, on held-out views.

SCENES = "bonsai", "goldcape", "fox"
SAME = {"3DGS": "SH", "VDGS": "VDGS", "GSNB": "GSNB", "NRF": "NRF"}
"""A run of the plan `deviations` that changes nothing -> the same one of `heads`."""


def worth(change: str) -> str:
    """Effect of a single change on held-out views, capture by capture: dB in the median view, times the splats."""
    gains, shares = [], []
    for scene in SCENES:
        changed, plain = (trainings("deviations", scene, run) for run in (change, change.partition("_")[0]))
        gains.append(signed(median(view_gains(changed, plain)), 2))
        shares.append(f"{mean(changed, 'splats') / mean(plain, 'splats'):.2f}")
    return f"{'/'.join(gains)}, x{'/'.join(shares)}"


def noise() -> str:
    """Decibels between two equal trainings in the median held-out view: the most of any method, for each capture."""
    cells = []
    for scene in SCENES:
        pairs = [(trainings("deviations", scene, run), trainings("heads", scene, same)) for run, same in SAME.items()]
        cells.append(f"{max(abs(median(view_gains(*pair))) for pair in pairs if all(pair)):.2f} dB on `{scene}`")
    return ", ".join(cells)


BLOCKS = {
    **{f"comparison.{block.__name__}": block for block in (every, parts, over_gsnb, chosen)},
    **{f"equal.{block.__name__}": block for block in (at_equal_numbers, over, rates, first_rule, seats)},
    **{f"deviations.{block.__name__}": block for block in (worth, noise)},
}
