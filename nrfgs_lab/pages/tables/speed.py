# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/speed.md."""

from statistics import median

from nrfgs_lab.bench.table import Row
from nrfgs_lab.pages.tables import BY_NAME, bench_rows, grid, records

TRAININGS = {
    "splatfacto": "splatfacto (nerfstudio's own)",
    "splatfacto-10k": "splatfacto in 10,000 steps",
    "splatfacto-big": "splatfacto-big (nerfstudio's own)",
    "splatfacto-big-10k": "splatfacto-big in 10,000 steps",
    "nrfgs-sh": "`nrfgs-sh`",
    "nrfgs": "`nrfgs`",
    "nrfgs-fast": "`nrfgs-fast`",
    "nrfgs-best": "`nrfgs-best`",
}
VARIANTS = {
    "fused bf16": "the field (bf16, the default)",
    "fused fp32": "the field (fp32)",
    "torch": "the field in PyTorch",
    "sh head": "spherical harmonics (gsplat's kernel)",
    "sg head": "SG (PyTorch)",
    "vdgs head": "VDGS (PyTorch, hash grid in Triton)",
    "gsnb head": "GSNB (PyTorch)",
}


def _trainings() -> dict[str, Row]:
    """Whole trainings of bonsai, by their names in docs/bench/speed.yaml."""
    return {run: row for (_, _, run), row in bench_rows("speed").items()}


def trainings() -> str:
    """What whole trainings of bonsai cost: medians and ranges of seconds, means of the rest."""
    rows = _trainings()
    base = median(rows["splatfacto"].values["time s"].values())
    body = []
    for run, label in TRAININGS.items():
        if run in rows:
            row, seconds = rows[run], list(rows[run].values["time s"].values())
            cells = [row.text(BY_NAME[name]) for name in ("PSNR", "splats", "FPS", "FPS 1080p", "peak MB")]
            body.append([label, str(len(seconds)), spread(seconds, 0), f"{median(seconds) / base:.2f}", *cells])
    head = ["bonsai", "runs", "train s", "of splatfacto's", "PSNR", "splats", "FPS, 799 x 532", "FPS, 1080p", "peak MB"]
    return grid(head, body)


def ratio(what: str, run: str, base: str) -> str:
    """A quantity of trainings of bonsai over others', medians."""
    first, second = (median(_trainings()[one].values[what].values()) for one in (run, base))
    return f"{first / second:.2f}"


def of_training(what: str, run: str) -> str:
    """A quantity of trainings of bonsai, the median."""
    return BY_NAME[what].form.format(median(_trainings()[run].values[what].values()))


def heads() -> str:
    """Milliseconds of the GPU for each head, forward and backward."""
    times = records("head_gpu")["head_gpu_all"]["times"]
    sizes = sorted({one["visible"] for one in times})
    found = {(one["variant"], one["visible"]): one for one in times if one["share"] == "all"}
    body = []
    for variant, label in VARIANTS.items():
        cells = [f"{found[variant, size]['gpu_ms']:.2f}" for size in sizes]
        body.append([label, *cells, f"{found[variant, 1_000_000]['peak_mib']:.0f}"])
    return grid(["visible splats", *(f"{size / 1e6:g} M" for size in sizes), "peak MiB at 1 M"], body)


def head_share() -> str:
    """The field's time at a million visible splats, of the harmonics'."""
    times = records("head_gpu")["head_gpu_all"]["times"]
    found = {one["variant"]: one for one in times if one["share"] == "all" and one["visible"] == 1_000_000}
    return f"{found['fused bf16']['gpu_ms'] / found['sh head']['gpu_ms']:.2f}"


def error(variant: str, what: str) -> str:
    """Relative error of a variant of the field against float64."""
    (found,) = (one for one in records("head_gpu")["head_gpu_all"]["errors"] if one["variant"] == variant)
    return f"{found[what]:.0e}"


CPU = "20000x256x256", "200000x800x600", "200000x1600x1200", "fox trained"
"""Cases of the CPU's rasterizer that the page has."""


def cpu_rasterizer() -> str:
    """The CPU's rasterizer beside a loop of autograd over tiles."""
    results = records("rasterizer_cpu")["rasterizer_cpu_two_threads"]["results"]
    body = [
        [
            name,
            f"{one['ours']['forward_ms']:.0f} + {one['ours']['backward_ms']:.0f}",
            f"{one['times_faster']:.1f}",
            f"{one['peak_memory_mib']:.0f}",
        ]
        for name, one in results.items()
        if name in CPU
    ]
    return grid(["splats, image", "forward + backward (ms)", "times faster than the loop", "peak MiB"], body)


def first_sight() -> str:
    """From the command to a picture that is worth looking at."""
    record = records("first_sight")["nrfgs-fast"]
    stages = {
        "imported": "imports, the command line",
        "data set checked": "data set checked",
        "model made": "first splats",
        "images read": "images read",
        "photographs compared": "photographs compared",
        "step 0": "first step",
    }
    body, before = [], 0.0
    for name, label in stages.items():
        seconds = record["stages"][name]
        body.append([label, f"{seconds - before:.1f}", f"{seconds:.1f}"])
        before = seconds
    for target, reached in record["reached"].items():
        seconds = reached["seconds"]
        body.append([f"{target} dB, {reached['steps']:,} steps", f"{seconds - before:.1f}", f"{seconds:.1f}"])
        before = seconds
    return grid(["", "seconds", "since the command"], body)


def seen(step: str) -> str:
    """PSNR of the first look from a step on."""
    curve = records("first_sight")["nrfgs-fast"]["curve"]
    return next(f"{value:.1f}" for _, steps, value in curve if steps >= int(step))


def waited_for_kernels() -> str:
    """Seconds that a first training waits for its kernels, when it has read everything."""
    stages = records("first_sight")["nrfgs, no compiled kernels, busy host"]["stages"]
    return f"{stages['set up'] - stages['photographs compared']:.0f}"


def imports(which: str = "seconds") -> str:
    """Processor seconds that a nerfstudio command's imports take: as it is, or without what nrfgs_ns/start.py does."""
    return f"{records('start_up')[which]:.1f}"


STEPS = {
    "whole": "while splats come and go",
    "at rest: whole": "later",
    "without graph": "without the graph, while splats come and go",
    "at rest: without graph": "without the graph, later",
}


def steps() -> str:
    """A step of each method, with its CUDA graph and without."""
    rows = {(row["method"], row["variant"]): row for row in records("step_parts")["graph"]["steps"]}
    body = []
    for variant, label in STEPS.items():
        mine = [rows[method, variant] for method in ("nrfgs", "nrfgs-sh")]
        body.append([label, *(f"{row[key]:.2f}" for row in mine for key in ("step_ms", "gpu_ms"))])
    counts = [f"{rows[method, 'whole']['splats']:,}" for method in ("nrfgs", "nrfgs-sh")]
    return grid(["", f"`nrfgs`, {counts[0]} splats", "GPU", f"`nrfgs-sh`, {counts[1]} splats", "GPU"], body)


def step_share(method: str, variant: str, base_method: str, base_variant: str) -> str:
    """A step's time over another's."""
    rows = {(row["method"], row["variant"]): row for row in records("step_parts")["graph"]["steps"]}
    return f"{rows[method, variant]['step_ms'] / rows[base_method, base_variant]['step_ms']:.2f}"


PARTS = {
    "whole": "as it is",
    "without lists": "gsplat's lists of what tiles draw",
    "without adam": "torch's fused Adam",
    "without statistics": "growth's statistics in PyTorch",
    "without all": "all three",
}


def step_parts() -> str:
    """What each of the step's own kernels saves: medians over rounds, and the step's range."""
    body = []
    for variant, label in PARTS.items():
        cells = []
        for method in ("nrfgs", "nrfgs-sh"):
            rows = _rows(method, variant)
            cells += [f"{median(row['gpu_ms'] for row in rows):.2f}", spread([row["step_ms"] for row in rows], 1)]
        body.append([label, *cells])
    return grid(["", "`nrfgs`: GPU", "step", "`nrfgs-sh`: GPU", "step"], body)


def gpu_share(method: str, variant: str, base_method: str, base_variant: str) -> str:
    """The GPU's time in a step, over another's."""
    times = [median(row["gpu_ms"] for row in _rows(*one)) for one in ((method, variant), (base_method, base_variant))]
    return f"{times[0] / times[1]:.2f}"


def frames() -> str:
    """Frames per second of models with about as many splats, in turns: each round."""
    rows = records("step_parts")["graph"]["frames"]
    body = []
    for method in dict.fromkeys(row["method"] for row in rows):
        mine = [row["fps"] for row in rows if row["method"] == method]
        cells = [", ".join(f"{fps[size]:.0f}" for fps in mine) for size in mine[0]]
        body.append([f"`{method}`", *cells])
    return grid(["", "799 x 532", "1080p", "799 x 532, gsplat's lists", "1080p, gsplat's lists"], body)


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


def _rows(method: str, variant: str) -> list[dict]:
    """The rounds of a variant of a step."""
    rows = records("step_parts")["bonsai_250k"]["steps"]
    return [row for row in rows if (row["method"], row["variant"]) == (method, variant)]
