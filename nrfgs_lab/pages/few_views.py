# SPDX-License-Identifier: Apache-2.0
"""Blocks of README.md, docs/captures.md and docs/tables.md: captures' test views, and trials on held-out views."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from statistics import fmean, median, stdev

from scipy.stats import binomtest

from nrfgs_lab.bench.spec import OWN
from nrfgs_lab.pages.runs import VIEWS, Trainings, bench_rows, grid, mean, records, signed, trainings, view_gains

FIELD, HOST, SAME = "nrfgs", "splatfacto", "harmonics, same rules"
FEW = list(VIEWS)[1:]
TWINS = [scene for scene, views in VIEWS.items() if views <= 50]
SPARSE = {"24_views_bonsai": (24, "22.60"), "kitchen": (21, "19.24 (other views)")}
"""Scene of results/twenty-four.json -> training views, and others' PSNR of 3DGS at an eighth (arXiv 2508.04968)."""
HALF = {f"{views}_views_bonsai": views for views in (16, 24, 32, 64, 128)} | {"bonsai": 255}
"""Half-size scenes there -> training views."""
MADE = {"glossy": "made", "matt": "made_matt"}
"""Kind of a made capture -> its scene there; each has 262 training views."""


def host(scene: str) -> Trainings:
    """Splatfacto's trainings of a capture: the first in results/captures.json or presets.json, the others with ours."""
    first = [one for one in records("captures").values() if (one.get("scene"), one.get("name")) == (scene, HOST)]
    return (first or trainings("presets", scene, "nerfstudio_splatfacto", OWN)) + today(scene, HOST)


def alone(scene: str, name: str, strategy: str = OWN) -> Trainings:
    """The trainings of a capture with today's settings, without a twin, by seed."""
    return trainings("default", scene, name.replace(",", "_").replace(" ", "_"), strategy)


def today(scene: str, name: str, strategy: str = OWN) -> Trainings:
    """The same as they are by default: with a twin where views are few."""
    return alone(scene, f"{name}, twin" if scene in TWINS and name in (FIELD, SAME) else name, strategy)


def twins(trial: str, base: str) -> list[list[dict]]:
    """Pairs of records of two trials of results/twin.json, of the same seed, on the same held-out views."""
    rows = {place: row.records for place, row in bench_rows("twin").items()}
    pairs = [(row, rows.get((*place[:2], base), {})) for place, row in rows.items() if place[2] == trial]
    return [[one[seed], other[seed]] for one, other in pairs for seed in one if seed in other]


def trial_gain(trial: str, base: str) -> str:
    """Mean change of PSNR over sets of held-out views, with its standard error."""
    gains = [one["measured"]["test"]["psnr"] - other["measured"]["test"]["psnr"] for one, other in twins(trial, base)]
    return f"{signed(fmean(gains), 2)}±{stdev(gains) / len(gains) ** 0.5:.2f}"


def twin_gain(trial: str, base: str) -> str:
    """Mean change by a twin over sets of held-out views, with its standard error, and how many sets gain."""
    tests = [[one["measured"]["test"] for one in pair] for pair in twins(trial, base)]
    psnr, ssim = ([one[metric] - other[metric] for one, other in tests] for metric in ("psnr", "ssim"))
    worst = [[min(view["psnr"] for view in test["per_image"]) for test in pair] for pair in tests]
    better = "{} and {} of {} sets".format(*(sum(one > 0 for one in gains) for gains in (psnr, ssim)), len(psnr))
    gain = f"{trial_gain(trial, base)} dB, {signed(fmean(ssim), 4)} SSIM"
    return f"{gain} (better on {better}), {signed(fmean(one - other for one, other in worst), 1)} dB in the worst view"


def twin_tests(kind: str) -> str:
    """Changes by a twin on test views: PSNR and SSIM in the mean over seeds, and the seeds that gain PSNR."""
    cells = []
    for scene in TWINS:
        both = [of(scene, FIELD if kind == "field" else SAME) for of in (today, alone)]
        psnr, ssim = (mean(both[0], metric) - mean(both[1], metric) for metric in ("psnr", "ssim"))
        better = sum(one["psnr"] > other["psnr"] for one, other in zip(*both, strict=True))
        cells.append(f"`{scene}` {signed(psnr, 2)} dB, {signed(ssim, 4)} SSIM ({better}/{len(both[0])})")
    return "; ".join(cells)


def twin_cost(of: str) -> str:
    """What a twin multiplies a training's seconds or peak memory by, alone on a GPU: least and most."""
    shares = [one["train"][of] / other["train"][of] for one, other in twins("nrfgs__twin", "nrfgs")]
    return f"{min(shares):.1f} to {max(shares):.1f}"


def ahead(gains: list[float], digits: int = 1) -> str:
    """Gain in the median view in dB, and the number of views with a gain."""
    return f"{signed(median(gains), digits)} ({sum(one > 0 for one in gains)}/{len(gains)})" if gains else "-"


def verdict(gains: list[float]) -> str:
    """Whether the first of two is better by a two-sided sign test over views at 5 %."""
    better = sum(one > 0 for one in gains)
    if 0.5 ** (len(gains) - 1) >= 0.05:  # even if all agree
        return "too few test views"
    if binomtest(better, len(gains)).pvalue >= 0.05:
        return "no difference seen"
    return "better" if 2 * better > len(gains) else "worse"


def captures() -> str:
    """The field and splatfacto by default on test views, and what the field gains over harmonics with its rules."""
    body = []
    for scene, views in VIEWS.items():
        field = today(scene, FIELD)
        gains = view_gains(field, today(scene, SAME))
        body.append([f"{scene}, {views}", f"{cell(field)}; {cell(host(scene))}", f"{verdict(gains)}: {ahead(gains)}"])
    return grid(["capture, training views", "`nrfgs`; splatfacto", "`nrfgs` against harmonics"], body)


def over_host_where_seen() -> str:
    """Gain over splatfacto on captures with 7 test views or more, least and most: in the mean and the median view."""
    pairs = [(today(scene, FIELD), host(scene)) for scene in VIEWS]
    pairs = [pair for pair in pairs if len(pair[0][0]["per_image"]) >= 7]
    means = [mean(field, "psnr") - mean(other, "psnr") for field, other in pairs]
    medians = [median(view_gains(*pair, all_seeds=True)) for pair in pairs]
    bounds = [f"{min(gains):.1f} to {max(gains):.1f}" for gains in (means, medians)]
    return "{} dB ({} in the median view) on the {} with 7 test views or more".format(*bounds, len(means))


def over_same(scene: str) -> str:
    """Gain of the field over harmonics with the same rules: mean over test views and seeds."""
    return f"{signed(mean(today(scene, FIELD), 'psnr') - mean(today(scene, SAME), 'psnr'))} dB"


def demo() -> str:
    """The demo's gain where it shines by the field's residual, of each seed."""
    seeds = [record["methods"]["nrfgs"] for _, record in sorted(records("demo").items())]
    return ", ".join(signed(one["shine"]["psnr"] - one["shine"]["psnr_base"], 1) for one in seeds)


def cell(runs: Trainings) -> str:
    return f"{mean(runs, 'psnr'):.2f}/{mean(runs, 'ssim'):.3f}" if runs else "-"


# Held-out views: (capture, which were held out, image) -> PSNR and SSIM.

Views = dict[tuple[str, str, str], tuple[float, float]]


def views_of(study: str, trial: str) -> Views:
    """Means over seeds on the views of a trial."""
    values = defaultdict(list)
    for one in records(study).values():
        if one["name"] == trial:
            held_out, _, capture = one["scene"].partition("/")
            for image, psnr, ssim, *_ in one["per_image"]:
                values[capture, held_out, image].append((psnr, ssim))
    return {view: tuple(map(fmean, zip(*pairs, strict=True))) for view, pairs in values.items()}


def rules_gain() -> str:
    """Least and most that today's rules gain over splatfacto's on the held-out views of a capture of few views."""
    ours, theirs = (views_of("trials", trial) for trial in ("by error, dense start, near plane", "splatfacto's rules"))
    pairs = [[(ours[view], theirs[view]) for view in theirs if view in ours and view[0] == scene] for scene in FEW]
    psnr = [median(one[0] - other[0] for one, other in views) for views in pairs]
    ssim = [fmean(one[1] - other[1] for one, other in views) for views in pairs]
    return f"{min(psnr):.1f} to {max(psnr):.1f} dB and {min(ssim):.3f} to {max(ssim):.3f} SSIM"


def floaters() -> str:
    """The most that a view of those gains without what is near."""
    views = records("failed-views")["by error, dense start/kitchen-42"]["00.jpg"]
    return f"{views['testnear<0.5'] - views['all']:.1f}"


def _run(one: Mapping) -> str:
    """PSNR, SSIM and splats of a training or in the mean, and its seconds if it was alone on its GPU."""
    seconds = f", {one['seconds']:.0f} s" if "seconds" in one else ""
    return f"{one['psnr']:.2f} dB, {one['ssim']:.3f}, {one['splats'] / 1000:.0f}k splats{seconds}"


def sparse_runs(scene: str) -> list[Trainings]:
    """The field's trainings of a scene in results/twenty-four.json, and those of harmonics with its rules."""
    return [trainings("twenty-four", scene, name, OWN) for name in (FIELD, "harmonics__same_rules")]


def sparse() -> str:
    """The protocol of 24 views: the field, harmonics, splatfacto, and 3DGS's published PSNR."""
    body = []
    for scene, (views, published) in SPARSE.items():
        runs, theirs = sparse_runs(scene), trainings("twenty-four", scene, HOST, OWN)
        body.append([f"{scene.rpartition('_')[2]}, {views}", *map(cell, runs), cell(theirs), published])
    return grid(["training views", "`nrfgs`", "harmonics", HOST, "3DGS, published"], body)


def verdicts(pairs: Mapping[str, Sequence[Trainings]]) -> str:
    """Verdicts on pairs of trainings, by label."""
    gains = {label: view_gains(*pair) for label, pair in pairs.items() if all(pair)}
    return "; ".join(f"{label} {verdict(of)}: {ahead(of)}" for label, of in gains.items())


def pictured() -> str:
    """Gain over splatfacto in the median view and in the best, of the trainings in README.md's picture."""
    gains = view_gains(*([records("trials")[f"another host: {of}/bonsai-42"]] for of in ("gsplat's kernels", HOST)))
    return f"{signed(median(gains))} and {signed(max(gains))} dB"


BLOCKS = {
    "readme.captures": captures,
    "readme.over_host_where_seen": over_host_where_seen,
    "readme.over_same": over_same,
    "readme.demo": demo,
    "captures.rules_gain": rules_gain,
    "captures.twin": twin_gain,
    "captures.twin_tests": twin_tests,
    "captures.trial": trial_gain,
    "captures.twin_cost": twin_cost,
    "captures.floaters": floaters,
    "captures.today": lambda *place: _run({of: mean(today(*place), of) for of in ("psnr", "ssim", "splats")}),
    "captures.sparse": sparse,
    "captures.by_views": lambda: verdicts({f"{views} views": sparse_runs(scene) for scene, views in HALF.items()}),
    "captures.made": lambda: verdicts({kind: sparse_runs(scene) for kind, scene in MADE.items()}),
    "captures.alone": lambda name: f"{records('trials')[name]['seconds']:.0f} s",
    "readme.pictured": pictured,
    "captures.run": lambda name: _run(records("trials")[name]),
}
