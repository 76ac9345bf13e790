# SPDX-License-Identifier: Apache-2.0
"""One CPU thread for small work: OpenMP's threads wait for each other busily after each operation, so that beside
another process several are slower than one."""

import contextlib
from collections.abc import Iterator

import torch

SMALL = 100_000
"""Splats plus pixels of a picture below which one thread is enough."""


class Threads:
    """Torch's thread count within `few_threads`."""

    def __init__(self, most: int):
        self.most = most

    def suit(self, splats: int, pixels: int = 0) -> None:
        """Use all threads for pictures of this size, unless it is small."""
        if splats + pixels >= SMALL:
            torch.set_num_threads(self.most)

    def suit_to(self, pipeline) -> None:
        """`suit` for a pipeline's pictures."""
        cameras = pipeline.datamanager.train_dataset.cameras
        self.suit(pipeline.model.num_points, int((cameras.width * cameras.height).max()) if len(cameras) else 0)


@contextlib.contextmanager
def few_threads() -> Iterator[Threads]:
    """Compute with one CPU thread until the block ends, or until `suit` finds large work in it."""
    most = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield Threads(most)
    finally:
        torch.set_num_threads(most)
