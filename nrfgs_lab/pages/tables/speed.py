# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/speed.md."""

from datetime import datetime, timedelta
from pathlib import Path
from statistics import fmean, median
from typing import Any

from nrfgs_lab.bench.table import Row
from nrfgs_lab.pages.tables import BY_NAME, bench_rows, grid, records

TRAININGS = "splatfacto", "splatfacto-10k", "splatfacto-big-10k", "nrfgs-sh", "nrfgs", "nrfgs-fast", "nrfgs-best"
SITTING = timedelta(minutes=10)
"""Trainings that began within it were made on one machine, one behind the other."""
VARIANTS = {
    "fused bf16": "field",
    "torch": "in PyTorch",
    "sh head": "harmonics",
    "sg head": "SG",
    "vdgs head": "VDGS",
    "gsnb head": "GSNB",
}


def _trainings() -> dict[str, Row]:
    """Whole trainings of bonsai, by their names in docs/bench/speed.yaml."""
    return {run: row for (scene, _, run), row in bench_rows("speed").items() if scene == "bonsai"}


def trainings() -> str:
    """What whole trainings of bonsai cost: each run's seconds, means of the rest."""
    body = []
    for run in TRAININGS:
        row = _trainings()[run]
        shares = _ratios("time s", run, "splatfacto")
        share = f"{median(shares):.2f}" if shares else f"{fmean(_times_of(run)) / fmean(_times_of('splatfacto')):.2f}*"
        seconds = ", ".join(f"{value:.1f}" for value in _times_of(run))
        psnr = f"{row.mean(BY_NAME['PSNR']):.2f}"
        means = [f"{row.mean(BY_NAME['splats']) / 1000:.0f}k", f"{row.mean(BY_NAME['peak MB']):.0f}"]
        frames = "/".join(f"{row.mean(BY_NAME[name]):.0f}" for name in ("FPS", "FPS 1080p"))
        body.append([f"`{run}`", seconds, share, psnr, *means, frames])
    head = ["bonsai", "seconds", "of splatfacto's", "PSNR", "splats", "peak MB", "frames/s, own size/1080p"]
    return grid(head, body)


def _times_of(run: str) -> list[float]:
    return list(_trainings()[run].values["time s"].values())


def _ratios(what: str, run: str, base: str) -> list[float]:
    """A quantity of trainings of bonsai over another's, of those made one behind the other on one machine."""
    rows = _trainings()
    return [
        rows[run].values[what][seed] / rows[base].values[what][other]
        for seed, one in rows[run].records.items()
        for other, two in rows[base].records.items()
        if abs(_began(one) - _began(two)) < SITTING
    ]


def _began(record: dict[str, Any]) -> datetime:
    """When a training began, as its folder is called."""
    return datetime.strptime(Path(record["train"]["config_path"]).parent.name, "%Y-%m-%d_%H%M%S")


def ratio(what: str, run: str, base: str) -> str:
    """A quantity of trainings of bonsai over others' of the same call, the median."""
    return f"{median(_ratios(what, run, base)):.2f}"


def spread(*runs: str) -> str:
    """By how much the slowest training of a run is above its fastest, at most."""
    return f"{100 * max(max(_times_of(run)) / min(_times_of(run)) - 1 for run in runs):.0f} %"


def of_training(what: str, run: str) -> str:
    """A quantity of trainings of bonsai, the median."""
    return BY_NAME[what].form.format(median(_trainings()[run].values[what].values()))


PHASES = {"to step 5,000": (0, 5_000), "to 15,000": (5_000, 15_000), "to 30,000": (15_000, 30_000)}
"""Of a training of bonsai: what the columns are called -> first and last step."""


def _steps(run: str, begin: int, end: int) -> float:
    """Milliseconds of a step of whole trainings of bonsai, between two checkpoints; the median over seeds."""
    found = []
    for record in _trainings()[run].records.values():
        train = record["train"]
        seconds = {0: 0.0, **dict(train["saved"]), train["steps"]: train["seconds"]}
        found.append(1e3 * (seconds[end] - seconds[begin]) / (end - begin))
    return median(found)


def steps() -> str:
    """Milliseconds of a step of whole trainings, while splats come and go and later."""
    found = {run: [f"{_steps(run, *phase):.2f}" for phase in PHASES.values()] for run in ("nrfgs", "nrfgs-sh")}
    return ", ".join(f"{phase} {one}/{other}" for phase, one, other in zip(PHASES, *found.values(), strict=True))


def step_ratio(run: str, base: str) -> str:
    """A step of whole trainings over another's, when growth has ended."""
    return f"{_steps(run, *PHASES['to 30,000']) / _steps(base, *PHASES['to 30,000']):.2f}"


def heads() -> str:
    """Milliseconds of the GPU for each head at a million visible splats, forward and backward."""
    return ", ".join(f"{label} {_head(variant):.2f}" for variant, label in VARIANTS.items())


def _head(variant: str) -> float:
    times = records("head_gpu")["head_gpu_all"]["times"]
    found = {one["variant"]: one for one in times if one["share"] == "all" and one["visible"] == 1_000_000}
    return found[variant]["gpu_ms"]


def head_share() -> str:
    """The field's time at a million visible splats, of the harmonics'."""
    return f"{_head('fused bf16') / _head('sh head'):.2f}"


def errors() -> str:
    """Relative errors of the field against float64, in bf16."""
    (found,) = (one for one in records("head_gpu")["head_gpu_all"]["errors"] if one["variant"] == "fused bf16")
    return f"{found['colors']:.0e} in colours and {found['d weights']:.0e} in gradients of the weights"


def cpu_rasterizer(case: str) -> str:
    """The CPU's rasterizer on a case, forward and backward, and how many times a loop over tiles takes."""
    one = records("rasterizer_cpu")["rasterizer_cpu_two_threads"]["results"][case]
    ours = one["ours"]["forward_ms"] + one["ours"]["backward_ms"]
    return f"{ours:.0f} ms, {one['times_faster']:.0f} times faster"


def first_sight() -> str:
    """Seconds from the command to a picture that is worth looking at."""
    record = records("first_sight")["nrfgs-fast"]
    stages = {"imported": "imports", "images read": "images read", "step 0": "first step"}
    told = [f"{label} {record['stages'][name]:.1f}" for name, label in stages.items()]
    told += [f"{target} dB {reached['seconds']:.1f}" for target, reached in record["reached"].items()]
    return ", ".join(told)


def imports(which: str = "seconds") -> str:
    """Processor seconds that a nerfstudio command's imports take: as it is, or without what nrfgs_ns/start.py does."""
    return f"{records('start_up')[which]:.1f}"


def step_shares() -> str:
    """A step's time over the harmonics' with as many splats, and over its own with the graph."""
    rows = {(row["method"], row["variant"]): row["step_ms"] for row in records("step_parts")["graph"]["steps"]}
    grown, rest = (rows["nrfgs", name] / rows["nrfgs-sh", name] for name in ("whole", "at rest: whole"))
    slower = rows["nrfgs", "without graph"] / rows["nrfgs", "whole"]
    return f"{grown:.2f} while splats come and go, {rest:.2f} later; without the graph {slower:.2f} times as long"


def frames() -> str:
    """Frames per second of bonsai at 1080p, least and most."""
    runs, told = {"nrfgs": "", "nrfgs-sh": "`nrfgs-sh` ", "splatfacto": "splatfacto "}, []
    for run, label in runs.items():
        found = _trainings()[run].values["FPS 1080p"].values()
        told.append(f"{label}{min(found):.0f} to {max(found):.0f}")
    return ", ".join(told)


def frames_of_as_many() -> str:
    """The field's frames per second over the harmonics' with about as many splats, 1080p."""
    fps = {row["method"]: row["fps"]["1080p"] for row in records("step_parts")["graph"]["frames"]}
    return f"{fps['nrfgs'] / fps['nrfgs-sh']:.2f}"
