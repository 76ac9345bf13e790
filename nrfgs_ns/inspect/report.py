# SPDX-License-Identifier: Apache-2.0
"""What was measured, as a table, a figure and a sentence."""

from pathlib import Path
from typing import Any

from rich.table import Table

GROUPS = {
    "full": "",
    "part": "parts, left out",
    "input": "inputs of the view, set to 0",
    "rank": "latents of fewer numbers",
    "residual": "splats made diffuse",
    "together": "all that costs next to nothing",
}
SHOWN_RANKS = (1, 2, 4, 8, 12, 16, 24, 32, 48, 64)
"""Ranks in the printed table; the JSON and the figure have all."""


def table(result: dict[str, Any]) -> Table:
    """All rows, but of the ranks only a few. An input that is 0 costs what it cost before: its time is not shown."""
    full = result["rows"][0]
    printed = Table(title=f"{result['splats']:,} splats, {result['views']} held-out views")
    for column in ("left out", "PSNR (dB)", "loss (dB)", "MB", "bytes", "head (ms)", "head time", "diffuse"):
        printed.add_column(column, justify="left" if column == "left out" else "right")
    group = None
    for row in [*result["rows"], result["together"]]:
        if row["group"] == "rank" and row["rank"] not in SHOWN_RANKS:
            continue
        if row["group"] != group:
            group = row["group"]
            if GROUPS[group]:
                printed.add_section()
                printed.add_row(f"[bold]{GROUPS[group]}")
        first = row is result["rows"][0]
        printed.add_row(
            row["part"],
            f"{row['psnr']:.2f}",
            "" if first else f"{row['loss_db']:.3f}",
            f"{row['bytes'] / 1e6:.2f}",
            "" if first else _change(row["bytes"], full["bytes"]),
            "" if row["group"] == "input" else f"{1e3 * row['head_seconds']:.1f}",
            "" if first or row["group"] == "input" else _change(row["head_seconds"], full["head_seconds"]),
            f"{100 * row['diffuse']:.0f} %" if row["diffuse"] else "",
        )
    return printed


def _change(value: float, full: float) -> str:
    return f"{100 * (value / full - 1):+.0f} %"


def advice(rows: list[dict[str, Any]], together: dict[str, Any], left_out: list[str], budget: float) -> str:
    """One sentence: what this scene does not need, and what that is worth."""
    full = rows[0]
    if full["diffuse"] == 1.0:
        return "No splat of this model has a residual: there is nothing left to leave out."
    nothing = next((row for row in rows if row["threshold"] == float("inf")), None)
    worth = "" if nothing is None else f"View dependence is worth {nothing['loss_db']:.2f} dB here. "
    if not left_out:
        return worth + f"Every part pays: nothing can be left out within {budget:g} dB."
    saved = 1 - together["bytes"] / full["bytes"]
    faster = 1 - together["head_seconds"] / full["head_seconds"]
    time = f"{100 * faster:.0f} % of the head's time" if faster > 0 else "no time"
    return worth + (
        f"Left out together, {', '.join(left_out)} cost {together['loss_db']:.3f} dB and save {100 * saved:.0f} % of "
        f"the bytes and {time} on this machine."
    )


def draw(result: dict[str, Any], path: Path) -> None:
    """Three panels: what parts are worth, loss against the latents' rank, loss and share against the threshold."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    rows = result["rows"]
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(13.0, 3.8))
    parts = [row for row in rows if row["group"] in ("part", "input")][::-1]
    left.barh(
        [row["part"] for row in parts],
        [row["loss_db"] for row in parts],
        color=["C0" if row["group"] == "part" else "0.6" for row in parts],
    )
    left.set_xlabel("loss without it (dB)")
    ranks = [row for row in rows if row["group"] == "rank"]
    middle.plot([row["rank"] for row in ranks], [row["loss_db"] for row in ranks], "o-", ms=3, lw=1)
    middle.axhline(result["budget_db"], color="0.6", ls="--", lw=0.8)
    middle.set_xlabel("numbers in a latent")
    middle.set_ylabel("loss (dB)")
    middle.set_yscale("symlog", linthresh=1e-2)
    dropped = [row for row in rows if row["group"] == "residual" and row["threshold"] != float("inf")]
    right.plot([row["threshold"] for row in dropped], [row["loss_db"] for row in dropped], "o-", ms=3, lw=1)
    right.axvline(0.5, color="0.6", ls="--", lw=0.8)
    right.set_xscale("log", base=2)
    right.set_xlabel("largest change of diffuse splats (8-bit steps)")
    right.set_ylabel("loss (dB)")
    share = right.twinx()
    share.plot([row["threshold"] for row in dropped], [100 * row["diffuse"] for row in dropped], "x:", color="C1", lw=1)
    share.set_ylabel("diffuse splats (%)", color="C1")
    share.set_ylim(0, 100)
    for axis in (left, middle, right):
        axis.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)
