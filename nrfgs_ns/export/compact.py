# SPDX-License-Identifier: Apache-2.0
"""`nrfgs export compact`: write the file, and a config.yml with which nerfstudio's commands read it."""

from pathlib import Path
from time import perf_counter
from typing import Any

import torch
import yaml

from nrfgs_ns.appearance.head import AppearanceHead
from nrfgs_ns.appearance.nrf import NeuralResidualField, NrfConfig
from nrfgs_ns.appearance.reduce import latent_basis, with_rank
from nrfgs_ns.compact.decode import decode
from nrfgs_ns.compact.encode import encode
from nrfgs_ns.compact.finetune import REPORT_EVERY, fine_tune
from nrfgs_ns.compact.format import write_container
from nrfgs_ns.errors import InputError
from nrfgs_ns.export.options import CompactOptions
from nrfgs_ns.files import write_whole
from nrfgs_ns.progress import progress
from nrfgs_ns.threads import few_threads
from nrfgs_ns.trained.loading import find_data, finish, load_model, lost, measure_loss
from nrfgs_ns.training.config_file import read_config

PLY_BYTES = 62 * 4
"""Bytes of a splat in 3DGS's PLY file, with harmonics of degree 3."""


def export_compact(
    load_config: Path, output: Path, options: CompactOptions, measure: bool, report: Path | None
) -> None:
    """Write a compact file, and report its size and loss; see `nrfgs export compact --help`."""
    with few_threads() as threads:
        pipeline = load_model(load_config, "test")
        threads.suit_to(pipeline)
        check_head(pipeline.model.head, load_config)
        header, streams, numbers = packed(pipeline, options)
        begin = perf_counter()
        size = write_container(output, header, streams)
        written = perf_counter()
        decoded = decode(output)
        numbers["seconds"]["encode"] += written - begin
        numbers["seconds"]["decode"] = perf_counter() - written
        config, count = write_config(load_config, output, decoded.config), numbers["written"]
        if measure:
            numbers |= measure_file(pipeline, config)
    numbers |= {
        "finetune": options.finetune,
        "rate": options.rate if options.finetune else None,
        "bytes": size,
        "ply_ratio": numbers["ply_bytes"] / size,
        "stream_bytes": {entry["name"]: entry["bytes"] for entry in decoded.header["streams"]},
    }
    lines = [
        f"{output}: {count:,} splats with latents of {numbers['rank']} numbers, {size / 1e6:.2f} MB, "
        f"{size / count:.1f} bytes a splat: 3DGS's PLY of as many splats has {numbers['ply_bytes'] / 1e6:.2f} MB, "
        f"{numbers['ply_ratio']:.1f} times as much."
    ]
    lines += [lost(numbers)] if measure else []
    lines += [f"Look at it with:  nrfgs view {output}", f"Evaluate it with:  ns-eval --load-config {config}"]
    finish(lines, numbers, report)


def check_head(head: AppearanceHead, load_config: Path) -> None:
    if not isinstance(head, NeuralResidualField):
        raise InputError(
            f"{load_config}: compact files and pages hold a neural residual field, and this model has the "
            f"{head.name!r} head. Use nrfgs export ply."
        )


def packed(pipeline, options: CompactOptions) -> tuple[dict, dict, dict[str, Any]]:
    """The header and streams of a model's compact file, fine-tuned if asked for, and their numbers for a report."""
    model, begin = pipeline.model, perf_counter()
    field, steps = model.field.detached(), None
    if options.finetune > 0:
        with progress("Training for the file", -(-options.finetune // REPORT_EVERY)) as advance:
            field, steps = fine_tune(
                pipeline,
                options.finetune,
                options.rate,
                lambda bits: advance(f"Training for the file ({bits / 8e6:.2f} MB)"),
            )
    else:  # the same field in fewer bytes: components of latents that hardly matter are rounded to 0
        basis = latent_basis(field, torch.ones(model.num_points, device=model.device))
        field = with_rank(field, basis, field.head.config.latent_dim)
    trained = perf_counter()
    render = {"rasterize_mode": model.config.rasterize_mode, "background": model.background_color.tolist()}
    header, streams = encode(field, render, steps)
    count = sum(header["splats"].values())
    numbers = {
        "splats": model.num_points,
        "written": count,
        "rank": header["head"]["config"]["latent_dim"],
        "seconds": {"finetune": trained - begin, "encode": perf_counter() - trained},
        "ply_bytes": PLY_BYTES * count,
    }
    return header, streams, numbers


def write_config(load_config: Path, output: Path, head: NrfConfig) -> Path:
    """Write what nerfstudio's commands need to read FILE.nrf into FILE.nrf.nerfstudio/METHOD/compact: a config.yml,
    whose path is returned, and an empty checkpoint. Relative paths stay relative, as nerfstudio's."""
    config = read_config(load_config)
    find_data(config, load_config)
    config.output_dir, config.experiment_name, config.timestamp = output.parent, f"{output.name}.nerfstudio", "compact"
    config.relative_model_dir = Path("nerfstudio_models")
    config.load_dir = config.load_checkpoint = config.load_step = None
    config.pipeline.compact = output
    config.pipeline.model.appearance = head
    config.pipeline.model.camera_optimizer.mode = "off"
    config.pipeline.model.use_bilateral_grid = False
    models = config.get_checkpoint_dir()
    models.mkdir(parents=True, exist_ok=True)
    for older in models.glob("step-*.ckpt"):
        older.unlink()
    step = max(config.max_num_iterations, 1) - 1
    torch.save({"step": step, "pipeline": {}}, models / f"step-{step:09d}.ckpt")
    path = config.get_base_dir() / "config.yml"
    write_whole(path, yaml.dump(config))
    return path


def measure_file(pipeline, config: Path) -> dict[str, Any]:
    """`measure_loss` of a file, read as ns-eval reads it, by the config.yml beside it."""
    small = load_model(config, "test").model
    return measure_loss(pipeline, lambda camera: {"file": small.get_outputs_for_camera(camera)["rgb"]})
