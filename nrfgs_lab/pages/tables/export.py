# SPDX-License-Identifier: Apache-2.0
"""The table of docs/export.md: reports of `nrfgs export ply` among the records of `nrfgs_lab.compact`."""

import re
from statistics import fmean
from typing import Any

from nrfgs_lab.pages.tables import grid, records, signed
from nrfgs_lab.pages.tables.readme import SHRUNK, runs_of


def files() -> dict[str, dict[str, Any]]:
    """The reports of captures."""
    found = {name: one for name, one in records("compact").items() if name.endswith("-ply")}
    return {name.removesuffix("-ply"): one for name, one in found.items() if not name.startswith("held-out-")}


def losses() -> str:
    """What a PLY file loses of each model; beside it, harmonics that were trained themselves."""
    body = []
    for name, one in files().items():
        numbers = [f"{one[f'psnr_{part}']:.2f}" for part in ("model", "file", "on_screen")]
        trained = fmean(run["psnr"] for run in runs_of(name, SHRUNK))
        cells = [f"{one['splats']:,}", f"{one['bytes'] / 1e6:.1f}", f"{one['seconds']['fit']:.0f}"]
        body.append([name, *cells, *numbers, f"{trained:.2f}"])
    return grid(["", "splats", "MB", "seconds", "model", "file", "in Spark", "harmonics, trained"], body)


def worst() -> str:
    """The largest loss among them."""
    return f"{max(one['loss_db'] for one in files().values()):.1f}"


def settings() -> str:
    """Decibels by which files differ from models on held-out views, after none, the fewest and the most steps tried."""
    found: dict[str, dict[int, str]] = {}
    for name, one in records("compact").items():
        if match := re.fullmatch(r"held-out-(\w+)-ply-STEPS=(\d+)", name):
            found.setdefault(match[1], {})[int(match[2])] = signed(-one["loss_db"], 2)
    return "; ".join(
        f"{scene} " + ", ".join(f"{one[steps]} ({steps:,})" for steps in [*sorted(one)[:2], max(one)])
        for scene, one in found.items()
    )


def small(kind: str, what: str) -> str:
    """MB or PSNR of a small capture's PLY file, or what splat-transform makes of it; "model": PSNR of the model."""
    one = records("export")[f"fox-eighth-{kind}"]
    return f"{one['bytes'] / 1e6:.2f}" if what == "MB" else f"{one[f'psnr_{what}']:.2f}"
