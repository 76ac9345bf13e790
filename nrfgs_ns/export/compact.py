# SPDX-License-Identifier: Apache-2.0
"""`nrfgs export compact`: write the file, and a config.yml with which nerfstudio's commands read it."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
import torch
import yaml

from nrfgs_ns.appearance.head import Field
from nrfgs_ns.appearance.nrf import NeuralResidualField, NrfConfig
from nrfgs_ns.appearance.reduce import latent_basis, with_rank
from nrfgs_ns.compact.decode import TABLES, decode
from nrfgs_ns.compact.encode import encode
from nrfgs_ns.compact.finetune import REPORT_EVERY, fine_tune
from nrfgs_ns.compact.format import container
from nrfgs_ns.errors import InputError
from nrfgs_ns.export.command import Compact
from nrfgs_ns.files import write_whole
from nrfgs_ns.progress import progress
from nrfgs_ns.threads import draws_small, few_threads
from nrfgs_ns.trained.loading import find_data, finish, load_model, lost, measure_loss
from nrfgs_ns.training.config_file import read_config
from nrfgs_ns.training.pipeline import NrfgsPipeline

COARSEST = 16.0
"""Largest factor of the grids' steps for a size: a step is then half a standard deviation of the median splat, 1/32 of
white, and a factor of e of a splat's size."""
AIM, ENOUGH = 0.98, 0.95
"""Shares of a size: aimed at, and good enough."""
MOST_ATTEMPTS = 10
PLY_BYTES = 62 * 4
"""Bytes of a splat in 3DGS's PLY file, with harmonics of degree 3."""

Total = Callable[[int], int]
"""Bytes of the compact file -> bytes of all that is written, which may have `--size-mb`."""


def export_compact(load_config: Path, options: Compact) -> None:
    """Write a compact file, and report its size and loss; see `nrfgs export compact --help`."""
    pipeline = load_field(load_config, options.measure)
    with few_threads(draws_small(pipeline)):
        config, numbers = write_file(pipeline, load_config, output := options.output, options)
    count, size, ply_size = (numbers[name] for name in ("written", "bytes", "ply_bytes"))
    lines = [
        f"{output}: {count:,} splats with latents of {numbers['rank']} numbers, {size / 1e6:.2f} MB, "
        f"{size / count:.1f} bytes a splat: 3DGS's PLY of as many splats has {ply_size / 1e6:.2f} MB, "
        f"{ply_size / size:.1f} times as much."
    ]
    lines += [lost(numbers)] if options.measure else []
    lines.append(f"Look at it with:  nrfgs view {quote(str(output))}")
    lines.append(f"Evaluate it with:  ns-eval --load-config {quote(str(config))}")
    finish(lines, numbers, options.report)


def load_field(load_config: Path, measured: bool) -> NrfgsPipeline:
    """A trained pipeline, as by `load_model`; InputError if its head is not a neural residual field."""
    pipeline = load_model(load_config, "test", measured)
    head = pipeline.model.head
    head.require_splat_colors()
    if not isinstance(head, NeuralResidualField):
        raise InputError(f"{load_config}: no compact file can hold the {head.name!r} head. Use nrfgs export ply.")
    return pipeline


def write_file(
    pipeline, load_config: Path, output: Path, options: Compact, total: Total = lambda size: size
) -> tuple[Path, dict[str, Any]]:
    """Write a compact file; returns the config.yml with which nerfstudio reads it, and numbers for a report."""
    model = pipeline.model
    field = model.field.detached()
    steps = rate = None
    render = {
        "rasterize_mode": model.config.rasterize_mode,
        "background": model.background_color.tolist(),
        "near_plane": model.projection_options.near_plane,
    }
    limit = math.inf if options.size_mb is None else 1e6 * options.size_mb
    if options.finetune > 0:
        with progress("Training for the file", -(-options.finetune // REPORT_EVERY)) as advance:
            field, steps, rate = fine_tune(
                pipeline,
                options.finetune,
                options.rate,
                lambda bits: advance(f"Training for the file ({bits / 8e6:.2f} MB)"),
                None if limit == math.inf else size_of_tables(field, render, limit, total),
            )
    else:  # latents in principal components, of which the small ones are rounded to 0 and take few bytes
        basis = latent_basis(field, torch.ones(model.num_points, device=model.device))
        field = with_rank(field, basis, field.head.config.latent_dim)
    data, coarser = encoded(field, render, steps, limit, total)
    write_whole(output, data)
    decoded = decode(output)
    config = write_config(load_config, output, decoded.config)
    count = len(decoded.splats["means"])
    numbers = {
        "splats": model.num_points,
        "written": count,
        "rank": decoded.config.latent_dim,
        "finetune": options.finetune,
        "rate": rate,
        "coarser": coarser,
        "bytes": (size := len(data)),
        "ply_bytes": PLY_BYTES * count,
        "ply_ratio": PLY_BYTES * count / size,
        "stream_bytes": {entry["name"]: entry["bytes"] for entry in decoded.header["streams"]},
    }
    if options.measure:
        file = load_model(config, "test").model  # as ns-eval reads it
        numbers |= measure_loss(pipeline, lambda camera: {"file": file.get_outputs_for_camera(camera)["rgb"]})
    return config, numbers


def size_of_tables(field: Field, render: dict[str, Any], limit: float, total: Total) -> float:
    """Bytes of the tables with which all that is written has AIM of a limit; InputError if nothing would be left."""
    header, streams = encode(field, render)
    rest = len(container(header, {name: stream for name, stream in streams.items() if name not in TABLES}))
    size = (AIM * limit - total(rest)) / ((total(rest + 3 * rest) - total(rest)) / (3 * rest))
    if size <= 0:
        raise too_small(limit, total(rest))
    return size


def encoded(
    field: Field, render: dict[str, Any], steps: Mapping[str, np.ndarray] | None, limit: float, total: Total
) -> tuple[bytes, float]:
    """A compact file, and the factor of its grids' steps: 1, unless all that is written would have more than `limit`
    bytes. Then it has at most these, and more than ENOUGH of them after few attempts; InputError if the coarsest file
    has more."""
    files: dict[float, bytes] = {}  # by the logarithm (base 2) of the factor
    log, last = 0.0, None
    slope = (13 * len(field.splats["means"]) + field.splats["latents"].numel()) / 8  # a bit a number and doubling
    while log not in files and len(files) < MOST_ATTEMPTS:
        with progress("Encoding" if limit == math.inf else f"Encoding, attempt {len(files) + 1}"):
            files[log] = container(*encode(field, render, steps, 2.0**log))
        size = total(len(files[log]))
        if size <= limit and (log == 0.0 or size >= ENOUGH * limit):
            break
        if last is not None:
            slope = max((last[1] - size) / (log - last[0]), 1.0)
        last = log, size
        log = min(max(log + (size - AIM * limit) / slope, 0.0), math.log2(COARSEST))
    fitting = [log for log, data in files.items() if total(len(data)) <= limit]
    if not fitting:
        raise too_small(limit, min(total(len(data)) for data in files.values()))
    return files[best := min(fitting)], 2.0**best


def too_small(limit: float, smallest: int) -> InputError:
    return InputError(
        f"--size-mb is {limit / 1e6:g}, and the smallest output of this model has "
        f"{math.ceil(smallest / 1e4) / 100:.2f} MB. Ask for more, or train with fewer splats (docs/how-many-splats.md)."
    )


def write_config(load_config: Path, output: Path, head: NrfConfig) -> Path:
    """Write what nerfstudio's commands need to read FILE.nrf into FILE.nrf.nerfstudio/METHOD/compact: a config.yml,
    whose path is returned, and an empty checkpoint. Its paths are absolute, as those of trainings."""
    config = read_config(load_config)
    find_data(config, load_config)
    config.output_dir = output.parent
    config.experiment_name = f"{output.name}.nerfstudio"
    config.timestamp = "compact"
    config.relative_model_dir = Path("nerfstudio_models")
    config.load_dir = config.load_checkpoint = config.load_step = None
    config.pipeline.model.appearance = head
    config.pipeline.model.camera_optimizer.mode = "off"
    models = config.get_checkpoint_dir()
    models.mkdir(parents=True, exist_ok=True)
    for written in ("config.yml", f"{models.name}/step-*.ckpt"):
        for older in models.parents[2].glob(f"*/compact/{written}"):  # of another method's file of this name, too
            older.unlink()
    step = max(config.max_num_iterations, 1) - 1
    torch.save({"step": step, "pipeline": {}}, models / f"step-{step:09d}.ckpt")
    path = config.get_base_dir() / "config.yml"
    config.output_dir = output.parent.absolute()
    config.pipeline.compact = output.absolute()
    write_whole(path, yaml.dump(config))
    return path
