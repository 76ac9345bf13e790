# SPDX-License-Identifier: Apache-2.0
"""The table of docs/export.md."""

from typing import Any

from nrfgs_lab.pages.tables import grid, records


def files() -> dict[str, dict[str, Any]]:
    """The reports of `nrfgs export ply`: of the page's own, and of the captures of docs/compact-format.md."""
    whole = {name: one for name, one in records("compact").items() if name.endswith("-ply")}
    return {**records("export"), **{f"{name.removesuffix('-ply')}, full size": one for name, one in whole.items()}}


def losses() -> str:
    """What a PLY file loses of each model."""
    body = []
    for name, one in files().items():
        numbers = [f"{one[f'psnr_{part}']:.2f}" for part in ("model", "file", "colors", "base")]
        body.append([name, f"{one['splats']:,}", f"{one['bytes'] / 1e6:.1f}", f"{one['ridge_views']:g}", *numbers])
    head = ["", "splats", "MB", "ridge (views)", "model", "file", "fitted colours, the model's opacities", "no fit"]
    return grid(head, body)


def worst() -> str:
    """The largest loss among them."""
    return f"{max(one['loss_db'] for one in files().values()):.1f}"


def colours() -> str:
    """The largest loss of fitted colours alone."""
    return f"{max(one['psnr_model'] - one['psnr_colors'] for one in files().values()):.1f}"
