# SPDX-License-Identifier: Apache-2.0
"""Blocks of README.md, docs/captures.md and docs/opacity.md: captures' test views, and trials on held-out views."""

from collections import ChainMap, defaultdict
from collections.abc import Mapping, Sequence
from statistics import fmean, median, stdev

from nrfgs_lab.pages.runs import VIEWS, Trainings, grid, mean, records, signed, trainings, view_gains

FIELD, HOST = "nrfgs", "splatfacto"
SHRUNK = "harmonics, same steps and shrinkage"
BUDGET = "nrfgs, 150,000 splats", "harmonics, 150,000 splats"
FEW = list(VIEWS)[1:]
INSTEAD = {
    "`original`": ("10,000 steps: 3DGS", "10,000 steps: field"),
    "`peak`": ("field: peak", "field"),
    "`mcmc`": ("mcmc: logit", "field"),
}
"""Label -> trial in results/held-out.json, and the trial of the default that it is compared with."""
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


def _ahead(gains: list[float], digits: int = 1) -> str:
    """Gain in the median view in dB, and the number of views with a gain."""
    return f"{signed(median(gains), digits)} ({sum(one > 0 for one in gains)}/{len(gains)})" if gains else "-"


def captures() -> str:
    """`nrfgs` and splatfacto with default settings, and harmonics with the same steps, on test views."""
    body = []
    for scene, views in VIEWS.items():
        field, harmonics, host = (runs_of(scene, name) for name in (FIELD, SHRUNK, HOST))
        share = f"{mean(field, 'splats') / mean(harmonics, 'splats'):.2f}"
        cells = [*map(_cell, (field, host, harmonics)), _ahead(view_gains(field, harmonics)), share]
        body.append([f"{scene}, {views}", *cells])
    head = ["capture, training views", "`nrfgs`", "splatfacto", "harmonics"]
    return grid([*head, "gain (ahead)", "splats"], body)


def gain(scene: str) -> str:
    """Gain of the field over harmonics with the same steps in a capture's median view."""
    gains = view_gains(runs_of(scene, FIELD), runs_of(scene, SHRUNK))
    return f"{signed(median(gains))} dB (ahead in {sum(one > 0 for one in gains)} of {len(gains)})"


def over_host(scene: str) -> str:
    """Gain of the field over splatfacto in a capture's median view, both with default settings."""
    return f"{signed(median(view_gains(runs_of(scene, FIELD), runs_of(scene, HOST), all_seeds=True)))} dB"


def over_host_where_seen() -> str:
    """The same on captures with 7 test views or more, least and most: in the mean, and in the median view."""
    pairs = [(runs_of(scene, FIELD), runs_of(scene, HOST)) for scene in VIEWS]
    pairs = [pair for pair in pairs if len(pair[0][0]["per_image"]) >= 7]
    means = [mean(field, "psnr") - mean(host, "psnr") for field, host in pairs]
    medians = [median(view_gains(*pair, all_seeds=True)) for pair in pairs]
    bounds = [f"{min(gains):.1f} to {max(gains):.1f}" for gains in (means, medians)]
    return "{} dB ({} in the median view) on the {} captures with 7 test views or more".format(*bounds, len(means))


def demo(what: str) -> str:
    """The demo's gain where it shines by the field's residual, of each seed, or the seconds of its trainings."""
    seeds = [record["methods"]["nrfgs"] for _, record in sorted(records("demo").items())]
    if what == "gain":
        return ", ".join(signed(one["shine"]["psnr"] - one["shine"]["psnr_base"], 1) for one in seeds)
    seconds = [one["train"]["processor_seconds"] for one in seeds]
    return f"{min(seconds):.0f} to {max(seconds):.0f}"


def _cell(runs: Trainings) -> str:
    return f"{mean(runs, 'psnr'):.2f}/{mean(runs, 'ssim'):.3f}" if runs else "-"


def _gap(runs: Trainings) -> str:
    if not runs or any(one.get("train_psnr") is None for one in runs):
        return "-"
    return f"{mean(runs, 'train_psnr') - mean(runs, 'psnr'):.1f}"


def test_views() -> str:
    """Test views of all captures, and by how much training views are above them."""
    body = []
    for scene, views in VIEWS.items():
        field, shrunk, host = (runs_of(scene, name) for name in (FIELD, SHRUNK, HOST))
        budget = [runs_of(scene, name) for name in BUDGET]
        cells = [_cell(field), _cell(host), _cell(shrunk), _ahead(view_gains(field, shrunk), 2)]
        cells += [f"{_gap(field)}, {_gap(shrunk)}", ", ".join(map(_cell, budget))]
        body.append([f"{scene}, {views}", *cells, _ahead(view_gains(*budget), 2)])
    head = "`nrfgs`", "splatfacto", "harmonics", "gain", "gaps", "150k: field, harmonics", "gain there"
    return grid(["capture, training views", *head], body)


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


def rules_over_harmonics() -> str:
    """Gain of `nrfgs` over harmonics with the same rules on bonsai's test views."""
    ours, theirs = (records("default")[f"test: {name}/bonsai-42"] for name in ("nrfgs", "harmonics"))
    share = ours["splats"] / theirs["splats"]
    gain = f"{ours['psnr'] - theirs['psnr']:.1f} dB better than harmonics with the same training"
    return f"{gain}, at {share:.1f} times their splats"


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


def one_version() -> str:
    """Test views of `nrfgs` and of harmonics with its rules: means over seeds, and each seed's PSNR."""
    body = []
    for scene in ("castle", "kitchen", "fern"):
        for name in ("nrfgs", "harmonics, same rules"):
            runs = [one for one in records("default").values() if one["name"] == f"one version: {name}"]
            runs = [one for one in runs if one["scene"] == scene]
            seeds = ", ".join(f"{one['psnr']:.2f}" for one in sorted(runs, key=lambda one: one["seed"]))
            worst = min(view[1] for one in runs for view in one["per_image"])
            numbers = f"{mean(runs, 'ssim'):.3f}", f"{mean(runs, 'flip'):.3f}", f"{worst:.1f}"
            body.append([f"{scene}, {VIEWS[scene]}", name, seeds, *numbers, f"{mean(runs, 'splats') / 1000:.0f}k"])
    return grid(["capture, training views", "", "PSNR of each seed", "SSIM", "FLIP", "worst view", "splats"], body)


def folds(trial: str) -> str:
    """Change of PSNR by a trial of `folds`: mean and standard error over trainings, and views with a gain."""
    gains, views = defaultdict(list), defaultdict(list)
    for key, one in records("default").items():
        if one["name"] == f"folds: {trial}":
            base, scene = records("default")[key.replace(trial, "default")], one["scene"].rpartition("/")[2]
            gains[scene].append(one["psnr"] - base["psnr"])
            views[scene] += [a[1] > b[1] for a, b in zip(one["per_image"], base["per_image"], strict=True)]
    errors = {scene: stdev(some) / len(some) ** 0.5 for scene, some in gains.items()}
    ahead = {scene: f"{sum(better)}/{len(better)}" for scene, better in views.items()}
    shown = {scene: f"{fmean(some):+.2f} +- {errors[scene]:.2f} ({ahead[scene]})" for scene, some in gains.items()}
    return " | ".join(shown[scene] for scene in ("kitchen", "castle", "fern") if scene in shown)


def without(trial: str) -> str:
    """Gain of a trial over the default on `bonsai` with all its views except those held out, in both ways."""
    runs = records("held-out")
    gains, better, count, splats = [], 0, 0, []
    for place in ("4/bonsai", "0/bonsai"):
        base = runs[f"field/{place}-42"]
        if (one := runs.get(f"field: {trial}/{place}-42")) is None:
            continue
        pairs = list(zip(one["per_image"], base["per_image"], strict=True))
        gains.append(f"{fmean(ours[1] - theirs[1] for ours, theirs in pairs):+.2f}")
        better += sum(ours[2] > theirs[2] for ours, theirs in pairs)
        count += len(pairs)
        splats.append(one["splats"] / base["splats"])
    more = f"{100 * fmean(splats) - 100:+.0f} % splats"
    return f"{' and '.join(gains)} dB, SSIM better in {better} of {count} views, {more}"


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
    "readme.gain": gain,
    "readme.over_host": over_host,
    "readme.over_host_where_seen": over_host_where_seen,
    "readme.demo": demo,
    "captures.trials": lambda: str(len(records("held-out"))),
    "captures.tried": lambda: gains_over(
        "harmonics: shrinkage",
        {"**u = V / (V + 20)**": ("field", "field: trust"), "u = 1": ("field: u = 1", "field: whole")},
    ),
    "captures.instead": lambda: gains_of("held-out", INSTEAD),
    "captures.rules": lambda: gains_of("default", {label: (one, "splatfacto's rules") for label, one in RULES.items()}),
    "captures.rules_gain": rules_gain,
    "captures.rules_over_harmonics": rules_over_harmonics,
    "captures.failed": failed,
    "captures.floaters": floaters,
    "captures.run": lambda name: _run(records("default")[name]),
    "captures.one_version": one_version,
    "captures.folds": folds,
    "captures.without": without,
    "captures.test_views": test_views,
    "opacity.copies": lambda: gains_over("mcmc: harmonics", {name: [f"mcmc: {one}"] for name, one in COPIES.items()}),
    "opacity.moved": moved,
}
