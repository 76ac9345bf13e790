# SPDX-License-Identifier: Apache-2.0
"""A training in which nothing is drawn any more learns nothing: it is stopped."""

from typing import Any

PATIENCE = 100
"""Steps in a row, each with another view's turn, without a visible splat after which there will be none."""


class InSight:
    """Counts the steps in which no splat was visible. How many are is known to the host: nothing waits."""

    def __init__(self) -> None:
        self.blind_steps = 0

    def see(self, info: dict[str, Any]) -> bool:
        """Take a step into account.

        Args:
            info: the rasterizer's; empty before the first step.

        Returns:
            Whether anything was visible in the last `PATIENCE` steps, or it is too early to tell.
        """
        rows = info.get("gaussian_ids")
        self.blind_steps = self.blind_steps + 1 if rows is not None and len(rows) == 0 else 0
        return self.blind_steps < PATIENCE
