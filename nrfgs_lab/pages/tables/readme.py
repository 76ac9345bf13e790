# SPDX-License-Identifier: Apache-2.0
"""The numbers of README.md."""

from collections import defaultdict
from statistics import fmean, median
from typing import Any

from nrfgs_lab.bench.table import Row
from nrfgs_lab.pages.tables import bench_rows, grid, mean_of, records, signed

TRAINING_VIEWS = {"bonsai": 255, "goldcape": 74, "caliterra": 65, "fox": 43, "castle": 26, "kitchen": 21, "fern": 17}
FIELD, HOST = "nrfgs", "splatfacto"
SHRUNK = "harmonics, same steps and shrinkage"


def runs_of(scene: str, name: str) -> list[dict[str, Any]]:
    """The trainings of a capture, as results/captures.json has them, by seed."""
    found = [one for one in records("captures").values() if (one.get("scene"), one.get("name")) == (scene, name)]
    if name == HOST and not found and (row := bench_rows("presets").get((scene, "own", "nerfstudio_splatfacto"))):
        found = trials_of(row)
    return sorted(found, key=lambda one: one["seed"])


def trials_of(row: Row) -> list[dict[str, Any]]:
    """A benchmark's row as results/captures.json has trainings."""
    found = []
    for seed, record in row.records.items():
        test, metrics = record["measured"]["test"], ("psnr", "ssim", "ms_ssim")
        views = [[view["image"], *(view[metric] for metric in metrics)] for view in test["per_image"]]
        shown = {"seed": seed, "per_image": views, "splats": record["measured"]["splats"]}
        found.append({**{metric: test[metric] for metric in metrics}, **shown})
    return found


def captures() -> str:
    """`nrfgs` and splatfacto as they come, and harmonics with `nrfgs`'s steps, mean and shrinkage, on test views."""
    body = []
    for scene, views in TRAINING_VIEWS.items():
        field, harmonics, host = runs_of(scene, FIELD), runs_of(scene, SHRUNK), runs_of(scene, HOST)
        gains = view_gains(field, harmonics)
        psnr = [fmean(one["psnr"] for one in runs) for runs in (field, harmonics)]
        ssim = [fmean(one["ssim"] for one in runs) for runs in (field, harmonics)]
        splats = [fmean(one["splats"] for one in runs) for runs in (field, harmonics)]
        body.append(
            [
                f"{scene}, {views}",
                f"{psnr[0]:.2f}/{ssim[0]:.3f}",
                f"{fmean(one['psnr'] for one in host):.2f}/{fmean(one['ssim'] for one in host):.3f}",
                f"{psnr[1]:.2f}/{ssim[1]:.3f}",
                f"{signed(median(gains))} ({sum(gain > 0 for gain in gains)}/{len(gains)})",
                f"{splats[0] / splats[1]:.2f}",
            ]
        )
    head = ["capture, training views", "`nrfgs`", "splatfacto", "harmonics"]
    return grid([*head, "gain (ahead)", "splats"], body)


def view_gains(field: list[dict[str, Any]], harmonics: list[dict[str, Any]], all_seeds: bool = False) -> list[float]:
    """Decibels by which the field is above harmonics in each test view, in the mean of the seeds that both have, or of
    all that each has."""
    seeds = {one["seed"] for one in field} & {one["seed"] for one in harmonics}
    views: dict[str, list[list[float]]] = defaultdict(lambda: [[], []])
    for number, runs in enumerate((field, harmonics)):
        for one in runs:
            for name, psnr, *_ in one["per_image"] if all_seeds or one["seed"] in seeds else ():
                views[name][number].append(psnr)
    return [fmean(ours) - fmean(theirs) for ours, theirs in views.values() if ours and theirs]


def gain(scene: str) -> str:
    """What the field gains over harmonics with the same steps in a capture's median view, and in how many views."""
    gains = view_gains(runs_of(scene, FIELD), runs_of(scene, SHRUNK))
    return f"{signed(median(gains))} dB (ahead in {sum(one > 0 for one in gains)} of {len(gains)})"


def over_host(scene: str) -> str:
    """What the field gains on a capture over splatfacto in the median view, both as they come."""
    return f"{signed(median(view_gains(runs_of(scene, FIELD), runs_of(scene, HOST), all_seeds=True)))} dB"


def over_host_where_seen() -> str:
    """The same on captures with 7 test views or more, least and most: in the mean, and in the median view."""
    means, medians = [], []
    for scene in TRAINING_VIEWS:
        field, host = (runs_of(scene, name) for name in (FIELD, HOST))
        if len(field[0]["per_image"]) >= 7:
            means.append(fmean(one["psnr"] for one in field) - fmean(one["psnr"] for one in host))
            medians.append(median(view_gains(field, host, all_seeds=True)))
    bounds = [f"{min(gains):.1f} to {max(gains):.1f}" for gains in (means, medians)]
    return "{} dB ({} in the median view) on the {} captures with 7 test views or more".format(*bounds, len(means))


def cost() -> str:
    """Seconds of whole trainings of bonsai, least and most, and their mean PSNR."""
    runs = {"nrfgs": "", "nrfgs-best": "`nrfgs-best` ", "nrfgs-sh": "`nrfgs-sh` ", "splatfacto": "splatfacto "}
    cells = []
    for run, label in runs.items():
        row = bench_rows("speed")["bonsai", "own", run]
        seconds = dict.fromkeys(f"{bound(row.values['time s'].values()):.0f}" for bound in (min, max))
        cells.append(f"{label}{' to '.join(seconds)} s, {mean_of(row, 'PSNR'):.2f} dB")
    return "; ".join(cells)


def memory() -> str:
    """Peak memory of trainings of bonsai, of `nrfgs` and splatfacto."""
    found = [mean_of(bench_rows("speed")["bonsai", "own", run], "peak MB") / 1000 for run in (FIELD, HOST)]
    return "{:.1f} GB, splatfacto {:.1f}".format(*found)


def demo(what: str) -> str:
    """Decibels by which the field is ahead in the demo, of each seed: over whole pictures, or where it shines."""
    part = {"whole": "eval", "shine": "shine"}[what]
    found = [record["methods"] for _, record in sorted(records("demo").items())]
    gains = [methods["nrfgs"][part]["psnr"] - methods["nrfgs-sh"][part]["psnr"] for methods in found]
    return ", ".join(signed(gain, 2) for gain in gains)
