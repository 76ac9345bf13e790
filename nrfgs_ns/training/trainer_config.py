# SPDX-License-Identifier: Apache-2.0
"""The trainer's options: checks before anything is read or written, automatic values, a training's folder."""

import math
import os
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import count
from operator import attrgetter
from pathlib import Path
from pkgutil import resolve_name

import torch
from nerfstudio.data.dataparsers.nerfstudio_dataparser import MAX_AUTO_RESOLUTION
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils.rich_utils import CONSOLE

from nrfgs_ns.data.dataparser import NrfgsDataParserConfig
from nrfgs_ns.errors import InputError, refusing, require, shown
from nrfgs_ns.training import checkpoint_files
from nrfgs_ns.training.config_file import check_types
from nrfgs_ns.training.pace import FEWEST_STEPS, STEPS, Pace, TimedPace, steps_for

AVERAGED = 200
"""Steps to average in the presets and where the steps are chosen by the views."""
MOST = 2**32
"""Bound of all numbers; numpy takes no larger seed."""
LONGEST_SIDE = 240
"""Pixels of photographs that two CPU cores train on in minutes."""
FEW = 0.9
"""Trust in view dependence below which its reduction is reported on the terminal: 180 training views."""
PLAIN = {"markup": False, "highlight": False, "soft_wrap": True}
"""Text for the console that may hold brackets and paths."""


@dataclass
class NrfgsTrainerConfig(TrainerConfig):
    """Nerfstudio's trainer options."""

    _target: type = field(default_factory=lambda: resolve_name("nrfgs_ns.training.trainer:NrfgsTrainer"))
    max_num_iterations: int = STEPS
    """training steps. 0: 120 for each training view, from 10,000 to 30,000 (docs/captures.md)"""
    time_budget: float | None = None
    """minutes for all steps; schedules are stretched to the steps that fit"""
    schedule_steps: int | None = None
    """steps for which schedules are given; they are stretched to the actual steps. None: 30,000 if max_num_iterations
    is 0; otherwise max_num_iterations with a time budget, and not stretched without"""
    average_steps: int | None = None
    """last steps to average parameters over, at most a fiftieth of all. None: 200 if max_num_iterations is 0, else 0"""

    def __post_init__(self) -> None:
        file = self.load_config  # all that ns-train takes, if it is given
        if file and (not file.is_file() or self.load_dir or self.load_checkpoint or self.data):
            raise InputError(f"--load-config {file}: name an existing config.yml, and no other option: it trains anew.")

    def setup(self, **kwargs) -> Trainer:
        """The trainer, for several devices the one that spreads the splats over them; InputError as `check`."""
        devices = kwargs.get("world_size", 1)
        self.check(devices)
        if devices == 1:
            return super().setup(**kwargs)
        whole = replace(self, max_num_iterations=self.max_num_iterations or STEPS).for_views(0)  # not stretched
        return resolve_name("nrfgs_ns.distributed.trainer:ShardedTrainer")(whole, **kwargs)

    def check(self, devices: int) -> None:
        """Raise InputError where an option is out of range, is not for several devices, or names no checkpoint."""
        for name in ("mixed_precision", "use_grad_scaler", "gradient_accumulation_steps", "log_gradients"):
            if value := getattr(self, name):
                raise InputError(f"{name} is {value}; these methods train without it. Leave it out.")
        positive = math.ulp(0.0)
        data = self.pipeline.datamanager
        if color := getattr(data.dataparser, "mask_color", None):
            fix = "Leave it out, or make them transparent and choose --pipeline.model.background-color."
            name = "pipeline.datamanager.dataparser.mask_color"
            raise InputError(f"{name} is {color}; masked pixels are not trained on, whatever their colour. {fix}")
        order = data.train_cameras_sampling_strategy
        name = "pipeline.datamanager.train_cameras_sampling_strategy"
        require(order == "random", name, order, "random, as these methods draw cameras")
        lowest = {
            positive: ("time_budget", "schedule_steps", "pipeline.datamanager.camera_res_scale_factor"),
            0: ("max_num_iterations", "average_steps", "pipeline.datamanager.max_thread_workers", "machine.seed"),
            1: ("logging.steps_per_log", "machine.num_devices", "machine.num_machines"),
        }
        limits = [(name, attrgetter(name)(self), low) for low, names in lowest.items() for name in names]
        for group, parts in self.optimizers.items():
            name = f"optimizers.{group}"
            schedule = parts["scheduler"]
            falls = isinstance(schedule, ExponentialDecaySchedulerConfig)  # which zero cannot
            limits.append((f"{name}.optimizer.lr", parts["optimizer"].lr, positive if falls else 0))
            if falls:
                limits.append((f"{name}.scheduler.lr_final", schedule.lr_final, positive))
                limits.append((f"{name}.scheduler.max_steps", schedule.max_steps, schedule.warmup_steps + 1))
        for name, value, low in limits:
            least = "positive" if low == positive else f"at least {low}"
            require(value is None or low <= value < MOST, name, value, f"{least}, and below 2^32")
        if devices == 1 and self.machine.device_type == "cuda" and not torch.cuda.is_available():
            raise InputError("machine.device_type is cuda, but PyTorch finds no GPU (`nrfgs doctor`). Give cpu.")
        check_types(self.pipeline, "config.yml", "pipeline.")
        model = self.pipeline.model
        model.check()
        is_of_one = model.twin == "on" or model.robust_loss > 0 or (self.time_budget or self.schedule_steps) is not None
        if devices > 1 and is_of_one:
            names = "time_budget, schedule_steps, pipeline.model.twin and pipeline.model.robust_loss"
            raise InputError(f"{names} are for one device. Leave them out.")
        if self.load_step is not None and self.load_dir is None:
            raise InputError(f"load_step is {self.load_step}, but there is no --load-dir. Give the folder, too.")
        if None not in (self.load_dir, self.load_checkpoint):
            raise InputError("--load-dir and --load-checkpoint both name a checkpoint. Give one.")
        if self.load_dir is not None:
            checkpoint_files.checkpoints_in(self.load_dir)
        elif (file := self.load_checkpoint) is not None and not file.is_file():
            raise InputError(f"load_checkpoint is {file}, which is no file. Give a checkpoint, or --load-dir a folder.")

    def for_views(self, views: int) -> "NrfgsTrainerConfig":
        """The configuration of a training on one device, with automatic steps, schedules and mean filled in."""
        if self.max_num_iterations > 0:
            return replace(self, average_steps=self.average_steps or 0)
        return replace(
            self,
            max_num_iterations=STEPS if self.time_budget is not None else steps_for(views),
            schedule_steps=STEPS if self.schedule_steps is None else self.schedule_steps,
            average_steps=AVERAGED if self.average_steps is None else self.average_steps,
        )

    def pace(self) -> Pace | None:
        """How fast to walk through the schedules (`pace.py`), or None for a step at a time."""
        length = self.schedule_steps or self.max_num_iterations
        if self.time_budget is not None:
            model = self.pipeline.model
            doublings = [model.resolution_schedule * n for n in range(1, model.num_downscales + 1)]
            return TimedPace(length, 60.0 * self.time_budget, doublings)
        return None if self.schedule_steps is None else Pace(length, length / self.max_num_iterations)

    def print_to_terminal(self) -> None:
        """Check the options before anything is written, and print ns-train's first line instead of the configuration.
        InputError as `check`, or where there is no data."""
        devices = self.machine.num_devices * self.machine.num_machines
        self.check(devices)
        datamanager = self.pipeline.datamanager
        data = self.data or datamanager.data
        parser = datamanager.dataparser
        is_here = not isinstance(parser, NrfgsDataParserConfig) or Path("transforms.json").exists()
        if data is None and parser.data == Path() and not is_here:
            fix = "Name the folder of the data set; `nrfgs prepare PHOTOS SCENE` makes one from photographs."
            raise InputError(f"--data is missing. {fix}")
        if data is not None and not os.path.exists(data):
            raise InputError(f"--data {shown(str(data))}: no such file or folder. Check the path.")
        if devices > 1:
            resolve_name("nrfgs_ns.distributed.launch:prepare")(self)
        self._check_tracker()
        CONSOLE.print(f"{self.method_name} on {data or _absolute(parser.data)}", **PLAIN)

    def _check_tracker(self) -> None:
        """Raise InputError where wandb or comet is missing or lacks a key: nerfstudio starts them when the photographs
        are read. At a terminal wandb asks for its key."""
        fix = "Install it by pip and log in (`wandb login`, `comet login`), or give --vis tensorboard."
        with refusing(f"vis is {self.vis}, which cannot start", fix, Exception):  # each has its own
            if self.is_wandb_enabled():
                resolve_name("wandb").login()
            elif self.is_comet_enabled() and not resolve_name("comet_ml").get_config("comet.api_key"):
                raise ValueError("No API key")

    def save_config(self) -> None:
        """Make the training's folder and save config.yml there, with absolute paths; InputError where that fails."""
        data = self.pipeline.datamanager
        dataparser = replace(data.dataparser, data=_absolute(data.dataparser.data))
        pipeline = replace(self.pipeline, datamanager=replace(data, data=_absolute(data.data), dataparser=dataparser))
        with refusing(f"--output-dir {self.output_dir} cannot be written", "Name another one.", OSError):
            self._take_a_folder()
            whole = replace(self, pipeline=pipeline, data=_absolute(self.data), output_dir=_absolute(self.output_dir))
            TrainerConfig.save_config(whole)

    def _take_a_folder(self) -> None:
        """Make a folder for this training alone, numbering a taken name; one that goes on in its own keeps it."""
        if (self.load_dir and self.load_dir.resolve(), self.load_step) == (self.get_checkpoint_dir().resolve(), None):
            return
        name = self.timestamp
        for number in count(2):
            with suppress(FileExistsError):
                return self.get_base_dir().mkdir(parents=True)
            self.timestamp = f"{name}_{number}"


def _absolute(path: Path | None) -> Path | None:
    return None if path is None else Path(path).absolute()


def report_choices(config: NrfgsTrainerConfig, pipeline, steps_are_chosen: bool, has_twin: bool) -> None:
    """Say what was chosen automatically."""
    model, data = pipeline.model, pipeline.datamanager.train_dataset
    views, given = model.num_views, model.num_train_data
    parts = [f"{steps_for(views):,} steps"] if steps_are_chosen else []
    parts += [f"view dependence reduced to {model.trust:.2g}, as suits few views"] if model.trust < FEW else []
    added = 0 if model.seed_points is None else len(model.seed_points[0]) - len(data.metadata["points3D_xyz"])
    parts += [f"{added:,} points from the photographs"] if added > 0 else []
    parts += ["trained twice, to agree between the cameras (--pipeline.model.twin off)"] if has_twin else []
    near = model.projection_options.near_plane
    parts += [f"nothing drawn nearer than {near / model.scene_unit:.2g} scene units"] if near == model.near else []
    words = f"{given} training view{'s' * (given != 1)}"
    count = words if views == given else f"{views} different training views of {given}"
    if parts:
        CONSOLE.print(f"{count}: {', '.join(parts)} (docs/captures.md).", soft_wrap=True)
    width, height = (int(side.max()) for side in (data.cameras.width, data.cameras.height))
    if (factor := data.metadata.get("factor", 1)) > 1 or max(width, height) > MAX_AUTO_RESOLUTION:
        size = f"1/{factor} of their size" if factor > 1 else "full size"
        CONSOLE.print(f"Images are read at {size}, {width} x {height} (--downscale-factor: docs/own-data.md).", **PLAIN)
    is_long = config.time_budget is None and config.max_num_iterations >= FEWEST_STEPS
    if config.machine.device_type == "cpu" and is_long and config.pipeline.datamanager.camera_res_scale_factor == 1:
        scale = round(LONGEST_SIDE / max(width, height), 2)
        words = "nrfgs-fast with --time-budget 10"
        words += f" --pipeline.datamanager.camera-res-scale-factor {scale:.2g}" * (scale < 1)
        CONSOLE.print(f"No CUDA device: the CPU trains. A result in ten minutes: {words}", **PLAIN)
