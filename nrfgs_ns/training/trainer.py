# SPDX-License-Identifier: Apache-2.0
"""Nerfstudio's trainer with whole checkpoints, a guard against numbers that are not finite, a time budget, a mean over
the last steps, and an orderly end whatever its cause."""

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from shlex import quote
from typing import Any, Literal

import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.trainer import Trainer
from nerfstudio.utils import comms, writer
from nerfstudio.utils.decorators import check_eval_enabled
from nerfstudio.utils.misc import step_check
from nerfstudio.utils.rich_utils import CONSOLE

from nrfgs_ns.data.checks import warn
from nrfgs_ns.densification.memory import give_back
from nrfgs_ns.errors import ForTheUser, InputError
from nrfgs_ns.model.initial_splats import start_with_dense_points
from nrfgs_ns.training import checkpoint_files
from nrfgs_ns.training.averaging import ParameterMean, window
from nrfgs_ns.training.checkpoint_files import DiskFull
from nrfgs_ns.training.guard import Guard, TrainingStopped
from nrfgs_ns.training.identity import check_options, options_of
from nrfgs_ns.training.optimizers import LeanOptimizers
from nrfgs_ns.training.pace import Pace, TimedPace, resume
from nrfgs_ns.training.pipeline import descend
from nrfgs_ns.training.progress import ProgressLine, ProgressLineConfig, end_earlier_logs
from nrfgs_ns.training.step_graph import StepGraphs
from nrfgs_ns.training.stopping import StopRequest, heard_signals, is_out_of_memory, rows_agree
from nrfgs_ns.training.trainer_config import NrfgsTrainerConfig, report_choices
from nrfgs_ns.training.twin import Twin, twin_of

NOTHING_TO_SAVE = "Stopped before the first step; there is nothing to save."


class NrfgsTrainer(Trainer):
    """Trainer that never leaves a torn checkpoint, or one with NaN, where `--load-dir` would find it."""

    config: NrfgsTrainerConfig
    line: ProgressLine
    """one that is not enabled where nothing is shown, or nerfstudio's table"""
    pace: Pace | None = None
    """position on the schedules; None: the step"""
    steps_are_chosen = False
    """whether the number of training views decides how many steps there are"""
    mean: ParameterMean | None = None
    """the parameters' mean over the last steps; None without `average_steps`"""
    graphs: StepGraphs | None = None
    """recorded steps; None with several devices"""
    twin: Twin | None = None
    """a second training to agree with; None: none"""
    _stop = False
    _saved_step: int | None = None

    @property
    def stop_training(self) -> bool:
        """Whether no further step is made. Nerfstudio's loop reads and sets it."""
        return self._stop or self._signal > 0

    @stop_training.setter
    def stop_training(self, stop: bool) -> None:
        self._stop = stop

    @property
    def _signal(self) -> int:
        """The signal that asks to stop; 0: none."""
        return self.request.signal or 0

    @property
    def _trainings(self) -> "list[NrfgsTrainer | Twin]":
        """This training and its twin, if it has one."""
        return [self] if self.twin is None else [self, self.twin]

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        end_earlier_logs()
        self.request = StopRequest()
        try:
            super().setup(test_mode)
        except KeyboardInterrupt:
            NrfgsTrainer._end(self, NOTHING_TO_SAVE, 130)
        writer.GLOBAL_BUFFER["max_iter"] = self.last_step + 1
        silent = ProgressLine(ProgressLineConfig(enable=False))
        self.line = next((log for log in writer.EVENT_WRITERS if isinstance(log, ProgressLine)), silent)
        if self.world_size == 1:  # with several, no device can draw alone
            self.line.watch(self.pipeline, self.train_lock)
        self._completed_step = self._start_step - 1
        """the last step that was completed"""
        if self.world_size == 1:
            self.graphs = StepGraphs(self.pipeline.model, self.pipeline.datamanager, self.guard)
        report_choices(self.config, self.pipeline, self.steps_are_chosen, self.twin is not None)
        if self.twin is not None:
            self.twin.begin()
        if self.config.average_steps > 0:  # after the callbacks that change parameters
            self.callbacks.append(TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], self._average))

    def start_densely(self) -> None:
        """Add points from the photographs to those that a new training starts from."""
        if self.config.load_dir is None and self.config.load_checkpoint is None:
            start_with_dense_points(self.pipeline.model, self.pipeline.datamanager)
            torch.cuda.empty_cache()  # what a training holds tells how far it may grow; nothing without CUDA

    def setup_optimizers(self) -> Optimizers:
        """The optimisers, once what depends on the views is known: the steps, the points to start from, the pace."""
        self.steps_are_chosen = self.config.max_num_iterations == 0 and self.config.time_budget is None
        self.config = self.config.for_views(self.pipeline.model.num_views)
        self.start_densely()
        self.guard = Guard(self.pipeline)
        self.mean = ParameterMean() if self.config.average_steps > 0 else None
        self.pace = self.config.pace()
        self.twin = twin_of(self)
        groups = self.pipeline.get_param_groups()
        return LeanOptimizers(self.optimizer_configs(), groups, self.config.logging.steps_per_log, self.pace)

    # Resuming.

    def _load_checkpoint(self) -> None:
        """Resume from the checkpoint that the configuration names, if any; InputError if it does not fit."""
        config = self.config
        if config.load_dir is not None:
            path, content = checkpoint_files.read_latest(config.load_dir, config.load_step)
        elif (path := config.load_checkpoint) is not None:
            content = checkpoint_files.read(path)
        else:
            return
        if "optimizers" not in content:
            raise InputError(f"{path} is of a compact file, which no training goes on from. Use its training's own.")
        if "training" not in content:
            raise InputError(f"{path} is of another method, such as splatfacto. Train anew, without --load-dir.")
        self._start_step = content["step"] + 1
        training = content["training"]
        self.pipeline.load_pipeline(content["pipeline"], content["step"])
        check_options(training["options"], options_of(config))
        left = config.max_num_iterations - self._start_step
        if config.time_budget is None and left <= 0:
            schedules = "" if config.schedule_steps is None else f" --schedule-steps {config.schedule_steps}"
            schedules += f" --average-steps {config.average_steps}" if config.average_steps else ""
            longer = f"--max-num-iterations {2 * self._start_step}{schedules} makes as many more"
            raise InputError(f"{path} is the end of a training of {self._start_step:,} steps: {longer}.")
        self.optimizers.load_optimizers(content["optimizers"], list(self.pipeline.model.head.parameters()))
        if config.load_scheduler:
            self.optimizers.load_schedulers(content["schedulers"])
        resume(self.pace, training.get("pace"), self._start_step, left, self.world_size)
        if not isinstance(self.pace, TimedPace):
            self.config = replace(self.config, max_num_iterations=left)
        if self.pace is not None:
            self.pipeline.model.schedule_at(int(self.pace.position))
        if self.mean is not None and self.world_size == 1 and "parameter_mean" in training:
            self.mean.load_state(training["parameter_mean"], self.optimizers.optimizers)
        if (self.twin is not None) != ("twin" in training):
            whose = "training" if self.twin is None else "checkpoint"
            warn(f"The {whose} has no twin (--pipeline.model.twin): the training goes on without one.")
            self.twin = None
        elif self.twin is not None:
            self.twin.load_state(training["twin"])
        budget = config.time_budget
        total = f"{config.max_num_iterations:,}" if budget is None else f"as many as fit into {budget:g} minutes"
        CONSOLE.print(f"Going on from {path}, at step {self._start_step} of {total}.", markup=False, soft_wrap=True)

    def optimizer_configs(self) -> dict[str, Any]:
        """The configured optimisers; the means' learning rates, lengths in scene units, in world units."""
        unit = self.pipeline.model.scene_unit
        means = self.config.optimizers["means"]
        optimizer, scheduler = means["optimizer"], means["scheduler"]
        if scheduler is not None:
            rates = {name: value for name, value in vars(scheduler).items() if name in ("lr_final", "lr_pre_warmup")}
            scheduler = replace(scheduler, **{name: unit * rate for name, rate in rates.items() if rate is not None})
        means = {"optimizer": replace(optimizer, lr=unit * optimizer.lr), "scheduler": scheduler}
        return {**self.config.optimizers, "means": means}

    # Training.

    def train(self) -> None:
        """Train. Raises TrainingStopped where a number is not finite or memory has run out, and SystemExit with the
        status of a signal; the last good state has been written."""
        self._check_parameters(self._start_step)
        if isinstance(self.pace, TimedPace):  # the clock says which step is the last
            self.config = replace(self.config, max_num_iterations=sys.maxsize // 2)
            self.pace.start()
        gc.collect()
        gc.freeze()  # all present objects stay: the collector need not visit them
        try:
            with heard_signals(self.request), self._state_on_disk_if_it_fails():
                super().train()
        finally:
            gc.unfreeze()
            self.line.close()

    def _update_viewer_state(self, step: int) -> None:
        """Nerfstudio's with fewer events, since logging each step's duration takes the host longer than some kernels
        take: those of every `logging.steps_per_log`-th step. The progress line is updated more often."""
        super()._update_viewer_state(step)
        if step % self.config.logging.steps_per_log != 0:
            writer.EVENT_STORAGE.clear()
        self.line.update(step)

    @check_eval_enabled
    def eval_iteration(self, step: int) -> None:
        if step_check(step, self.config.steps_per_eval_all_images):
            self.line.step_aside()  # the evaluation has a progress bar of its own
        super().eval_iteration(step)
        config = self.config
        if step_check(step, config.steps_per_eval_image) or step_check(step, config.steps_per_eval_all_images):
            give_back(self.pipeline.model.device)

    def train_iteration(self, step: int):
        """One step; TrainingStopped where it, or on a GPU the one before, met a number that is not finite."""
        model, pace, optimizers = self.pipeline.model, self.pace, self.optimizers
        if pace is not None:
            model.densification.reschedule(lambda position: pace.step_at(position, step))
        with self._last_good_state_on_disk():
            pulled = {} if self.twin is None else self.twin.make_step(step)
            is_logged = step % self.config.logging.steps_per_log == 0
            loss, losses, metrics = descend(self, step, pulled, is_logged)
            optimizers.scheduler_step_all(step)
        self._completed_step = step
        if pace is not None:
            model.schedule_at(int(pace.position))
        if isinstance(pace, TimedPace):
            self.stop_training = self._stop or pace.is_spent
            writer.GLOBAL_BUFFER["max_iter"] = step + 1 + pace.steps_left  # the progress line's total
        return loss.detach(), {name: value.detach() for name, value in losses.items()}, metrics

    @property
    def last_step(self) -> int:
        """The training's last step; with a time budget, a number beyond it."""
        return self._start_step + self.config.max_num_iterations - 1

    def _average(self, step: int) -> None:
        """Add the step's parameters to the mean if it is one of the last `average_steps` (see `averaging.window`)."""
        mean = self.mean
        timed = isinstance(self.pace, TimedPace)
        left = self.pace.steps_left if timed else self.last_step - step  # timed: an estimate
        size = window(self.config.average_steps, step + 1 + left)
        # A timed window stays once begun, unless the estimate was far off. Otherwise the mean may be of steps that were
        # the last before the training was extended.
        is_stale = left >= 2 * size if timed else mean.count >= size - left
        if is_stale or self.pipeline.model.densification.moved_at == step:
            mean.forget()
        if left < size or mean.count > 0:
            mean.add(self.optimizers.optimizers)

    # The end.

    def _after_train(self) -> None:
        """Nerfstudio's, with the right step number: its own is one too high after an early stop. Before it, the mean
        becomes the model; a signal ends the training here."""
        self.step = self._completed_step
        self.training_state = "completed"
        timed_out = isinstance(self.pace, TimedPace) and self.pace.is_spent
        if self._signal and not timed_out and self._completed_step < self.last_step:
            outcome = NOTHING_TO_SAVE
            if self._completed_step >= self._start_step:
                outcome = f"Stopped at step {self._completed_step}, saved. {self._save_once()}"
            self._end(outcome, 128 + self._signal)
        self.install_mean(stopped=self._stop and not timed_out)
        self.line.finish(self._completed_step)
        super()._after_train()

    def _save_once(self) -> str:
        """Save the last completed step unless it is saved; returns a sentence, without full stop, on how to go on."""
        if self._saved_step != self._completed_step:
            self.save_checkpoint(self._completed_step)
        return f"Go on with the same command and --load-dir {quote(str(self.checkpoint_dir))}"

    def _end(self, line: str, status: int) -> None:
        if comms.is_main_process():
            print(line, flush=True)
        raise SystemExit(status)

    def _train_complete_viewer(self) -> None:
        """Nerfstudio's: the viewer shows the model until Ctrl-C, which may have come in the last step."""
        self.request.is_over = True
        if self.request.signal is None:
            with suppress(KeyboardInterrupt):
                super()._train_complete_viewer()

    @contextmanager
    def _state_on_disk_if_it_fails(self) -> Iterator[None]:
        """Save the last complete step when something other than a signal or the guard ends the training, and raise the
        exception again; TrainingStopped where memory has run out."""
        try:
            yield
        except Exception as error:
            if isinstance(error, ForTheUser) or self.world_size > 1:  # one device alone cannot write the whole
                raise
            if not is_out_of_memory(error):
                print(f"The training failed in step {self.step}. {self._save_last_step()}", flush=True)
                raise
            error.__traceback__ = None  # its frames hold the step's tensors
            outcome = self._save_last_step()
            reason = str(error).partition("\n")[0]
            message = f"Out of memory in step {self.step}: {reason}\n{outcome} Fewer splats or smaller images take less"
            raise TrainingStopped(f"{message} (docs/troubleshooting.md).", self.step, "memory") from None

    def _save_last_step(self) -> str:
        """Save the state after the last completed step, if it is consistent; returns a sentence about the outcome."""
        self.training_state = "completed"
        last = next(iter(checkpoint_files.find(self.checkpoint_dir).values()), None)
        kept = f"The last checkpoint is {last}." if last else "This training has written no checkpoint."
        if self._completed_step < self._start_step:
            return f"No step had been made. {kept}"
        for training in self._trainings:
            training.optimizers.zero_grad_all()
        gc.collect()
        torch.cuda.empty_cache()  # nothing without CUDA
        pairs = [(training.pipeline.model, training.optimizers.optimizers) for training in self._trainings]
        if not all(rows_agree(model.gauss_params, each, model.densification.state.values()) for model, each in pairs):
            return f"Splats were being added or removed, so that nothing could be saved. {kept}"
        try:
            return f"Step {self._completed_step} is saved. {self._save_once()}."
        except (Exception, ForTheUser) as error:  # the first failure is the one to raise
            return f"The state could not be saved ({error}). {kept}"

    def install_mean(self, stopped: bool = False) -> None:
        """Replace the parameters by their mean over the last steps, unless the training was stopped before them, and
        say so; TrainingStopped where the last step met a number that is not finite."""
        if self.mean is None:
            return
        with self._last_good_state_on_disk():
            self.guard.settle()
        if stopped or self.mean.count == 0:
            why = "the training was stopped before its last step" if stopped else "the time was up sooner than foreseen"
            warn(f"Nothing was averaged, despite average_steps: {why}. The model is the last step's.")
            return
        CONSOLE.print(f"The trained model is the mean of its parameters over the last {self.mean.count} steps.")
        with self.train_lock:
            self.mean.install()

    # Checkpoints.

    def save_checkpoint(self, step: int) -> None:
        """Write a checkpoint of finite numbers, or raise TrainingStopped, with the last good state on disk. Where the
        disk is full the training goes on with a warning, except at its end: DiskFull."""
        self._check_parameters(step)
        try:
            self._write_checkpoint(step)
        except DiskFull as full:
            if self.training_state == "completed":
                raise
            warn(f"{full} The training goes on.")

    def _check_parameters(self, step: int) -> None:
        """Read the guards' last verdicts and check all parameters; TrainingStopped, with the last good state on disk,
        where a number is not finite."""
        with self._last_good_state_on_disk():
            for training in self._trainings:
                training.guard.settle()
                training.guard.step = step
                training.guard.check_parameters(training.optimizers)

    @contextmanager
    def _last_good_state_on_disk(self) -> Iterator[None]:
        try:
            yield
        except TrainingStopped as stopped:
            if stopped.savable:
                try:
                    self._write_checkpoint(stopped.step)
                except DiskFull as full:
                    raise TrainingStopped(f"{stopped}\n{full}", stopped.step, stopped.origin) from full
            raise

    def _write_checkpoint(self, step: int) -> None:
        """Write a checkpoint; DiskFull where there is no room."""
        content = self._checkpoint(step)
        if comms.is_main_process():
            checkpoint_files.write(self.checkpoint_dir, step, content, self.config.save_only_latest_checkpoint)
        self._saved_step = step

    def _checkpoint(self, step: int) -> dict[str, Any]:
        """A checkpoint's content: nerfstudio's entries, and "training", which this class needs to resume."""
        training: dict[str, Any] = {"options": options_of(self.config)}
        if self.pace is not None:
            training["pace"] = self.pace.state()
        if self.mean is not None and self.world_size == 1 and self.mean.count > 0:
            training["parameter_mean"] = self.mean.state()
        if self.twin is not None:
            training["twin"] = self.twin.state()
        return {
            "step": step,
            "pipeline": self.pipeline.state_dict(),
            "optimizers": {name: value.state_dict() for name, value in self.optimizers.optimizers.items()},
            "schedulers": {name: value.state_dict() for name, value in self.optimizers.schedulers.items()},
            "scalers": self.grad_scaler.state_dict(),
            "training": training,
        }
