# SPDX-License-Identifier: Apache-2.0
"""An evaluation's numbers as a table, and which test views are far below the rest."""

from collections.abc import Mapping, Sequence
from statistics import quantiles
from typing import Any

from nerfstudio.utils.rich_utils import CONSOLE
from rich.table import Table

from nrfgs_ns.image.metrics import lpips_advice

SHOWN = ("psnr", "cc_psnr", "ssim", "cc_ssim", "ms_ssim", "lpips", "l1", "seconds_per_image", "splats")
ENOUGH = 5
"""Fewer views have no "rest" to be below."""
BELOW = 3.0
"""A view is far below the rest if its PSNR is, by this many dB, below the median, and below Tukey's fence: the lower
quartile less one and a half times the distance between the quartiles (Exploratory Data Analysis, 1977)."""


def print_evaluation(result: Mapping[str, Any]) -> None:
    """Print the means over the test views, the views far below the rest, and how to get LPIPS where it is missing."""
    names = [name for name in SHOWN if result.get(name) is not None]
    views = len(result["per_image"])
    title = "One test view: not a mean, and no measure of the whole" if views == 1 else f"Means over {views} test views"
    CONSOLE.print(title, soft_wrap=True)
    table = Table()
    for name in names:
        table.add_column(name, justify="right")
    table.add_row(*(f"{result[name]:,}" if name == "splats" else f"{result[name]:.4g}" for name in names))
    CONSOLE.print(table)
    for name, value, middle in far_below(result["per_image"]):
        CONSOLE.print(
            f"{name}: {value:.1f} dB, {middle - value:.1f} below the median view. Look at its picture "
            "(--render-output-path): its pose may be wrong, or it shows what no training view does.",
            style="bold yellow",
            markup=False,
            soft_wrap=True,
        )
    if result.get("lpips") is None and (advice := lpips_advice()) is not None:
        CONSOLE.print(advice, markup=False, soft_wrap=True)


def far_below(images: Sequence[Mapping[str, Any]]) -> list[tuple[str, float, float]]:
    """Views whose PSNR is far below that of the rest, the worst first: name, PSNR and the median of all, for each."""
    known = sorted((image["psnr"], image["image"]) for image in images if image.get("psnr") is not None)
    if len(known) < ENOUGH:
        return []
    lower, middle, upper = quantiles((value for value, _ in known), n=4, method="inclusive")
    fence = min(middle - BELOW, lower - 1.5 * (upper - lower))
    return [(name, value, middle) for value, name in known if value < fence]
