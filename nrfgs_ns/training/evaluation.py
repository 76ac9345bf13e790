# SPDX-License-Identifier: Apache-2.0
"""An evaluation's table."""

from collections.abc import Mapping
from statistics import median
from typing import Any

from nerfstudio.utils.rich_utils import CONSOLE
from rich.table import Table

from nrfgs_ns.image.metrics import lpips_advice

SHOWN = ("psnr", "cc_psnr", "ssim", "cc_ssim", "ms_ssim", "lpips", "l1", "seconds_per_image", "splats")


def print_evaluation(result: Mapping[str, Any]) -> None:
    """Print the means over the test views, the worst view, and how to get LPIPS where it is missing."""
    names = [name for name in SHOWN if result.get(name) is not None]
    views = result["per_image"]
    title = "One test view: not a mean, and no measure of the whole"
    CONSOLE.print(title if len(views) == 1 else f"Means over {len(views)} test views", soft_wrap=True)
    table = Table()
    for name in names:
        table.add_column(name, justify="right")
    table.add_row(*(f"{result[name]:,}" if name == "splats" else f"{result[name]:.4g}" for name in names))
    CONSOLE.print(table)
    known = sorted((view["psnr"], view["image"]) for view in views if view.get("psnr") is not None)
    if len(known) > 1:
        (worst, name), middle = known[0], median(value for value, _ in known)
        worst = f"Median view {middle:.1f} dB. Worst {worst:.1f} dB: {name}. Pictures: --render-output-path FOLDER"
        CONSOLE.print(worst, markup=False, soft_wrap=True)
    if result.get("lpips") is None and (advice := lpips_advice()) is not None:
        CONSOLE.print(advice, markup=False, soft_wrap=True)
