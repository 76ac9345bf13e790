# SPDX-License-Identifier: Apache-2.0
"""Trained models, loaded for evaluation, viewing and export, and the loss of a file made from one."""

import json
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from nrfgs_ns.compact.decode import decode, model_state
from nrfgs_ns.data.pictures import picture_names
from nrfgs_ns.errors import InputError
from nrfgs_ns.files import write_whole
from nrfgs_ns.image.metrics import psnr
from nrfgs_ns.model.config import NrfgsModelConfig
from nrfgs_ns.model.model import NrfgsModel
from nrfgs_ns.progress import progress
from nrfgs_ns.threads import few_threads
from nrfgs_ns.training.checkpoint_files import find, read_latest
from nrfgs_ns.training.config_file import read_config
from nrfgs_ns.training.pipeline import NrfgsPipeline, NrfgsPipelineConfig


class Trained(NamedTuple):
    """A finished training."""

    config: TrainerConfig
    pipeline: NrfgsPipeline
    """in evaluation mode"""
    checkpoint: Path
    step: int


@few_threads()
def load_training(path: Path, mode: Literal["test", "inference"]) -> Trained:
    """A finished training, set up as by nerfstudio's `eval_setup`, except that its config.yml runs no code.

    Mode "test" reads the test images; "inference" reads none, and fits harmonics to the head. InputError if there is no
    such training, or its method is not this project's.
    """
    config = read_config(path)
    if not isinstance(config.pipeline, NrfgsPipelineConfig):
        raise InputError(f"{path}: a training of {config.method_name}. Use nerfstudio's own commands for it.")
    places = [path.absolute().parent / config.relative_model_dir, config.get_checkpoint_dir()]
    folder = next((place for place in places if find(place)), None)
    if folder is None:
        tried = ", nor in ".join(map(str, dict.fromkeys(places)))
        raise InputError(f"{path}: no checkpoints in {tried}. Put them there, or train again.")
    find_data(config, path)
    if config.pipeline.compact is not None and not config.pipeline.compact.exists():  # moved with FILE.nerfstudio
        config.pipeline.compact = path.absolute().parents[2].with_suffix("")
    pipeline = config.pipeline.setup(device="cuda" if torch.cuda.is_available() else "cpu", test_mode=mode)
    pipeline.eval()
    checkpoint, content = read_latest(folder)
    pipeline.load_pipeline(content["pipeline"], content["step"])
    return Trained(config, pipeline, checkpoint, content["step"])


def find_data(config: TrainerConfig, path: Path) -> None:
    """Set the data set's present place: as stored, or, since outputs and data may be moved together, the same relative
    to config.yml; InputError if it is in neither."""
    manager = config.pipeline.datamanager
    stored = manager.data or manager.dataparser.data
    if stored is None or stored.exists():
        return
    begin = config.output_dir.absolute()
    now = path.absolute().parents[3:4]  # outputs/EXPERIMENT/METHOD/TIME/config.yml
    places = [(folder / os.path.relpath(stored.absolute(), begin)).resolve() for folder in now if folder != begin]
    place = next((place for place in places if place.exists()), None)
    if place is None:
        tried = "".join(f", nor at {place}" for place in places)
        raise InputError(f"{path}: its data set is not at {stored}{tried}. Put it there, or change both `data` in it.")
    config.data = manager.data = manager.dataparser.data = place


def load_model(path: Path, mode: Literal["test", "inference"], measured: bool = False) -> NrfgsPipeline:
    """The pipeline of `load_training`; InputError also without splats, or if masks leave nothing to be measured."""
    pipeline = load_training(path, mode).pipeline
    if pipeline.model.num_points == 0:
        raise InputError(f"{path}: this training has lost all splats. Train again with other options or data.")
    if measured and all("mask" in data and not data["mask"].any() for data in pipeline.datamanager.cached_eval):
        raise InputError(f"{path}: no test image has pixels inside its mask. Correct it, or export with --no-measure.")
    return pipeline


@few_threads()
def load_file(path: Path) -> NrfgsModel:
    """The model in a compact file, in evaluation mode, without config.yml or data set; InputError as `decode`."""
    decoded = decode(path)
    means = decoded.splats["means"]
    mode, background = (decoded.header["render"][name] for name in ("rasterize_mode", "background"))
    name = {(0, 0, 0): "black", (1, 1, 1): "white"}.get(tuple(background), "random")
    config = NrfgsModelConfig(appearance=decoded.config, rasterize_mode=mode, background_color=name, near_plane="auto")
    model = config.setup(
        scene_box=SceneBox(torch.stack([means.amin(0), means.amax(0)])),
        num_train_data=1,
        metadata={"scene_unit": decoded.header["head"]["scene_unit"]},
        seed_points=(means, torch.zeros_like(means)),
    )
    model.load_state_dict(model_state(model, decoded))
    model.background_color = torch.tensor(background, dtype=torch.float32)
    return model.to("cuda" if torch.cuda.is_available() else "cpu").eval()


@torch.no_grad()
def measure_loss(pipeline, pictures: Callable[[Any], dict[str, Tensor]]) -> dict[str, Any]:
    """Compare pictures with the photographs of the test views, of which some have pixels inside their masks.

    Args:
        pictures: camera -> images [H, W, 3] by name, one of them "file".

    Returns:
        means over the images, dB, inside their masks: psnr_model, psnr_NAME; loss_db: model minus file; per_image; and
        views: "test", or where no image is kept for testing "training".
    """
    model, data = pipeline.model, pipeline.datamanager
    names = picture_names(data.eval_dataset.image_filenames)
    per_image = []
    with progress("Measuring the loss", len(names)) as advance:
        for image, (camera, batch) in zip(names, data.fixed_indices_eval_dataloader, strict=True):
            outputs = model.get_outputs_for_camera(camera)
            truth = model.truth_of(batch, outputs["background"])
            mask = model.mask_of(batch)
            rendered = {"model": outputs["rgb"], **pictures(camera)}
            scores = {f"psnr_{name}": psnr(picture, truth, mask) for name, picture in rendered.items()}
            if None not in scores.values():  # None: no pixel inside the mask
                per_image.append({"image": image, **scores})
            advance()
    means = {key: sum(image[key] for image in per_image) / len(per_image) for key in scores}
    loss = means["psnr_model"] - means["psnr_file"]
    return {**means, "loss_db": loss, "views": data.evaluated_split, "per_image": per_image}


def finish(lines: Iterable[str], numbers: dict[str, Any], report: Path | None) -> None:
    """Print an export's result, and write its numbers as JSON into `report`, if given."""
    for line in lines:
        CONSOLE.print(line, markup=False, soft_wrap=True)
    if report is not None:
        write_whole(report, json.dumps(numbers, indent=1) + "\n")


def lost(numbers: dict[str, Any]) -> str:
    """`measure_loss` in a sentence."""
    count = len(numbers["per_image"])
    loss = numbers["loss_db"]
    views = f"one {numbers['views']} view" if count == 1 else f"{count} {numbers['views']} views"
    change = f"{abs(loss):.2f} dB {'lost' if loss > 0 else 'gained'}" if abs(loss) >= 0.005 else "nothing lost"
    return f"PSNR on {views}: model {numbers['psnr_model']:.2f} dB, file {numbers['psnr_file']:.2f} dB ({change})."
