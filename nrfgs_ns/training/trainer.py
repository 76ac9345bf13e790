# SPDX-License-Identifier: Apache-2.0
"""Nerfstudio's trainer, with checkpoints that are whole or not there, a guard over every number, a time budget, and a
mean over the last steps."""

import gc
import math
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils import comms, writer
from nerfstudio.utils.decorators import check_eval_enabled
from nerfstudio.utils.misc import step_check
from nerfstudio.utils.rich_utils import CONSOLE

from nrfgs_ns.errors import InputError
from nrfgs_ns.training.averaging import ParameterMean, tell, tell_why_not
from nrfgs_ns.training.guard import Guard, TrainingStopped, WatchedOptimizers
from nrfgs_ns.training.optimizers import in_world_units
from nrfgs_ns.training.pace import (
    FEWEST_STEPS,
    STEPS,
    STEPS_PER_VIEW,
    Pace,
    TimedPace,
    resolution_phases,
    steps_for,
)
from nrfgs_ns.training.tracking import track

AVERAGED = 200
"""Last steps whose mean is the trained model, where their number is chosen and in the presets."""


@dataclass
class NrfgsTrainerConfig(TrainerConfig):
    """Nerfstudio's trainer options."""

    _target: type = field(default_factory=lambda: NrfgsTrainer)
    """target class to instantiate"""
    max_num_iterations: int = STEPS
    """training steps. 0: chosen, 120 for each training view but at least 10,000 and at most 30,000, with all schedules
    stretched to them (docs/captures.md)"""
    time_budget: float | None = None
    """minutes that training may take, from the first step to the end of the last. As many steps are made as fit, and
    all schedules are stretched to them. None: max_num_iterations steps"""
    schedule_steps: int | None = None
    """steps of the training that learning rates, resolution, harmonics and densification are laid out for; they are
    stretched to the steps that are made. None: not stretched, or with a time budget laid out for max_num_iterations"""
    average_steps: int | None = None
    """the trained model is the mean of its parameters over the last so many steps, or over those since splats or the
    field last changed if they are fewer; with a time budget about so many. 0: the last step's numbers. None:
    200 where the number of steps is chosen, 0 otherwise"""

    def setup(self, **kwargs) -> "NrfgsTrainer":
        """The trainer; for several devices, the one that spreads the splats over them (`distributed`).

        Raises:
            InputError: an option is out of range, or cannot be had on several devices.
        """
        for name in ("time_budget", "schedule_steps"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise InputError(f"{name} is {value}; it must be positive.")
            if value is not None and kwargs.get("world_size", 1) > 1:
                raise InputError(f"{name} is for one device. Set it to None, or use --machine.num-devices 1.")
        for name in ("max_num_iterations", "average_steps"):
            value = getattr(self, name)
            if value is not None and value < 0:
                raise InputError(f"{name} is {value}; it must be zero or positive.")
        if kwargs.get("world_size", 1) == 1:
            return super().setup(**kwargs)
        from nrfgs_ns.distributed.trainer import ShardedTrainer

        # Schedules are not stretched there.
        whole = replace(
            self, max_num_iterations=self.max_num_iterations or STEPS, average_steps=self.average_steps or 0
        )
        return ShardedTrainer(whole, **kwargs)

    def for_views(self, views: int) -> "NrfgsTrainerConfig":
        """The configuration with what is left open chosen: steps, schedules and mean of a training on one device.

        Args:
            views: number of training views.
        """
        if self.max_num_iterations > 0:
            return replace(self, average_steps=self.average_steps or 0)
        return replace(
            self,
            max_num_iterations=STEPS if self.time_budget is not None else steps_for(views),
            schedule_steps=STEPS if self.schedule_steps is None else self.schedule_steps,
            average_steps=AVERAGED if self.average_steps is None else self.average_steps,
        )

    def save_config(self) -> None:
        """Save config.yml, as every training does before it starts; with several devices, also see to it that they
        are there, and that a message about one that is lost can be read."""
        super().save_config()
        if self.machine.num_devices * self.machine.num_machines > 1:
            from nrfgs_ns.distributed.launch import prepare

            prepare(self)


def end_earlier_logs() -> None:
    """Forget the logs of trainings that this process has set up before, and what one that was cut off left to write.

    Nerfstudio would go on with both.
    """
    writer.EVENT_STORAGE.clear()
    while writer.EVENT_WRITERS:
        log = writer.EVENT_WRITERS.pop()
        if isinstance(log, writer.TensorboardWriter):
            log.tb_writer.close()


class NrfgsTrainer(Trainer):
    """Trainer that never leaves a torn checkpoint, or one with NaN, where `--load-dir` would find it."""

    pace: Pace | None = None
    """how fast the training walks through its schedules; None: a step is a step"""
    steps_are_chosen: bool = False
    """whether the number of training views says how many steps are made"""

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        end_earlier_logs()
        super().setup(test_mode)
        if comms.is_main_process():
            self._tell_what_was_chosen()
        if self.config.average_steps > 0:  # behind the callbacks that change parameters after a step
            self.callbacks.append(TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], self._average))

    def setup_optimizers(self) -> Optimizers:
        """The optimisers, behind a guard (see `nrfgs_ns.training.guard`)."""
        self.steps_are_chosen = self.config.max_num_iterations == 0
        self.config = self.config.for_views(len(self.pipeline.datamanager.train_dataset))
        self.guard = Guard(self.pipeline)
        self.pipeline.parameter_mean = ParameterMean() if self.config.average_steps > 0 else None
        every = self.pipeline.steps_per_log = self.config.logging.steps_per_log
        groups = self.pipeline.get_param_groups()
        optimizers = WatchedOptimizers(self.optimizer_configs(), groups, self.guard, every)
        self.pace = optimizers.pace = self.pipeline.model.pace = self._pace()
        return optimizers

    def _tell_what_was_chosen(self) -> None:
        """One line: how many steps, how much noise, and why."""
        model, views = self.pipeline.model, len(self.pipeline.datamanager.train_dataset)
        chosen = []
        if self.steps_are_chosen and self.config.time_budget is None:
            chosen.append(
                f"{steps_for(views):,} steps ({STEPS_PER_VIEW} a view, at least {FEWEST_STEPS:,} and at most {STEPS:,})"
            )
        if model.view_noise.sigma > 0.0:
            chosen.append(f"the head sees each splat from about {model.config.view_noise:g} of that beside the camera")
        if chosen:
            apart = model.camera_spacing / model.scene_unit
            CONSOLE.print(
                f"{views} training views, {apart:.2g} scene units apart: {'; '.join(chosen)}.", soft_wrap=True
            )

    def _pace(self) -> Pace | None:
        """How fast to walk through the schedules (`pace.py`), or None for a step at a time."""
        length = self.config.schedule_steps or self.config.max_num_iterations
        if self.config.time_budget is not None:
            model = self.config.pipeline.model
            phases = resolution_phases(model.num_downscales, model.resolution_schedule)
            return TimedPace(length, 60.0 * self.config.time_budget, phases)
        return None if self.config.schedule_steps is None else Pace(length)

    def _load_checkpoint(self) -> None:
        """Nerfstudio's; and the pace and the mean go on from where they were.

        Raises:
            InputError: the checkpoint's schedules were stretched, and this training's are not.
        """
        super()._load_checkpoint()
        if self.pace is None and self.pipeline.model.pace is not None:
            raise InputError(
                "The checkpoint's training had a --time-budget or --schedule-steps. Give the same to go on from it."
            )
        if self.steps_are_chosen:  # in all, not from here on
            left = max(self.config.max_num_iterations - self._start_step, 0)
            self.config = replace(self.config, max_num_iterations=left)
        if self.pace is not None and self.pace.position == 0.0:
            self.pace.position = float(self._start_step)  # of a checkpoint whose schedules were not stretched
        if self.pace is not None and not isinstance(self.pace, TimedPace):
            rate = (self.pace.length - self.pace.position) / max(self.config.max_num_iterations, 1)
            if not math.isclose(rate, self.pace.rate, rel_tol=1e-9):  # the same to the last bit, if it is the same
                self.pace.rate = max(rate, 1e-9)
        loaded, self.pipeline.loaded_mean = self.pipeline.loaded_mean, None
        if self.pipeline.parameter_mean is not None and loaded is not None:
            self.pipeline.parameter_mean.load_state(loaded, self.pipeline.model, self.optimizers.optimizers)

    def optimizer_configs(self) -> dict[str, Any]:
        """The configured optimisers; the means', whose learning rate is a length, in world units."""
        groups = self.config.optimizers.copy()
        groups["means"] = in_world_units(groups["means"], self.pipeline.model.scene_unit)
        return groups

    def train(self) -> None:
        """Train, from parameters that are finite.

        Raises:
            TrainingStopped: a number is not finite; what is good has been written.
        """
        with self._last_good_state_on_disk():  # the warm-up comes before the first step
            self.guard.step = self._start_step
            self.guard.check_parameters(self.optimizers)
        if isinstance(self.pace, TimedPace):  # the clock says which step is the last
            self.config = replace(self.config, max_num_iterations=0 if self.pace.is_spent else sys.maxsize // 2)
        self.step = self._start_step - 1  # the last one, if none is left
        gc.collect()
        gc.freeze()  # what is there now stays: the collector need not walk through it again and again
        try:
            if self.pace is not None:
                self.pace.start()
            super().train()
        finally:
            gc.unfreeze()

    def _update_viewer_state(self, step: int) -> None:
        """Nerfstudio's, and fewer events: it would send each step's duration to the log, which takes the host longer
        than some kernels. Averages go on; they are sent with the rest, every `logging.steps_per_log` steps."""
        super()._update_viewer_state(step)
        if step % self.config.logging.steps_per_log != 0:
            writer.EVENT_STORAGE.clear()

    @check_eval_enabled
    def eval_iteration(self, step: int) -> None:
        """Nerfstudio's, and a look at the appearance head whenever test images are looked at."""
        super().eval_iteration(step)
        pictures = step_check(step, self.config.steps_per_eval_all_images)
        if pictures or step_check(step, self.config.steps_per_eval_image):
            self.pipeline.eval()
            camera = self.pipeline.datamanager.eval_dataset.cameras[:1].to(self.device)
            track(self.pipeline.model, camera, step, pictures)
            self.pipeline.train()

    def train_iteration(self, step: int):
        """One step.

        Raises:
            TrainingStopped: this step, or on a GPU the one before, met a number that is not finite.
        """
        if self.pace is not None:
            self.pace.begin_step()
            self.pipeline.model.densification.reschedule(lambda position: self.pace.step_at(position, step))
        with self._last_good_state_on_disk():
            self.guard.begin(step, self.optimizers)
            result = super().train_iteration(step)
        if isinstance(self.pace, TimedPace):  # the step that brings the time's end is the last
            self._last_step = step
            self.stop_training = self.stop_training or self.pace.is_spent
            writer.GLOBAL_BUFFER["max_iter"] = step + 1 + self.pace.steps_left  # what the terminal counts towards
        return result

    @property
    def last_step(self) -> int:
        """The last step of this training; with a time budget, a number beyond it."""
        return self._start_step + self.config.max_num_iterations - 1

    def _average(self, step: int) -> None:
        """Take the step's numbers into the mean, if it is one of the last `average_steps`."""
        mean, window = self.pipeline.parameter_mean, self.config.average_steps
        if isinstance(self.pace, TimedPace):
            left = self.pace.steps_left  # as things look now; to within a step at a constant pace
            is_of_earlier_steps = left >= 2 * window  # once begun it goes on, unless the end was far from foreseen
        else:
            left = self.last_step - step
            is_of_earlier_steps = mean.count >= window - left  # of a training that was to end before this one does
        if is_of_earlier_steps:
            mean.forget()
        if left < window or mean.count > 0:
            mean.add(self.pipeline.model, self.optimizers.optimizers)

    def _after_train(self) -> None:
        """Nerfstudio's, whose step number is one too many when it stopped early; the model is the mean from here on."""
        self.step = getattr(self, "_last_step", self.step)
        timed_out = isinstance(self.pace, TimedPace) and self.pace.is_spent
        if self.config.average_steps > 0 and self.stop_training and not timed_out:
            tell_why_not(self.config.average_steps, "the training was stopped before its last step")
        else:
            self.take_the_mean()
        super()._after_train()

    def take_the_mean(self) -> None:
        """Let the model be the mean over the last steps, if one was asked for, and say so; or say why it is not.

        Raises:
            TrainingStopped: the last step met a number that is not finite; what is good has been written.
        """
        mean, window = self.pipeline.parameter_mean, self.config.average_steps
        if window == 0:
            return
        with self._last_good_state_on_disk():
            self.guard.settle()
        if mean.count == 0:
            late = isinstance(self.pace, TimedPace) and self.step >= self._start_step
            tell_why_not(window, "the time was up sooner than foreseen" if late else "no step was made")
        else:
            tell(mean.count, window, mean.began_anew)
            with self.train_lock:
                mean.install()

    def save_checkpoint(self, step: int) -> None:
        """Write a checkpoint of finite numbers.

        Args:
            step: training step that the checkpoint is named after.

        Raises:
            TrainingStopped: there is a number that is not finite; what is good has been written.
        """
        with self._last_good_state_on_disk():
            self.guard.settle()
            self.guard.check_parameters(self.optimizers)
        self._write_checkpoint(step)

    @contextmanager
    def _last_good_state_on_disk(self) -> Iterator[None]:
        try:
            yield
        except TrainingStopped as stopped:
            if stopped.savable:
                self._write_checkpoint(stopped.step)
            raise

    def _write_checkpoint(self, step: int) -> None:
        """Write the checkpoint aside, then move it into place, then let go of the older ones.

        Args:
            step: training step that the checkpoint is named after.
        """
        content = self._checkpoint(step)
        if not comms.is_main_process():
            return
        name, final = f"step-{step:09d}.ckpt", self.checkpoint_dir
        aside = final.with_name(final.name + ".writing")
        aside.mkdir(parents=True, exist_ok=True)
        torch.save(content, aside / name)
        final.mkdir(parents=True, exist_ok=True)
        os.replace(aside / name, final / name)
        if self.config.save_only_latest_checkpoint:
            for older in set(final.glob("*.ckpt")) - {final / name}:
                older.unlink()
        aside.rmdir()

    def _checkpoint(self, step: int) -> dict[str, Any]:
        """What a checkpoint holds: nerfstudio's entries."""
        return {
            "step": step,
            "pipeline": self.pipeline.state_dict(),
            "optimizers": {name: value.state_dict() for name, value in self.optimizers.optimizers.items()},
            "schedulers": {name: value.state_dict() for name, value in self.optimizers.schedulers.items()},
            "scalers": self.grad_scaler.state_dict(),
        }
