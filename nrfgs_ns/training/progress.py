# SPDX-License-Identifier: Apache-2.0
"""The line that says how far a training is: steps, the PSNR of a test view, the time that is left.

It takes the place of nerfstudio's table on the terminal. The test view is only looked at: a training with the line and
one without make the same numbers.
"""

from dataclasses import dataclass, field
from threading import Lock
from time import perf_counter
from typing import Any

import torch
from nerfstudio.configs.base_config import LocalWriterConfig
from nerfstudio.utils import writer
from nerfstudio.utils.rich_utils import CONSOLE
from nerfstudio.utils.writer import EventName, LocalWriter
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from tyro.conf import Suppress

from nrfgs_ns.image.metrics import psnr

SHORTEST = 1.0
"""Seconds between two looks at the test view, at least."""
SHARE = 0.005
"""Of the training's time that looks may take."""
LINES_IN_A_FILE = 20
"""Where the output is no terminal, a line is written for each so many-th part of the steps."""


@dataclass
class ProgressLineConfig(LocalWriterConfig):
    """The line on the terminal."""

    _target: type = field(default_factory=lambda: ProgressLine)
    """target class to instantiate"""
    enable: bool = True
    """say how far the training is, with the PSNR of one test view"""
    stats_to_track: Suppress[tuple[EventName, ...]] = LocalWriterConfig.stats_to_track
    """of nerfstudio's table; unused"""
    max_log_size: Suppress[int] = LocalWriterConfig.max_log_size
    """of nerfstudio's table; unused"""


def end_earlier_logs() -> None:
    """Forget the logs of trainings that this process has set up before, and what one that was cut off left to write.

    Nerfstudio would go on with both.
    """
    writer.EVENT_STORAGE.clear()
    while writer.EVENT_WRITERS:
        log = writer.EVENT_WRITERS.pop()
        if isinstance(log, writer.TensorboardWriter):
            log.tb_writer.close()


class ProgressLine(LocalWriter):
    """A line that is kept up to date on a terminal, and written now and then into anything else.

    The trainer calls `write_stats_log` after each step, nerfstudio's loop in those that are logged.

    Args:
        config: its options.
        banner_messages: lines that are printed once, above it: the viewer's address.
    """

    def __init__(self, config: ProgressLineConfig, banner_messages: list[str] | None = None):
        super().__init__(config, banner_messages)
        for message in banner_messages or []:
            CONSOLE.print(message, markup=False, soft_wrap=True)
        self._pipeline: Any = None
        self._view = 0, ""
        self._lock = Lock()
        self._live: Live | None = None
        self._is_over = False
        self._last: tuple[int, float] | None = None
        """step and time of the last look"""
        self._due = 0.0
        self._told = -1.0
        """share of the steps at the last line in a file"""
        self._first = 0

    def watch(self, pipeline: Any, lock: Lock) -> None:
        """Look at one of this pipeline's test views, the middle one, if it has any.

        Args:
            lock: is held while looking: the viewer asks the same model for pictures.
        """
        data = pipeline.datamanager
        views = data.eval_dataset.image_filenames
        if views:
            index = len(views) // 2
            kind = "training" if views[index] in data.train_dataset.image_filenames else "test"
            self._view = index, f"{kind} view {views[index].name}"
            self._pipeline, self._lock = pipeline, lock

    def begin(self, step: int) -> None:
        """The training begins with this step; nerfstudio names 0 with what it has logged before."""
        self._first = step

    def write_stats_log(self, step: int) -> None:
        """Bring the line up to date, if that is due."""
        if not self._is_over and perf_counter() >= self._due:
            self._tell(max(step, self._first))

    def finish(self, step: int) -> None:
        """Say what has become of it after the last step, and leave the line there."""
        if not self._is_over:
            self._tell(step, is_last=True)
            self.close()

    def close(self) -> None:
        """Let go of the terminal; nothing more is said."""
        self._is_over = True
        self.step_aside()

    def step_aside(self) -> None:
        """Let go of the terminal until there is something to say again."""
        if self._live is not None:
            self._live.stop()
            self._live = None

    def _tell(self, step: int, is_last: bool = False) -> None:
        start = perf_counter()
        total = max(writer.GLOBAL_BUFFER["max_iter"], step + 1)
        done = (step + 1) / total
        in_file = not CONSOLE.is_terminal
        if in_file and not is_last and int(LINES_IN_A_FILE * done) == int(LINES_IN_A_FILE * self._told):
            return
        parts = [f"step {step + 1:,} of {total:,} ({100 * done:.0f} %)", *self._seen()]
        if self._last is not None and step > self._last[0]:
            rate = (step - self._last[0]) / (start - self._last[1])
            parts.append(f"{rate:.3g} steps/s")
            if not is_last:
                parts.append(f"{duration((total - step - 1) / rate)} left")
        self._last, self._told = (step, start), done
        self._show(", ".join(parts), done)
        now = perf_counter()
        self._due = now + max(SHORTEST, (now - start) / SHARE)

    def _seen(self) -> list[str]:
        """The PSNR of the test view."""
        if self._pipeline is None:
            return []
        index, name = self._view
        with self._lock:
            value = psnr_of(self._pipeline, index)
        return [] if value is None else [f"{value:.1f} dB on {name}"]

    def _show(self, text: str, done: float) -> None:
        if not CONSOLE.is_terminal:
            CONSOLE.print(text, markup=False, highlight=False, soft_wrap=True)
            return
        line = Table.grid(padding=(0, 1))
        line.add_column(width=16)
        line.add_column(no_wrap=True, overflow="ellipsis")
        line.add_row(ProgressBar(total=1.0, completed=done), text)
        if self._live is None:  # without a thread of its own that draws ten times a second
            self._live = Live(console=CONSOLE, auto_refresh=False)
            self._live.start()
        self._live.update(line, refresh=True)


@torch.no_grad()
def psnr_of(pipeline: Any, index: int) -> float | None:
    """PSNR of a test view, dB, as an evaluation would have it; None if its mask leaves nothing. The pipeline is in
    training again afterwards.
    """
    model, data = pipeline.model, pipeline.datamanager
    pipeline.eval()
    try:
        camera, batch = data.eval_dataset.cameras[index : index + 1].to(model.device), data.cached_eval[index]
        outputs = model.get_outputs_for_camera(camera)
        truth = model.truth_of(batch, outputs["background"])
        return psnr(outputs["rgb"], truth, model.mask_of(batch))
    finally:
        pipeline.train()


def duration(seconds: float) -> str:
    """A time for people: 45 s, 3 min 20 s, 2 h 05 min."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02} min"
    return f"{minutes} min {rest:02} s" if minutes else f"{rest} s"
