# SPDX-License-Identifier: Apache-2.0
"""Nerfstudio's trainer, with checkpoints that are whole or not there, and a guard over every number."""

import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils import writer

from nrfgs_ns.guard import Guard, TrainingStopped, WatchedOptimizers


@dataclass
class NrfgsTrainerConfig(TrainerConfig):
    """Nerfstudio's trainer options."""

    _target: type = field(default_factory=lambda: NrfgsTrainer)
    """target class to instantiate"""


class NrfgsTrainer(Trainer):
    """Trainer that never leaves a torn checkpoint, or one with NaN, where `--load-dir` would find it."""

    def setup_optimizers(self) -> Optimizers:
        """The optimisers, behind a guard (see `nrfgs_ns.guard`)."""
        self.guard = Guard(self.pipeline)
        every = self.pipeline.steps_per_log = self.config.logging.steps_per_log
        return WatchedOptimizers(self.config.optimizers.copy(), self.pipeline.get_param_groups(), self.guard, every)

    def train(self) -> None:
        """Train, from parameters that are finite.

        Raises:
            TrainingStopped: a number is not finite; what is good has been written.
        """
        with self._last_good_state_on_disk():  # the warm-up comes before the first step
            self.guard.step = self._start_step
            self.guard.check_parameters(self.optimizers)
        gc.collect()
        gc.freeze()  # what is there now stays: the collector need not walk through it again and again
        try:
            super().train()
        finally:
            gc.unfreeze()

    def _update_viewer_state(self, step: int) -> None:
        """Nerfstudio's, and fewer events: it would send each step's duration to the log, which takes the host longer
        than some kernels. Averages go on; they are sent with the rest, every `logging.steps_per_log` steps."""
        super()._update_viewer_state(step)
        if step % self.config.logging.steps_per_log != 0:
            writer.EVENT_STORAGE.clear()

    def train_iteration(self, step: int):
        """One step.

        Raises:
            TrainingStopped: this step, or on a GPU the one before, met a number that is not finite.
        """
        with self._last_good_state_on_disk():
            self.guard.begin(step, self.optimizers)
            return super().train_iteration(step)

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
        final = self.checkpoint_dir
        self.checkpoint_dir = final.with_name(final.name + ".writing")
        try:
            super().save_checkpoint(step)
            written = self.checkpoint_dir / f"step-{step:09d}.ckpt"
            if written.exists():  # only the main process writes
                final.mkdir(parents=True, exist_ok=True)
                os.replace(written, final / written.name)
                if self.config.save_only_latest_checkpoint:
                    for older in set(final.glob("*.ckpt")) - {final / written.name}:
                        older.unlink()
                self.checkpoint_dir.rmdir()
        finally:
            self.checkpoint_dir = final
