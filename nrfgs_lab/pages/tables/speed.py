# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/speed.md."""

from statistics import median

from nrfgs_lab.bench.table import Row
from nrfgs_lab.pages.tables import BY_NAME, bench_rows, grid, records

TRAININGS = {
    "splatfacto": "splatfacto",
    "nrfgs-sh": "`nrfgs-sh`",
    "nrfgs": "`nrfgs`",
    "nrfgs-fast": "`nrfgs-fast`",
}
VARIANTS = {
    "fused bf16": "field",
    "fused fp32": "field, fp32",
    "torch": "field, PyTorch",
    "sh head": "harmonics",
    "sg head": "SG, PyTorch",
    "vdgs head": "VDGS, PyTorch",
    "gsnb head": "GSNB, PyTorch",
}


def _trainings() -> dict[str, Row]:
    """Whole trainings of bonsai, by their names in docs/bench/speed.yaml."""
    return {run: row for (scene, _, run), row in bench_rows("speed").items() if scene == "bonsai"}


def trainings() -> str:
    """What whole trainings of bonsai cost: medians and ranges of seconds, means of the rest."""
    rows = _trainings()
    base = median(rows["splatfacto"].values["time s"].values())
    body = []
    for run, label in TRAININGS.items():
        if run in rows:
            row, seconds = rows[run], list(rows[run].values["time s"].values())
            cells = [row.text(BY_NAME[name]) for name in ("PSNR", "splats")]
            frames = "/".join(BY_NAME[name].form.format(row.mean(BY_NAME[name])) for name in ("FPS", "FPS 1080p"))
            peak = f"{row.mean(BY_NAME['peak MB']):.0f}"
            body.append([label, spread(seconds, 0), f"{median(seconds) / base:.2f}", *cells, frames, peak])
    head = ["bonsai", "seconds", "of splatfacto's", "PSNR", "splats", "frames/s, own size/1080p", "peak MB"]
    return grid(head, body)


def ratio(what: str, run: str, base: str) -> str:
    """A quantity of trainings of bonsai over others', medians."""
    first, second = (median(_trainings()[one].values[what].values()) for one in (run, base))
    return f"{first / second:.2f}"


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
    body = []
    for run in ("nrfgs", "nrfgs-sh"):
        splats = f"{_trainings()[run].mean(BY_NAME['splats']):,.0f}"
        body.append([f"`{run}`", *(f"{_steps(run, *phase):.2f}" for phase in PHASES.values()), splats])
    return grid(["", *PHASES, "splats"], body)


def step_ratio(run: str, base: str) -> str:
    """A step of whole trainings over another's, when growth has ended."""
    return f"{_steps(run, *PHASES['to 30,000']) / _steps(base, *PHASES['to 30,000']):.2f}"


def heads() -> str:
    """Milliseconds of the GPU for each head, forward and backward."""
    times = records("head_gpu")["head_gpu_all"]["times"]
    sizes = 100_000, 1_000_000
    found = {(one["variant"], one["visible"]): one for one in times if one["share"] == "all"}
    body = []
    for variant, label in VARIANTS.items():
        body.append([label, *(f"{found[variant, size]['gpu_ms']:.2f}" for size in sizes)])
    return grid(["visible splats", *(f"{size / 1e6:g}M" for size in sizes)], body)


def head_share() -> str:
    """The field's time at a million visible splats, of the harmonics'."""
    times = records("head_gpu")["head_gpu_all"]["times"]
    found = {one["variant"]: one for one in times if one["share"] == "all" and one["visible"] == 1_000_000}
    return f"{found['fused bf16']['gpu_ms'] / found['sh head']['gpu_ms']:.2f}"


def error(variant: str, what: str) -> str:
    """Relative error of a variant of the field against float64."""
    (found,) = (one for one in records("head_gpu")["head_gpu_all"]["errors"] if one["variant"] == variant)
    return f"{found[what]:.0e}"


def cpu_rasterizer(case: str, what: str) -> str:
    """The CPU's rasterizer on a case: "ms" forward and backward, or how many "times" a loop over tiles takes."""
    one = records("rasterizer_cpu")["rasterizer_cpu_two_threads"]["results"][case]
    if what == "times":
        return f"{one['times_faster']:.0f}"
    return f"{one['ours']['forward_ms'] + one['ours']['backward_ms']:.0f}"


def first_sight() -> str:
    """From the command to a picture that is worth looking at."""
    record = records("first_sight")["nrfgs-fast"]
    stages = {
        "imported": "imports",
        "data set checked": "data set checked",
        "images read": "images read",
        "photographs compared": "photographs compared",
        "step 0": "first step",
    }
    body = []
    for name, label in stages.items():
        seconds = record["stages"][name]
        body.append([label, f"{seconds:.1f}"])
    for target, reached in record["reached"].items():
        seconds = reached["seconds"]
        body.append([f"{target} dB, {reached['steps']:,} steps", f"{seconds:.1f}"])
    return grid(["", "seconds since the command"], body)


def imports(which: str = "seconds") -> str:
    """Processor seconds that a nerfstudio command's imports take: as it is, or without what nrfgs_ns/start.py does."""
    return f"{records('start_up')[which]:.1f}"


def step_share(method: str, variant: str, base_method: str, base_variant: str) -> str:
    """A step's time over another's."""
    rows = {(row["method"], row["variant"]): row for row in records("step_parts")["graph"]["steps"]}
    return f"{rows[method, variant]['step_ms'] / rows[base_method, base_variant]['step_ms']:.2f}"


def frame_share(size: str) -> str:
    """The field's frames per second over the harmonics', at about as many splats."""
    rows = records("step_parts")["graph"]["frames"]
    fps = {row["method"]: row["fps"][size] for row in rows}
    return f"{fps['nrfgs'] / fps['nrfgs-sh']:.2f}"


def spread(numbers: list[float], digits: int) -> str:
    """Median, least and largest; of one number, itself."""
    if len(numbers) == 1:
        return f"{numbers[0]:.{digits}f}"
    return f"{median(numbers):.{digits}f} ({min(numbers):.{digits}f} to {max(numbers):.{digits}f})"
