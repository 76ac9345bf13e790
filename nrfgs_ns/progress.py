# SPDX-License-Identifier: Apache-2.0
"""Progress of long work: a bar on a terminal, lines in a log."""

import contextlib
from collections.abc import Callable, Iterator
from time import monotonic

from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

SECONDS_BETWEEN_LINES = 30.0
"""In a log."""


@contextlib.contextmanager
def progress(description: str, total: int | None = None) -> Iterator[Callable[..., None]]:
    """Show the progress of `total` pieces of work; yields advance(description=None), to be called after each."""
    if CONSOLE.is_terminal:
        columns = TextColumn("{task.description:<40}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
        with Progress(*columns, console=CONSOLE, transient=True) as bar:
            task = bar.add_task(description, total=total)
            yield lambda description=None: bar.update(task, advance=1, description=description)
        return
    done = 0
    printed = monotonic()
    CONSOLE.print(f"{description} ...", markup=False, highlight=False, soft_wrap=True)

    def advance(detail: str | None = None) -> None:
        nonlocal done, printed
        done += 1
        if monotonic() - printed >= SECONDS_BETWEEN_LINES:
            printed = monotonic()
            count = f"{done:,}" if total is None else f"{done:,} of {total:,}"
            CONSOLE.print(f"{detail or description}: {count}", markup=False, highlight=False, soft_wrap=True)

    yield advance
