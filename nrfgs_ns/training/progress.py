# SPDX-License-Identifier: Apache-2.0
"""The progress line: steps, the PSNR of a test view, the time left. It replaces nerfstudio's table on the terminal and
changes no number of the training."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import timedelta
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
from rich.table import Column, Table
from tyro.conf import Suppress

from nrfgs_ns.image.metrics import psnr
from nrfgs_ns.progress import SECONDS_BETWEEN_LINES

SHORTEST = 1.0
"""Least seconds between two updates on a terminal."""
SHARE = 0.005
"""Largest share of the training's time for updates."""


@dataclass
class ProgressLineConfig(LocalWriterConfig):
    """The progress line's options."""

    _target: type = field(default_factory=lambda: ProgressLine)
    enable: bool = True
    """say how far the training is, with the PSNR of one test view"""
    stats_to_track: Suppress[tuple[EventName, ...]] = LocalWriterConfig.stats_to_track
    """of nerfstudio's table; unused"""
    max_log_size: Suppress[int] = LocalWriterConfig.max_log_size
    """of nerfstudio's table; unused"""


def end_earlier_logs() -> None:
    """Close the logs of this process's earlier trainings, which nerfstudio would go on writing to."""
    writer.EVENT_STORAGE.clear()
    while writer.EVENT_WRITERS:
        log = writer.EVENT_WRITERS.pop()
        if isinstance(log, writer.TensorboardWriter):
            log.tb_writer.close()


class ProgressLine(LocalWriter):
    """One line that is updated on a terminal, and repeated now and then in a file.

    Args:
        banner_messages: lines printed once above it: the viewer's address.
    """

    def __init__(self, config: ProgressLineConfig, banner_messages: list[str] | None = None):
        super().__init__(config, banner_messages)
        for message in banner_messages or []:
            CONSOLE.print(message, markup=False, soft_wrap=True)
        self._quality: Callable[[], list[str]] = list
        """what is said of the test view; nothing, until `watch` names one"""
        self._live: Live | None = None
        self._last: tuple[int, float] | None = None
        """step and time of the last update"""
        self._due = 0.0
        """time of the next update"""

    def watch(self, pipeline: Any, lock: Lock) -> None:
        """Report the PSNR of the middle test view, if there is any, rendered under the viewer's lock."""
        data = pipeline.datamanager
        views = data.eval_dataset.image_filenames
        if views:
            middle = len(views) // 2
            name = views[middle]
            kind = "training" if name in data.train_dataset.image_filenames else "test"

            def quality() -> list[str]:
                with lock:
                    value = psnr_of(pipeline, middle)
                return [] if value is None else [f"{value:.1f} dB on {kind} view {name.name}"]

            self._quality = quality

    def write_stats_log(self, step: int) -> None:
        """Nothing: the trainer calls `update` after each step. Nerfstudio's first call names another step."""

    def finish(self, step: int) -> None:
        """Show the result of the last step and leave the line there."""
        self.update(step, is_last=True)
        self.close()

    def close(self) -> None:
        """Release the terminal for good."""
        self._due = math.inf
        self.step_aside()

    def step_aside(self) -> None:
        """Release the terminal until the next update."""
        if self._live is not None:
            self._live.stop()
            self._live = None

    def update(self, step: int, is_last: bool = False) -> None:
        """Update the line, if one is wanted, where it is due or the training ends."""
        start = perf_counter()
        if not self.config.enable or (start < self._due and not is_last):
            return
        total = max(writer.GLOBAL_BUFFER["max_iter"], step + 1)
        done = (step + 1) / total
        parts = [f"step {step + 1:,} of {total:,} ({100 * done:.0f} %)", *self._quality()]
        if self._last is not None and step > self._last[0]:
            rate = (step - self._last[0]) / max(start - self._last[1], 1e-9)
            parts.append(f"{rate:.3g} steps/s")
            if not is_last:
                parts.append(f"{timedelta(seconds=round((total - step - 1) / rate))} left")
        self._last = step, start
        text = ", ".join(parts)
        if not CONSOLE.is_terminal:
            CONSOLE.print(text, markup=False, highlight=False, soft_wrap=True)
            self._due = start + SECONDS_BETWEEN_LINES
            return
        line = Table.grid(Column(width=16), Column(no_wrap=True, overflow="ellipsis"), padding=(0, 1))
        line.add_row(ProgressBar(total=1.0, completed=done), text)
        if self._live is None:  # without a thread that redraws ten times a second
            self._live = Live(console=CONSOLE, auto_refresh=False)
            self._live.start()
        self._live.update(line, refresh=True)
        now = perf_counter()
        self._due = now + max(SHORTEST, (now - start) / SHARE)


@torch.no_grad()
def psnr_of(pipeline: Any, index: int) -> float | None:
    """PSNR of a test view in dB, as in an evaluation; None if its mask leaves nothing. Ends in training mode."""
    model, data = pipeline.model, pipeline.datamanager
    pipeline.eval()
    try:
        camera = data.eval_dataset.cameras[index : index + 1].to(model.device)
        batch = data.cached_eval[index]
        outputs = model.get_outputs_for_camera(camera)
        return psnr(outputs["rgb"], model.truth_of(batch, outputs["background"]), model.mask_of(batch))
    finally:
        pipeline.train()
