# SPDX-License-Identifier: Apache-2.0
"""Blocks of README.md, docs/captures.md and docs/opacity.md: captures' test views, and trials on held-out views."""

from collections import ChainMap, defaultdict
from collections.abc import Mapping, Sequence
from statistics import fmean, median

from scipy.stats import binomtest

from nrfgs_lab.pages.runs import VIEWS, Trainings, grid, mean, records, signed, trainings, view_gains

FIELD, HOST, SAME = "nrfgs", "splatfacto", "harmonics, same rules"
SHRUNK = "harmonics, same steps and shrinkage"
RIVALS = {
    "`nrfgs` with splatfacto's densification": "nrfgs",
    "harmonics, the same": SHRUNK,
    "field, MCMC": "nrfgs, 150,000 splats",
    "harmonics, MCMC": "harmonics, 150,000 splats",
}
"""Label -> trainings in results/captures.json."""
FEW = list(VIEWS)[1:]
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
COPIES = {"added": "added", "on the logit": "logit", "the same, stored": "logit, base", "none": "no opacity residual"}
"""Where the opacity residual is added -> the trial under MCMC."""


def runs_of(scene: str, name: str) -> Trainings:
    """The trainings of a capture in results/captures.json, by seed; nerfstudio's may be in presets.json."""
    runs = [one for one in records("captures").values() if (one.get("scene"), one.get("name")) == (scene, name)]
    if name == HOST and not runs:
        runs = trainings("presets", scene, "nerfstudio_splatfacto", "own")
    return sorted(runs, key=lambda one: one["seed"])


def today(scene: str, name: str) -> Trainings:
    """The trainings of a capture with today's default settings in results/default.json, by seed."""
    runs = {}
    for sitting in ("one version", "test views"):  # the later one counts
        for one in records("default").values():
            if (one["scene"], one["name"]) == (scene, f"{sitting}: {name}"):
                runs[one["seed"]] = one
    return [runs[seed] for seed in sorted(runs)]


def _ahead(gains: list[float], digits: int = 1) -> str:
    """Gain in the median view in dB, and the number of views with a gain."""
    return f"{signed(median(gains), digits)} ({sum(one > 0 for one in gains)}/{len(gains)})" if gains else "-"


def verdict(gains: list[float]) -> str:
    """Which of two is better by a two-sided sign test over views at 5 %."""
    ahead = sum(one > 0 for one in gains)
    if binomtest(ahead, len(gains)).pvalue >= 0.05:
        return "no difference seen"
    return "field" if 2 * ahead > len(gains) else "harmonics"


def captures() -> str:
    """The field, splatfacto, and harmonics with the field's rules, all with default settings, on test views."""
    body = []
    for scene, views in VIEWS.items():
        field, host, harmonics = today(scene, FIELD), runs_of(scene, HOST), today(scene, SAME)
        gains = view_gains(field, harmonics)
        cells = [*map(_cell, (field, host, harmonics)), f"{_ahead(gains)}: {verdict(gains)}"]
        body.append([f"{scene}, {views}", *cells])
    return grid(
        ["capture, training views", "`nrfgs`", "splatfacto", "harmonics, same rules", "field - harmonics"], body
    )


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
        [f"{scene}, {views}", _cell(today(scene, FIELD)), *(_cell(runs_of(scene, name)) for name in RIVALS.values())]
        for scene, views in VIEWS.items()
    ]
    return grid(["capture, training views", "`nrfgs`", *RIVALS], body)


def over_former(metric: str, digits: str) -> str:
    """Mean gain of today's default over the one with splatfacto's densification, and least and most."""
    gains = [mean(today(scene, FIELD), metric) - mean(runs_of(scene, FIELD), metric) for scene in VIEWS]
    middle, least, most = (signed(bound(gains), int(digits)) for bound in (fmean, min, max))
    return f"{middle} ({least} to {most})"


def over_host_where_seen() -> str:
    """Gain of the field over splatfacto, both with default settings, on captures with 7 test views or more, least and
    most: in the mean, and in the median view."""
    pairs = [(today(scene, FIELD), runs_of(scene, HOST)) for scene in VIEWS]
    pairs = [pair for pair in pairs if len(pair[0][0]["per_image"]) >= 7]
    means = [mean(field, "psnr") - mean(host, "psnr") for field, host in pairs]
    medians = [median(view_gains(*pair, all_seeds=True)) for pair in pairs]
    bounds = [f"{min(gains):.1f} to {max(gains):.1f}" for gains in (means, medians)]
    return "{} dB ({} in the median view) on the {} captures with 7 test views or more".format(*bounds, len(means))


def over_same(scene: str) -> str:
    """Gain of the field over harmonics with the same rules: mean over test views and seeds."""
    return f"{signed(mean(today(scene, FIELD), 'psnr') - mean(today(scene, SAME), 'psnr'))} dB"


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


def demo(what: str) -> str:
    """The demo's gain where it shines by the field's residual, of each seed, or the seconds of its trainings."""
    seeds = [record["methods"]["nrfgs"] for _, record in sorted(records("demo").items())]
    if what == "gain":
        return ", ".join(signed(one["shine"]["psnr"] - one["shine"]["psnr_base"], 1) for one in seeds)
    seconds = [one["train"]["processor_seconds"] for one in seeds]
    return f"{min(seconds):.0f} to {max(seconds):.0f}"


def _cell(runs: Trainings) -> str:
    return f"{mean(runs, 'psnr'):.2f}/{mean(runs, 'ssim'):.3f}" if runs else "-"


# Held-out views: (capture, which were held out, image) -> PSNR and SSIM.

Views = dict[tuple[str, str, str], tuple[float, float]]


def _views(study: str, trial: str) -> Views:
    """Means over seeds on the views of a trial."""
    values = defaultdict(list)
    for one in records(study).values():
        if one["name"] == trial:
            held_out, _, capture = one["scene"].partition("/")
            for image, psnr, ssim, *_ in one["per_image"]:
                values[capture, held_out, image].append((psnr, ssim))
    return {view: tuple(map(fmean, zip(*pairs, strict=True))) for view, pairs in values.items()}


def _held_out_gain(ours: Mapping, theirs: Mapping, views: list) -> str:
    """Median dB, mean SSIM x 1000."""
    if not views:
        return ""
    psnr, ssim = ([ours[view][number] - theirs[view][number] for view in views] for number in (0, 1))
    return f"{signed(median(psnr), 2)}/{signed(1000 * fmean(ssim), 0)}"


def gains_over(harmonics: str, rows: Mapping[str, Sequence[str]]) -> str:
    """Gains of trials over `harmonics` on the held-out views that all have; of a row's trials the last counts."""
    base = _views("held-out", harmonics)
    tried = {label: ChainMap(*(_views("held-out", name) for name in reversed(names))) for label, names in rows.items()}
    common = [view for view in base if all(view in views for views in tried.values())]
    places = {scene: [view for view in common if view[0] == scene] for scene in FEW}
    body = [[label, *(_held_out_gain(views, base, places[scene]) for scene in FEW)] for label, views in tried.items()]
    return grid(["views", *(f"{scene}, {len(views)}" for scene, views in places.items())], body)


def gains_of(study: str, rows: Mapping[str, tuple[str, str]]) -> str:
    """Gains of trials over others on the held-out views that both have, and their share of the others' splats."""
    body = []
    for label, trials in rows.items():
        ours, theirs = (_views(study, trial) for trial in trials)
        cells = [_held_out_gain(ours, theirs, [v for v in theirs if v in ours and v[0] == scene]) for scene in FEW]
        splats = [defaultdict(list), defaultdict(list)]
        for one in records(study).values():
            for number, trial in enumerate(trials):
                if one["name"] == trial:
                    splats[number][one["scene"]].append(one["splats"])
        shares = [fmean(splats[0][scene]) / fmean(splats[1][scene]) for scene in splats[0].keys() & splats[1].keys()]
        body.append([label, *cells, f"{median(shares):.1f}"])
    return grid(["", *FEW, "splats"], body)


def rules_gain() -> str:
    """Least and most that today's rules gain over splatfacto's on the held-out views of a capture of few views."""
    ours, theirs = (_views("default", trial) for trial in ("by error, dense start, near plane", "splatfacto's rules"))
    pairs = [[(ours[view], theirs[view]) for view in theirs if view in ours and view[0] == scene] for scene in FEW]
    psnr = [median(one[0] - other[0] for one, other in views) for views in pairs]
    ssim = [fmean(one[1] - other[1] for one, other in views) for views in pairs]
    return f"{min(psnr):.1f} to {max(psnr):.1f} dB and {min(ssim):.3f} to {max(ssim):.3f} SSIM"


def failed() -> str:
    """PSNR of failed views of `kitchen`, whole and without each kind of suspects."""
    trials = {
        "splatfacto's rules, `00`": ("splatfacto's rules", "00"),
        "with points from photographs, `00`": ("splatfacto's rules, dense start", "00"),
        "the same, `09`": ("splatfacto's rules, dense start", "09"),
        "by error, points from photographs, `00`": ("by error, dense start", "00"),
    }
    columns = {"whole": "all", "nearer than half the nearest points": "testnear<0.5", "nearer than 0.8": "testnear<0.8"}
    columns |= {"shown by at most one training view": "n<=1", "in the image of at most one": "nf<=1"}
    views = records("failed-views")
    body = [
        [label, *(f"{views[f'{name}/kitchen-42'][f'{view}.jpg'][key]:.1f}" for key in columns.values())]
        for label, (name, view) in trials.items()
    ]
    return grid(["training, view", *columns], body)


def floaters() -> str:
    """The most that a view of those gains without what is near."""
    views = records("failed-views")["by error, dense start/kitchen-42"]["00.jpg"]
    return f"{views['testnear<0.5'] - views['all']:.1f}"


def _run(one: Mapping) -> str:
    """PSNR, SSIM and splats of one training, and its seconds if it was alone on its GPU."""
    seconds = f", {one['seconds']:.0f} s" if "seconds" in one else ""
    return f"{one['psnr']:.2f} dB, {one['ssim']:.3f}, {one['splats'] / 1000:.0f}k splats{seconds}"


def moved() -> str:
    """On how many captures MCMC is better on test views with the residual on the logit, and where not."""
    names = "nrfgs, 150,000 splats, opacity added", "nrfgs, 150,000 splats"
    added, logit = (
        {one["scene"]: one for one in records("captures").values() if one["name"] == name} for name in names
    )
    worse = [scene for scene in added if logit[scene]["psnr"] < added[scene]["psnr"]]
    cells = [f"`{scene}`, {added[scene]['psnr']:.2f} to {logit[scene]['psnr']:.2f} dB" for scene in worse]
    return f"better on {len(added) - len(worse)} captures of {len(added)} (not on {', '.join(cells)})"


BLOCKS = {
    "readme.captures": captures,
    "readme.over_host_where_seen": over_host_where_seen,
    "readme.over_same": over_same,
    "readme.demo": demo,
    "captures.default": default,
    "captures.rivals": rivals,
    "captures.over_former": over_former,
    "captures.gaps": gaps,
    "captures.rules": lambda: gains_of("default", {label: (one, "splatfacto's rules") for label, one in RULES.items()}),
    "captures.rules_gain": rules_gain,
    "captures.failed": failed,
    "captures.floaters": floaters,
    "captures.run": lambda name: _run(records("default")[name]),
    "opacity.copies": lambda: gains_over("mcmc: harmonics", {name: [f"mcmc: {one}"] for name, one in COPIES.items()}),
    "opacity.moved": moved,
}
