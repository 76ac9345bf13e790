# SPDX-License-Identifier: Apache-2.0
"""The trainer's options: what is refused before anything is read, what is chosen, where a training is written."""

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from pkgutil import resolve_name

from nerfstudio.configs.dataparser_configs import all_dataparsers
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils.rich_utils import CONSOLE

from nrfgs_ns.data.dataparser import NrfgsDataParserConfig
from nrfgs_ns.errors import DEBUG, InputError
from nrfgs_ns.training import checkpoint_files
from nrfgs_ns.training.cpu_command import ten_minute_command
from nrfgs_ns.training.pace import (
    FEWEST_STEPS,
    STEPS,
    STEPS_PER_VIEW,
    Pace,
    TimedPace,
    resolution_phases,
    steps_for,
)

TRAINER = "nrfgs_ns.training.trainer:NrfgsTrainer"
"""What these are the options of. It reads them, and is looked up by name when it is set up."""
SEVERAL_DEVICES = "nrfgs_ns.distributed"
"""The package that trains on several devices, likewise."""
AVERAGED = 200
"""Last steps whose mean is the trained model, where their number is chosen and in the presets."""
TIME_STAMP = re.compile(r"\d{4}-\d\d-\d\d_\d{6}")
"""What nerfstudio calls a training's folder if it is not told."""


@dataclass
class NrfgsTrainerConfig(TrainerConfig):
    """Nerfstudio's trainer options."""

    _target: type = field(default_factory=lambda: resolve_name(TRAINER))
    """target class to instantiate"""
    max_num_iterations: int = STEPS
    """training steps. 0: 120 for each training view, from 10,000 to 30,000, with schedules stretched to them
    (docs/captures.md)"""
    time_budget: float | None = None
    """minutes for all steps; schedules are stretched to the steps that fit"""
    schedule_steps: int | None = None
    """steps for which schedules are given; they are stretched to the actual steps. None: not stretched; with a time
    budget: max_num_iterations"""
    average_steps: int | None = None
    """last steps over which the model's parameters are averaged. 0: none. None: 200 if max_num_iterations is 0,
    otherwise 0"""

    def setup(self, **kwargs) -> Trainer:
        """The trainer; for several devices, the one that spreads the splats over them (`distributed`).

        Raises:
            InputError: an option is out of range, cannot be had on several devices, or there is nothing to go on from.
        """
        with nothing_left_where_refused(self):
            self._check(kwargs.get("world_size", 1))
            if kwargs.get("world_size", 1) == 1:
                return super().setup(**kwargs)
            # Schedules are not stretched there.
            whole = replace(
                self, max_num_iterations=self.max_num_iterations or STEPS, average_steps=self.average_steps or 0
            )
            return resolve_name(f"{SEVERAL_DEVICES}.trainer:ShardedTrainer")(whole, **kwargs)

    def _check(self, devices: int) -> None:
        """Raise InputError where an option makes no sense on so many devices; see `setup`."""
        for name in ("time_budget", "schedule_steps"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise InputError(f"{name} is {value}; it must be positive.")
            if value is not None and devices > 1:
                raise InputError(f"{name} is for one device. Set it to None, or use --machine.num-devices 1.")
        for name in ("max_num_iterations", "average_steps"):
            value = getattr(self, name)
            if value is not None and value < 0:
                raise InputError(f"{name} is {value}; it must be zero or positive.")
        scale = self.pipeline.datamanager.camera_res_scale_factor
        if not 0 < scale < math.inf:
            raise InputError(f"pipeline.datamanager.camera_res_scale_factor is {scale}; it must be positive.")
        workers = self.pipeline.datamanager.max_thread_workers
        if workers is not None and workers < 0:
            raise InputError(f"pipeline.datamanager.max_thread_workers is {workers}; it must be zero or positive.")
        if self.logging.steps_per_log < 1:
            raise InputError(f"logging.steps_per_log is {self.logging.steps_per_log}; it must be at least 1.")
        self._check_learning_rates()
        self.pipeline.model.check()
        length = self.schedule_steps or self.max_num_iterations or STEPS
        self.pipeline.model.densification.check_training(devices, length)
        if self.load_step is not None and self.load_dir is None:
            raise InputError(f"load_step is {self.load_step}, but there is no --load-dir. Give the folder, too.")
        if self.load_dir is not None:
            checkpoint_files.checkpoints_in(self.load_dir)

    def _check_learning_rates(self) -> None:
        """Raise InputError where a learning rate, or its schedule, is no number that a step can be made with."""
        for name, group in self.optimizers.items():
            numbers = {"optimizer.lr": group["optimizer"].lr}
            schedule = group.get("scheduler")
            lowest, needed = 0.0, "zero or positive"
            if isinstance(schedule, ExponentialDecaySchedulerConfig):
                lowest, needed = math.ulp(0.0), "positive, since it falls exponentially"
                numbers["scheduler.lr_final"] = schedule.lr_final
                if schedule.max_steps <= schedule.warmup_steps:
                    raise InputError(
                        f"optimizers.{name}.scheduler.max_steps is {schedule.max_steps}; it must be more than the "
                        f"warmup_steps, {schedule.warmup_steps}."
                    )
            for option, value in numbers.items():
                if value is not None and not lowest <= value < math.inf:
                    raise InputError(f"optimizers.{name}.{option} is {value}; it must be {needed}.")

    def for_views(self, views: int) -> "NrfgsTrainerConfig":
        """The configuration with what is left open chosen: steps, schedules and mean of a training on one device."""
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
            phases = resolution_phases(model.num_downscales, model.resolution_schedule)
            return TimedPace(length, 60.0 * self.time_budget, phases)
        return None if self.schedule_steps is None else Pace(length, length / self.max_num_iterations)

    def print_to_terminal(self) -> None:
        """What ns-train says before it begins: one line, and on several devices whether they are there. The whole
        configuration is in config.yml, and shown with NRFGS_DEBUG=1.

        Raises:
            InputError: there are fewer devices than were asked for, or none were, or the seed is none.
        """
        if DEBUG:
            super().print_to_terminal()
        machine = self.machine
        for name, value, low, high in (
            ("seed", machine.seed, 0, 2**32 - 1),
            ("num_devices", machine.num_devices, 1, 2**16),
            ("num_machines", machine.num_machines, 1, 2**16),
        ):
            if not low <= value <= high:
                raise InputError(f"machine.{name} is {value}; it must be from {low} to {high}.")
        if machine.num_devices * machine.num_machines > 1:
            resolve_name(f"{SEVERAL_DEVICES}.launch:prepare")(self)
        datamanager = self.pipeline.datamanager
        data = self.data or datamanager.data or _absolute(datamanager.dataparser.data)
        lines = [f"{self.method_name} on {data}"]
        if machine.device_type == "cpu" and self.time_budget is None:
            command = ten_minute_command(data, _name_of(datamanager.dataparser))
            lines.append(f"No CUDA device: the CPU trains. A result in ten minutes: {command}")
        CONSOLE.print("\n".join(lines), markup=False, highlight=False, soft_wrap=True)

    def save_config(self) -> None:
        """Save config.yml, with paths that lead to the same places from any folder.

        Raises:
            InputError: nothing can be written there.
        """
        data = self.pipeline.datamanager
        dataparser = replace(data.dataparser, data=_absolute(data.dataparser.data))
        pipeline = replace(self.pipeline, datamanager=replace(data, data=_absolute(data.data), dataparser=dataparser))
        try:
            if TIME_STAMP.fullmatch(self.timestamp):
                self._take_a_folder()
            whole = replace(self, pipeline=pipeline, data=_absolute(self.data), output_dir=_absolute(self.output_dir))
            TrainerConfig.save_config(whole)
        except OSError as error:
            raise InputError(
                f"--output-dir {self.output_dir}: {self.get_base_dir()} cannot be written ({error.strerror}). Name "
                "another folder."
            ) from error

    def _take_a_folder(self) -> None:
        """Make this training's folder; another one may have begun in the same second."""
        first = self.timestamp
        for number in count(2):
            try:
                self.get_base_dir().mkdir(parents=True)
                return
            except FileExistsError:
                self.timestamp = f"{first}_{number}"


def _name_of(parser: DataParserConfig) -> str | None:
    """What a command calls a parser that it must name; None for ours, and for one that it cannot name."""
    named = (name for name, known in all_dataparsers.items() if type(known) is type(parser))
    return None if isinstance(parser, NrfgsDataParserConfig) else next(named, None)


def _absolute(path: Path | None) -> Path | None:
    return None if path is None else Path(path).absolute()


@contextmanager
def nothing_left_where_refused(config: TrainerConfig) -> Iterator[None]:
    """Take back the config.yml that ns-train saves before it reads the data, with the folders that this leaves empty,
    where the training is refused before it has written anything else.
    """
    try:
        yield
    except InputError:
        folder = config.get_base_dir()
        if [file.name for file in folder.glob("*")] == ["config.yml"]:
            with suppress(OSError):  # another device was faster, or other trainings are there
                (folder / "config.yml").unlink()
                for empty in (folder, *folder.parents):
                    empty.rmdir()
                    if empty == config.output_dir:
                        break
        raise


def tell_what_was_chosen(model, steps_are_chosen: bool) -> None:
    """One line: how many steps, how far the views are trusted, how much noise, and why.

    Args:
        model: an NrfgsModel before its first step.
        steps_are_chosen: whether their number says how many steps are made.
    """
    chosen = []
    views, given = model.num_views, model.num_train_data
    if steps_are_chosen:
        chosen.append(
            f"{steps_for(views):,} steps ({STEPS_PER_VIEW} a view, at least {FEWEST_STEPS:,} and at most {STEPS:,})"
        )
    # The densification may have chosen one that is no number.
    reduced = {name: value for name, value in (model.reduced_head or {}).items() if isinstance(value, float)}
    if model.trust < 1.0 and reduced:
        options = ", ".join(f"{name} {value:.2g}" for name, value in reduced.items())
        chosen.append(f"their view dependence is trusted with {model.trust:.2g} of 1, so that it has {options}")
    if model.view_noise.sigma > 0.0:
        beside = model.noise_factor * model.camera_spacing / model.scene_unit
        chosen.append(
            f"in training the head sees each splat from about {beside:.2g} scene units beside the camera, "
            f"{model.noise_factor:.2g} times the distance between neighbouring cameras"
        )
    if chosen:
        noun = "training view" if given == 1 else "training views"
        count = f"{given} {noun}" if views == given else f"{views} different training views of {given}"
        CONSOLE.print(f"{count}: {'; '.join(chosen)} (docs/captures.md).", soft_wrap=True)
