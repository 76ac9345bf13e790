# SPDX-License-Identifier: Apache-2.0
"""Nerfstudio's pipeline with early checks, evaluation in which a metric may be missing, and exact resume; and a step of
a training."""

import json
import random
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from functools import partial, reduce
from pathlib import Path
from statistics import fmean, median
from time import perf_counter
from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import track
from rich.table import Column, Table
from torch import Tensor
from torch.nn import Parameter
from torchvision.utils import save_image

from nrfgs_ns.appearance.head import AppearanceHead
from nrfgs_ns.compact.decode import decode, model_state
from nrfgs_ns.data.checks import some, warn
from nrfgs_ns.data.datamanager import NrfgsDatamanagerConfig
from nrfgs_ns.data.pictures import picture_names
from nrfgs_ns.densification import statistics
from nrfgs_ns.errors import InputError
from nrfgs_ns.image import ssim
from nrfgs_ns.image.metrics import METRIC_NAMES, lpips_advice
from nrfgs_ns.kernels.trial import tried_meanwhile
from nrfgs_ns.model.config import NrfgsModelConfig
from nrfgs_ns.rasterizer import load_kernels
from nrfgs_ns.threads import few_threads
from nrfgs_ns.training import optimizers
from nrfgs_ns.training.checkpoint_files import allow_nerfstudio_checkpoints
from nrfgs_ns.training.config_file import check_types
from nrfgs_ns.training.identity import check_data_set, data_set_of
from nrfgs_ns.training.photographs import photograph_model
from nrfgs_ns.training.step_graph import StepGraphs
from nrfgs_ns.viewer.panel import ViewerPanel

SHOWN = ("psnr", "cc_psnr", "ssim", "cc_ssim", "ms_ssim", "lpips", "l1", "seconds_per_image", "splats")
"""Columns of an evaluation's table."""

Gradients = dict[Parameter, Tensor]


@dataclass
class ShardingConfig:
    """No options: a config.yml of version 0.2.0 names this class."""


@dataclass
class NrfgsPipelineConfig(VanillaPipelineConfig):
    """Nerfstudio's pipeline options."""

    _target: type = field(default_factory=lambda: NrfgsPipeline)
    datamanager: NrfgsDatamanagerConfig = field(default_factory=NrfgsDatamanagerConfig)
    """specifies the datamanager config"""
    model: NrfgsModelConfig = field(default_factory=NrfgsModelConfig)
    """specifies the model config"""
    compact: Path | None = None
    """read the model from a file of `nrfgs export compact` instead of the checkpoint; not for training"""


class NrfgsPipeline(VanillaPipeline):
    """VanillaPipeline that reads every image before the first step, so that a broken one costs no training time,
    evaluates to null where a metric is undefined, and resumes exactly from its checkpoints."""

    config: NrfgsPipelineConfig

    @few_threads()  # a start is many small operations
    def __init__(self, config: NrfgsPipelineConfig, device: str, test_mode: str = "val", **kwargs):
        allow_nerfstudio_checkpoints()
        parser = getattr(config.datamanager, "dataparser", None)
        if isinstance(factor := getattr(parser, "downscale_factor", None), float) and factor.is_integer():
            parser.downscale_factor = int(factor)  # `ns-render dataset` reads it as a float
        check_types(config, "config.yml", "pipeline.")  # nerfstudio's commands construct whatever the file holds
        if test_mode == "val" and config.compact is not None:
            raise InputError(f"pipeline.compact is {config.compact}; a training begins with --load-dir. Leave it out.")
        on_cuda = torch.device(device).type == "cuda"
        wake = [partial(torch.empty, 1, device=device)] if on_cuda else []
        with tried_meanwhile(wake, torch.device(device)):  # CUDA starts while the data set is checked
            super().__init__(config, device, test_mode, **kwargs)
        self.model.viewer_panel = ViewerPanel(self.model)
        if test_mode == "val":  # ns-train; ns-eval and ns-render read the images that they need
            trials = [partial(trial, self.model.device) for trial in kernels_of(self.model.head) if on_cuda]
            with tried_meanwhile(trials, self.model.device):
                self.datamanager.load_all_images()
                photographs = photograph_model(config.model, self.datamanager)
            self.model.learn_photographs(photographs)
        if test_mode == "inference":  # ns-export (and ns-render, which asks for no harmonics)
            self.model.fit_on(self.cameras_to_fit)

    @property
    def cameras_to_fit(self) -> Cameras:
        """The training cameras in the size that a downscale factor gives the training, also where nerfstudio gives them
        the photographs'. The fit halves what is still large (`harmonics_fit.no_larger`)."""
        cameras = deepcopy(self.datamanager.train_dataset.cameras)
        parser = self.datamanager.dataparser
        if self.test_mode == "inference" and hasattr(type(parser), "downscale_factor"):  # which nerfstudio has set to 1
            cameras.rescale_output_resolution(1 / (parser.config.downscale_factor or 1))
        return cameras

    def load_pipeline(self, loaded_state: dict[str, Any], step: int) -> None:
        """Load a checkpoint, or the compact file that the configuration names; InputError if it does not fit.

        A training does not go on with another data set; other commands load the model with a warning.
        """
        training = self.test_mode == "val"
        if (scene := loaded_state.get("_extra_state", {}).get("scene")) is not None:  # a compact file has none
            here, data = data_set_of(self.datamanager.train_dataset), self.datamanager.get_datapath()
            try:
                check_data_set(scene, here, data, training)
            except InputError as error:
                if training:
                    raise
                warn(f"{error} Here metrics are wrong, and so is what is fitted to the views.")
            tests = {Path(name).name for name in self.datamanager.eval_dataset.image_filenames}
            if known := sorted(tests & set(scene["images"]) - set(here["images"])):
                warn(f"{data}: test images were trained on ({some(known)}), whose results this flatters.")
        if self.config.compact is not None:
            state = model_state(self.model, decode(self.config.compact))
            loaded_state = {f"_model.{name}": value for name, value in state.items()}
        were_learnt = "_model.photograph._extra_state" in loaded_state
        if training and were_learnt == (self.model.photograph is None):
            theirs, ours = ("on", "off") if were_learnt else ("off", "on")
            choice = f"--pipeline.model.photographs {theirs}, not {ours}"
            raise InputError(f"The checkpoint had {choice}. Set it or train anew.")
        super().load_pipeline(loaded_state, step)

    def train(self, mode: bool = True):
        # Called before every step: walking through all modules for nothing costs the host time.
        return self if self.training == self.model.training == mode else super().train(mode)

    def get_train_loss_dict(self, step: int, graphs: StepGraphs | None = None, with_metrics: bool = True):
        """Outputs, losses and metrics of a step. The losses of a step recorded in `graphs` need no gradient: the
        parameters have theirs."""
        camera, batch = self.datamanager.next_train(step)
        if graphs is not None and graphs.prepare(camera, batch, step):
            outputs, losses = graphs.run(batch)
        else:
            outputs = self.model.get_outputs(camera)
            losses = self.model.get_loss_dict(outputs, batch)
        return outputs, losses, self.model.get_metrics_dict(outputs, batch) if with_metrics else {}

    def get_average_eval_image_metrics(
        self, step: int | None = None, output_path: Path | None = None, get_std: bool = False
    ) -> dict[str, Any]:
        """Evaluate all test images; with pictures of each if there is an `output_path`.

        Args:
            step: unused; nerfstudio passes it.
            get_std: also report deviations, nulls, "views" ("test" or "training") and each image's values (what
                `ns-eval` writes); without it only numbers, which a tensorboard can show.

        Returns:
            Means over images of `METRIC_NAMES`; seconds_per_image (rendering alone, without the first image) and its
            inverse fps; splats; parameter_bytes.
        """
        self.eval()
        if output_path is not None:
            output_path.mkdir(exist_ok=True, parents=True)
        names = picture_names(self.datamanager.eval_dataset.image_filenames)
        views = list(zip(names, self.datamanager.fixed_indices_eval_dataloader, strict=True))
        per_image: list[dict[str, Any]] = []
        for index, (name, (camera, batch)) in enumerate(track(views, "Evaluating", console=CONSOLE, transient=True)):
            start = perf_counter()
            outputs = self.model.get_outputs_for_camera(camera=camera)
            if outputs["rgb"].is_cuda:
                torch.cuda.synchronize()
            seconds = perf_counter() - start
            metrics, pictures = self.model.get_image_metrics_and_images(outputs, batch)
            per_image.append({"image": name, **metrics, "seconds_per_image": seconds})
            for key, picture in pictures.items() if output_path is not None else ():
                file = output_path / f"eval_{key}_{index:04d}_{Path(name).stem}.png"
                save_image(picture.permute(2, 0, 1).cpu(), file)
        self.train()

        seconds = fmean(image["seconds_per_image"] for image in per_image[1:] or per_image)
        result = means_of(per_image, get_std) | {"seconds_per_image": seconds, "fps": 1.0 / seconds}
        result |= {"splats": self.model.num_splats, "parameter_bytes": self.model.parameter_bytes}
        if get_std:
            result |= {"views": self.datamanager.evaluated_split, "per_image": per_image}
            print_evaluation(result)
        return result

    def get_extra_state(self) -> dict[str, Any]:
        """Random generators, order of the cameras and data set, as what torch reads without trusting the file."""
        return {
            "torch_rng": torch.get_rng_state(),
            "cuda_rng": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
            "python_rng": json.dumps(random.getstate()),
            "sampling": self.datamanager.sampling_state(),
            "scene": data_set_of(self.datamanager.train_dataset),
        }

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore what `get_extra_state` gave, in a training; an evaluation ignores it."""
        if self.test_mode != "val":
            return
        torch.set_rng_state(state["torch_rng"].cpu())
        if len(state["cuda_rng"]) == torch.cuda.device_count():
            torch.cuda.set_rng_state_all([rng.cpu() for rng in state["cuda_rng"]])
        version, numbers, gauss_next = json.loads(state["python_rng"])
        random.setstate((version, tuple(numbers), gauss_next))
        self.datamanager.load_sampling_state(state["sampling"])


def descend(training, step: int, pulled: Gradients, with_metrics: bool = False) -> tuple[Tensor, dict, dict]:
    """Make the step of a trainer or of a twin, down the loss of its next photograph.

    Args:
        training: has `pipeline`, `guard`, `optimizers`, `graphs` (None: steps are not recorded) and `world_size`.
        pulled: added to the gradients.

    Returns:
        the loss, its terms, and metrics if wanted.
    """
    optimizers = training.optimizers
    training.guard.begin(step, optimizers, settled_later=training.graphs is not None)
    optimizers.zero_grad_all()
    _, losses, metrics = training.pipeline.get_train_loss_dict(step, training.graphs, with_metrics)
    loss = reduce(torch.add, losses.values())
    if loss.requires_grad:  # a recorded step has made its gradients already
        loss.backward(torch.full_like(loss, 1.0 / training.world_size))  # the mean of the devices' losses
    for parameter, gradient in pulled.items():
        parameter.grad = gradient if parameter.grad is None else parameter.grad + gradient
    training.guard.before_optimizers(optimizers)
    optimizers.step()
    return loss, losses, metrics


def kernels_of(head: AppearanceHead) -> tuple[Callable[[torch.device], object], ...]:
    """Trials of a training's kernels on a CUDA device: gsplat's, whose trial raises what goes wrong, then Triton's."""
    return load_kernels, head.try_kernels, ssim.kernels_run_on, statistics.try_kernel, optimizers.try_kernel


def means_of(per_image: list[dict[str, Any]], with_deviations: bool) -> dict[str, Any]:
    """Means of `METRIC_NAMES` over images, and their standard deviations ("..._std") and nulls if wanted."""
    result: dict[str, Any] = {}
    for metric in METRIC_NAMES:
        values = [image[metric] for image in per_image if metric in image]
        if values or with_deviations:
            result[metric] = fmean(values) if values else None
        if with_deviations:
            numbers = torch.tensor(values, dtype=torch.float64)  # statistics.stdev takes no infinity
            result[f"{metric}_std"] = float(numbers.std()) if len(values) > 1 else None
    return result


def print_evaluation(result: Mapping[str, Any]) -> None:
    """Print the means over the views, the worst view, and how to get LPIPS where it is missing."""
    names = [name for name in SHOWN if result.get(name) is not None]
    views = result["per_image"]
    ranked = sorted((view["psnr"], view["image"]) for view in views if view.get("psnr") is not None)
    kind = result["views"]
    title = f"One {kind} view: not a mean, and no measure of the whole"
    CONSOLE.print(title if len(ranked) == 1 else f"Means over {len(ranked)} {kind} views", soft_wrap=True)
    table = Table(*(Column(name, justify="right") for name in names))
    table.add_row(*(f"{result[name]:,}" if name == "splats" else f"{result[name]:.4g}" for name in names))
    CONSOLE.print(table)
    if masked := [view["image"] for view in views if view.get("psnr") is None]:
        warn(f"Masks leave nothing to measure of {some(masked)}.")
    if len(ranked) > 1:
        worst, worst_view = ranked[0]
        middle = median(value for value, _ in ranked)
        line = f"Median view {middle:.1f} dB. Worst {worst:.1f} dB: {worst_view}. Pictures: --render-output-path FOLDER"
        CONSOLE.print(line, markup=False, soft_wrap=True)
    if result.get("lpips") is None and (advice := lpips_advice()) is not None:
        CONSOLE.print(advice, markup=False, soft_wrap=True)
