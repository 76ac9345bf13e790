# SPDX-License-Identifier: Apache-2.0
"""Blocks of docs/compact-format.md, docs/export.md and docs/web.md: what files of a model cost and lose."""

from typing import Any

from nrfgs_lab.pages.few_views import SAME, alone
from nrfgs_lab.pages.runs import grid, mean, records

Report = dict[str, Any]


def reports(scene: str) -> dict[str, Report]:
    """The records of a scene's files, the largest file first."""
    every = {name.removeprefix(f"{scene}-"): one for name, one in records("compact").items() if name.startswith(scene)}
    return dict(sorted(((n, one) for n, one in every.items() if "bytes" in one), key=lambda pair: -pair[1]["bytes"]))


def plies() -> dict[str, Report]:
    """Capture -> the report of its PLY file."""
    return {scene: one for scene in ("bonsai", "caliterra", "fox", "goldcape") if (one := reports(scene).get("ply"))}


def losses() -> str:
    """Loss of a PLY file against each model; beside it, harmonics that were trained themselves."""
    body = []
    for scene, one in plies().items():
        cost = f"{one['splats']:,}", f"{one['bytes'] / 1e6:.1f}"
        psnr = *(one[f"psnr_{part}"] for part in ("model", "file", "on_screen")), mean(alone(scene, SAME), "psnr")
        body.append([scene, *cost, *map("{:.2f}".format, psnr)])
    return grid(["", "splats", "MB", "model", "file", "in Spark", "harmonics, trained"], body)


def worst() -> str:
    """The largest loss of a PLY file, by our rasterizer or in Spark."""
    return f"{max(one['psnr_model'] - min(one['psnr_file'], one['psnr_on_screen']) for one in plies().values()):.1f}"


BLOCKS = {"export.losses": losses, "export.worst": worst}
