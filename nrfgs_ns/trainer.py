# SPDX-License-Identifier: Apache-2.0
"""Nerfstudio's trainer, with checkpoints that are whole or not there."""

import os
from dataclasses import dataclass, field

from nerfstudio.engine.trainer import Trainer, TrainerConfig


@dataclass
class NrfgsTrainerConfig(TrainerConfig):
    """Nerfstudio's trainer options."""

    _target: type = field(default_factory=lambda: NrfgsTrainer)
    """target class to instantiate"""


class NrfgsTrainer(Trainer):
    """Trainer that never leaves a torn checkpoint where `--load-dir` would find it."""

    def save_checkpoint(self, step: int) -> None:
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
