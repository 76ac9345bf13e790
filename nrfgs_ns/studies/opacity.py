# SPDX-License-Identifier: Apache-2.0
"""What becomes of opacity when it is a function of the view: dead gradients, flicker along a camera path, and what can
still be seen when the stored opacities have been reset.

    nrfgs bench docs/bench/opacity.yaml --scenes DATA --out RECORDS --work WORK
    python -m nrfgs_ns.studies.opacity --records RECORDS --work WORK

The first trains the bounds of `appearance/opacity_bound.py` on real scenes; the second looks at its checkpoints, and
writes `opacity.json` and `opacity.md` beside its records. It looks at those of `docs/bench/opacity-seen.yaml` as well.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from nerfstudio.cameras.camera_paths import get_interpolated_camera_path
from nerfstudio.utils.eval_utils import eval_setup
from rich.progress import track
from torch import Tensor

from nrfgs_ns.appearance.head import SplatAppearance
from nrfgs_ns.metrics import ImageMetrics
from nrfgs_ns.model import NrfgsModel
from nrfgs_ns.rendering import View
from nrfgs_ns.studies.files import write_whole
from nrfgs_ns.studies.measure import evenly_spaced, over_views

RESET = 0.01
"""3DGS brings stored opacities down to this, every 3,000 steps."""
DEAD = 1e-3
"""A splat's latent hears nothing of opacity if its gradient's norm is less than this share of the mean norm."""


@dataclass
class OpacityStudy:
    """Where the benchmark's records and checkpoints are."""

    records: Path
    """the benchmark's --out"""
    work: Path
    """the benchmark's --work"""
    views: int = 16
    """training views, evenly spaced, over which dead gradients are counted"""
    cameras: int = 4
    """test views, evenly spaced, that the path leads through"""
    frames: int = 24
    """frames from one of them to the next"""

    def main(self) -> None:
        rows = []
        for path in track(sorted((self.records / "runs").glob("*.json")), "Looking at opacity"):
            record = json.loads(path.read_text(encoding="utf-8"))
            _, pipeline, _, _ = eval_setup(self.work / path.stem / record["train"]["config_path"])
            rows.append({"run": path.stem, **summary(record), **self.look(pipeline)})
        write_whole(self.records / "opacity.json", json.dumps(rows, indent=1) + "\n")
        table = as_table(rows)
        write_whole(self.records / "opacity.md", table)
        print(table)

    def look(self, pipeline) -> dict[str, float | None]:
        """Dead gradients over training views (None without latents), flicker along a path through test views, and the
        PSNR on all of those after a reset."""
        model = pipeline.model.eval()
        cameras = pipeline.datamanager.train_dataset.cameras.to(model.device)
        seen = evenly_spaced(len(cameras), self.views) if "latents" in model.gauss_params else []
        dead = [dead_share(model, cameras[i : i + 1]) for i in seen]
        test = pipeline.datamanager.eval_dataset.cameras
        stops = test[torch.tensor(evenly_spaced(len(test), self.cameras))]
        path = get_interpolated_camera_path(stops, self.frames, order_poses=True).to(model.device)
        return {
            "dead_share": sum(dead) / len(dead) if dead else None,
            **flicker(model, [path[i : i + 1] for i in range(len(path))]),
            "psnr_after_reset": after_reset(pipeline),
        }


def summary(record: dict[str, Any]) -> dict[str, Any]:
    """What the benchmark has measured already."""
    test = record["measured"]["test"]
    return {
        "scene": record["identity"]["scene"],
        "psnr": test["psnr"],
        "ssim": test["ssim"],
        "splats": record["measured"]["splats"],
    }


def appearance(model: NrfgsModel, view: View, splats: dict[str, Tensor] | None = None) -> SplatAppearance:
    return model.head(splats or view.splats, view.visible, view.center)


def dead_share(model: NrfgsModel, camera) -> float:
    """Share of the visible splats whose latents get no gradient from their own opacity (see DEAD)."""
    view = model.look(camera)
    splats = {name: value.detach() for name, value in view.splats.items()}
    splats["latents"].requires_grad_()
    appearance(model, view, splats).opacities.sum().backward()
    norms = splats["latents"].grad[view.visible].norm(dim=-1)
    return (norms < DEAD * norms.mean()).float().mean().item()


@torch.no_grad()
def flicker(model: NrfgsModel, cameras: list) -> dict[str, float]:
    """Frame-to-frame changes along a smooth path.

    Returns:
        "opacity_change": mean |difference| of a splat's opacity between frames, over splats seen in both.
        "opacity_jerk": the same of its second difference, over splats seen in three: what is left of a steady change.
    """
    changes, jerks, earlier = [], [], []
    for camera in cameras:
        view = model.look(camera)
        opacity = torch.full((len(view.splats["means"]),), torch.nan, device=view.center.device)
        opacity[view.visible] = appearance(model, view).opacities
        if earlier:
            changes.append((opacity - earlier[-1]).abs().nanmean().item())
        if len(earlier) > 1:
            jerks.append((opacity - 2 * earlier[-1] + earlier[-2]).abs().nanmean().item())
        earlier = [*earlier[-1:], opacity]
    return {"opacity_change": sum(changes) / len(changes), "opacity_jerk": sum(jerks) / len(jerks)}


@torch.no_grad()
def after_reset(pipeline) -> float:
    """PSNR on test views if stored opacities were brought down to RESET: what residuals show of the scene. The model
    is left as it was."""
    model, data = pipeline.model, pipeline.datamanager
    logits = model.gauss_params["opacities"]
    stored = logits.clone()
    names = [path.name for path in data.eval_dataset.image_filenames]
    logits.clamp_(max=math.log(RESET / (1 - RESET)))
    try:
        views = zip(names, data.fixed_indices_eval_dataloader, strict=True)
        return over_views(model, ImageMetrics(), views)["psnr"]
    finally:
        logits.copy_(stored)


def as_table(rows: list[dict[str, Any]]) -> str:
    """The rows in Markdown."""
    lines = [
        "| run | PSNR | after a reset | SSIM | splats | dead gradients | change per frame | second difference |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for row in rows:
        dead = "-" if row["dead_share"] is None else f"{row['dead_share']:.1%}"
        lines.append(
            f"| {row['run']} | {row['psnr']:.2f} | {row['psnr_after_reset']:.2f} | {row['ssim']:.4f} "
            f"| {row['splats']:,} | {dead} | {row['opacity_change']:.5f} | {row['opacity_jerk']:.5f} |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    tyro.cli(OpacityStudy, description=__doc__).main()
