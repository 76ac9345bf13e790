# SPDX-License-Identifier: Apache-2.0
"""One CPU thread for small work: OpenMP's threads wait for each other busily after each operation, so that beside
another process several are slower than one."""

import contextlib
from collections.abc import Iterator

import torch

SMALL = 100_000
"""Splats plus pixels of a picture below which one thread is enough."""


@contextlib.contextmanager
def few_threads(are_enough: bool = True) -> Iterator[None]:
    """Compute with one CPU thread until the block ends, if that is enough."""
    most = torch.get_num_threads()
    torch.set_num_threads(1 if are_enough else most)
    try:
        yield
    finally:
        torch.set_num_threads(most)


def draws_small(pipeline) -> bool:
    """Whether one thread is enough for a pipeline's pictures."""
    cameras = pipeline.datamanager.train_dataset.cameras
    pixels = int((cameras.width * cameras.height).max()) if len(cameras) else 0
    return pipeline.model.num_points + pixels < SMALL
