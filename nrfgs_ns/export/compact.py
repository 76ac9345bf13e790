# SPDX-License-Identifier: Apache-2.0
"""`nrfgs export compact`: choose what is left out, write the file, and a config.yml with which nerfstudio reads it."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
import torch
import yaml
from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from torch import Tensor

from nrfgs_ns.appearance.field import Field
from nrfgs_ns.appearance.nrf import NeuralResidualField
from nrfgs_ns.compact.decode import decode
from nrfgs_ns.compact.encode import encode
from nrfgs_ns.compact.finetune import fine_tune, prepared
from nrfgs_ns.compact.format import write_container
from nrfgs_ns.compact.options import CompactOptions
from nrfgs_ns.data.views import evenly_spaced
from nrfgs_ns.errors import InputError
from nrfgs_ns.export.loading import find_data, load_model, measure_loss
from nrfgs_ns.files import write_whole
from nrfgs_ns.model.view_noise import ViewNoise, camera_spacing
from nrfgs_ns.simplify.field_views import FieldViews, slim
from nrfgs_ns.simplify.residuals import look_over
from nrfgs_ns.training.config_file import read_config

PLY_BYTES = 62 * 4
"""Of one splat in 3DGS's PLY file, with harmonics of degree 3."""


def export_compact(
    load_config: Path, output: Path, options: CompactOptions, measure: bool, report: Path | None
) -> None:
    """See `nrfgs export --help`."""
    check_options(options)
    pipeline = load_model(load_config, "test")
    header, streams, numbers = packed(pipeline, load_config, options)
    begin = perf_counter()
    size = write_container(output, header, streams)
    written = perf_counter()
    decode(output)
    numbers["seconds"]["encode"] += written - begin
    numbers["seconds"]["decode"] = perf_counter() - written
    config, count = write_config(load_config, output), numbers["written"]
    numbers |= {
        "finetune": options.finetune,
        "rate": options.rate if options.finetune else None,
        "bytes": size,
        "ply_ratio": numbers["ply_bytes"] / size,
        "stream_bytes": stream_bytes(output),
        "precision": asdict(options.precision),
    }
    CONSOLE.print(
        f"{output}: {count:,} splats, {header['splats']['view']:,} of them view-dependent with latents of "
        f"{numbers['rank']} numbers, {size / 1e6:.2f} MB, {size / count:.1f} bytes a splat: 3DGS's PLY of as many "
        f"splats has {numbers['ply_bytes'] / 1e6:.2f} MB, {numbers['ply_ratio']:.1f} times as much.",
        markup=False,
        soft_wrap=True,
    )
    if measure:
        numbers |= measure_file(pipeline, config)
        lost = round(numbers["loss_db"], 3) + 0.0  # without the sign of a -0.0
        CONSOLE.print(
            f"PSNR on {len(numbers['per_image'])} test views: model {numbers['psnr_model']:.2f} dB, file "
            f"{numbers['psnr_file']:.2f} dB: it loses {lost:.3f} dB."
        )
    CONSOLE.print(f"Read it with:  ns-eval --load-config {config}", markup=False, soft_wrap=True)
    if report is not None:
        write_whole(report, json.dumps(numbers, indent=1) + "\n")


def packed(pipeline, load_config: Path, options: CompactOptions) -> tuple[dict, dict, dict[str, Any]]:
    """The header and streams of a model's compact file, and what a report says of them."""
    chosen = choose(pipeline, load_config, options)
    begin = perf_counter()
    field, steps = trained_for_the_file(pipeline, chosen, options)
    trained = perf_counter()
    header, streams = encode(field, options.precision, rendered(pipeline.model), steps)
    count = sum(header["splats"].values())
    numbers = {
        "splats": pipeline.model.num_points,
        "written": count,
        "view_dependent": header["splats"]["view"],
        "rank": header["head"]["config"]["latent_dim"],
        "threshold": chosen.threshold if chosen.threshold != float("inf") else None,
        "seconds": {"finetune": trained - begin, "encode": perf_counter() - trained},
        "ply_bytes": PLY_BYTES * count,
    }
    return header, streams, numbers


class Chosen(NamedTuple):
    """What of a model is written."""

    field: Field
    threshold: float
    """residuals below so many 8-bit steps are dropped; 0 for none"""
    weight: Tensor
    """what each splat contributes to the training views, pixels. [N]"""


def rendered(model) -> dict[str, Any]:
    """What decides a picture beside the field, for a file's header."""
    return {"rasterize_mode": model.config.rasterize_mode, "background": model.background_color.tolist()}


def trained_for_the_file(
    pipeline, chosen: Chosen, options: CompactOptions
) -> tuple[Field, dict[str, np.ndarray] | None]:
    """The chosen field after the fine-tune that the options ask for, and the steps on which it lies; without one, the
    field as it is."""
    if options.finetune == 0:
        return chosen.field, None
    model = pipeline.model
    centers = pipeline.datamanager.train_dataset.cameras.camera_to_worlds[:, :3, 3]
    noise = ViewNoise.as_long_as(model.noise_factor * camera_spacing(centers), torch.initial_seed())
    columns = TextColumn("Training for the file {task.description}"), BarColumn(), TimeRemainingColumn()
    with Progress(*columns, console=CONSOLE, transient=True) as progress:
        task = progress.add_task("", total=options.finetune)

        def tell(step: int, bits: float) -> None:
            progress.update(task, completed=step, description=f"({bits / 8e6:.2f} MB)")

        next_view = pipeline.datamanager.next_train
        field, steps = prepared(chosen.field, chosen.weight), options.finetune
        tuned = fine_tune(model, field, next_view, noise, len(centers), steps, options.rate, options.precision, tell)
    return tuned.field, tuned.steps


def check_options(options: CompactOptions) -> None:
    """Raise InputError, naming the option, if a value cannot work."""
    options.precision.validate()
    if options.views < 1:
        raise InputError(f"--compact.views is {options.views}; it must be at least 1.")
    if options.finetune < 0:
        raise InputError(f"--compact.finetune is {options.finetune}; it must be 0 or a number of steps.")
    for name in ("budget", "threshold", "rate"):
        value = getattr(options, name)
        if value is not None and not value >= 0:
            raise InputError(f"--compact.{name} is {value}; it must be zero or positive.")


def choose(pipeline, load_config: Path, options: CompactOptions) -> Chosen:
    """The field to write, slimmed as the options say. A fine-tune finds out by itself what is not worth its bytes:
    before it, nothing is left out that the options do not name."""
    model, data = pipeline.model, pipeline.datamanager
    if not isinstance(model.head, NeuralResidualField):
        raise InputError(
            f"--load-config {load_config}: a compact file holds a neural residual field, and this model has the "
            f"{model.head.name!r} head. Use nrfgs export ply."
        )
    size = model.head.config.latent_dim
    if options.rank is not None and not 1 <= options.rank <= size:
        raise InputError(f"--compact.rank is {options.rank}; this model's latents have ranks 1 to {size}.")
    threshold, rank = options.threshold, options.rank
    if options.finetune > 0:
        threshold, rank = threshold or 0.0, rank or size
    with torch.no_grad():
        field = model.field.detached()
        images = data.cached_train  # before the cameras: undistortion crops them while it loads the images
        cameras = data.train_dataset.cameras
        with CONSOLE.status(f"Looking at the splats from {len(cameras)} training views"):
            seen = look_over(model, cameras)
        chosen = evenly_spaced(len(images), options.views)
        pairs = [(cameras[i : i + 1].to(model.device), images[i]) for i in chosen]
        views = FieldViews(model, pairs, photographs_of(model, data.train_dataset.image_filenames, chosen))
        columns = TextColumn("{task.description:<40}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
        with Progress(*columns, console=CONSOLE, transient=True) as progress:
            task = progress.add_task("Choosing what to leave out", total=None)
            slimmed = slim(
                field,
                seen,
                views,
                views.psnr(field) - options.budget,
                threshold,
                rank,
                lambda what: progress.update(task, description=f"Without {what}", advance=1),
            )
    return Chosen(slimmed.field, slimmed.threshold, seen.weight)


def photographs_of(model, files: Sequence[Path], chosen: Sequence[int]) -> list[int | None]:
    """Which photographs of a model the chosen training images are; None for those that it has not learnt."""
    known = [] if model.photograph is None else model.photograph.names
    return [i if i < len(known) and known[i] == Path(files[i]).name else None for i in chosen]


def stream_bytes(path: Path) -> dict[str, int]:
    """How the bytes of a file are spread over its streams, by name."""
    from nrfgs_ns.compact.format import read_container

    header, _ = read_container(path)
    return {entry["name"]: entry["bytes"] for entry in header["streams"]}


def write_config(load_config: Path, output: Path) -> Path:
    """Write what nerfstudio's commands need to find a compact file: a config.yml, whose path is returned, and a
    checkpoint that says nothing.

    For FILE.nrf they are in FILE.nrf.nerfstudio/METHOD/compact: a folder named FILE may be somebody's data. Paths are
    as they were given, so relative ones count from the folder in which the commands are run, as in every config.yml of
    nerfstudio.
    """
    config = read_config(load_config)
    find_data(config, load_config)
    config.output_dir, config.experiment_name, config.timestamp = output.parent, f"{output.name}.nerfstudio", "compact"
    config.relative_model_dir = Path("nerfstudio_models")
    config.load_dir = config.load_checkpoint = config.load_step = None
    config.pipeline.compact = output
    config.pipeline.model.appearance = decode(output).config
    # What only the training had.
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
