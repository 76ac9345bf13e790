# SPDX-License-Identifier: Apache-2.0
"""Pictures of the study: what the models make of single samples and of the image, and PSNR against size."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nrfgs_lab.express.fit import Fitted
from nrfgs_lab.express.plan import Cell
from nrfgs_lab.express.report import EXACT, SETUPS
from nrfgs_lab.express.targets import CAP_DEGREES, Targets

SHOWN = ("sh-lsq", "nrf")
"""Models in the pictures."""
TITLES = ("truth", "SH degree 3", "its error x 3", "NRF", "its error x 3")
PERCENTILES = (0.99, 0.9, 0.6)
"""Which samples: by rank of how much their colour changes with the direction."""
ERROR_GAIN = 3.0
PANEL = 96
"""Pixels along a panel's edge."""


def shown_samples(targets: Targets) -> Tensor:
    """Indices of the samples in the picture."""
    order = targets.colors.var(dim=1).sum(-1).argsort()
    return order[[int(share * (len(order) - 1)) for share in PERCENTILES]]


def keep_panel(cell: Cell, targets: Targets, fitted: Fitted, folder: Path) -> None:
    """Keep what the picture needs of this fit, if it is one that is shown: colours at held-out directions."""
    if cell.group != "main" or cell.label not in SHOWN:
        return
    folder.mkdir(parents=True, exist_ok=True)
    if cell.setup == "image":
        directions, rows = targets.held_out_directions[:1], [slice(i, i + 2000) for i in range(0, len(targets), 2000)]
        truth = targets.held_out_colors[:, 0]
        model = torch.cat([fitted.colors(directions, part)[:, 0] for part in rows])
    else:
        chosen = shown_samples(targets)
        truth, model = targets.held_out_colors[chosen], fitted.colors(targets.held_out_directions, chosen)
    np.savez_compressed(
        folder / f"{cell.setup}-{cell.label}-seed{cell.seed}.npz",
        truth=to_bytes(truth),
        model=to_bytes(model),
        directions=targets.held_out_directions.cpu().numpy(),
    )


def to_bytes(colors: Tensor) -> np.ndarray:
    """uint8 of colours in [0, 1]."""
    return (colors.clamp(0.0, 1.0) * 255.0).round().byte().cpu().numpy()


def draw(summary: dict[str, Any], out: Path) -> list[Path]:
    """Draw what the summary and the panels in `out` allow; returns the pictures' paths."""
    import matplotlib
    from PIL import Image

    matplotlib.use("Agg")
    paths = []
    if summary["sweep"]:
        paths.append(draw_sweep(summary, out / "express-sweep.png"))
    for name, sheet in (
        ("express-samples.png", samples_sheet(out / "panels")),
        ("express-image.jpg", image_sheet(out / "panels")),
    ):
        if sheet is not None:
            Image.fromarray(titled(sheet)).save(out / name, quality=85)
            paths.append(out / name)
    return paths


def draw_sweep(summary: dict[str, Any], path: Path) -> Path:
    """PSNR against the number of parameters, mean over seeds; held-out directions dashed."""
    import matplotlib.pyplot as plt

    setups = [setup for setup in SETUPS if any(row["setup"] == setup for row in summary["sweep"])]
    figure, axes = plt.subplots(1, len(setups), figsize=(5.0 * len(setups), 3.8), squeeze=False)
    names = {
        "degree": "SH, degree 0 to 5 (least squares)",
        "latent_dim": "NRF, latent 4 to 32",
        "width": "NRF, width 16 to 128",
        "bands": "NRF, bands K = 1 to 6",
    }
    for axis, setup in zip(axes[0], setups, strict=True):
        center = [row for row in summary["table"] if (row["setup"], row["model"]) == (setup, "nrf")]
        for colour, (key, name) in zip(("0.4", "C0", "C1", "C2"), names.items(), strict=True):
            points = [row for row in summary["sweep"] if (row["setup"], row["model"]) == (setup, key)]
            points += center if key != "degree" else []
            points = [row for row in points if row["train_psnr"]["mean"] < EXACT]
            points.sort(key=lambda row: row["parameters"])
            sizes = [row["parameters"] for row in points]
            train = [row["train_psnr"]["mean"] for row in points]
            held_out = [row["held_out_psnr"]["mean"] for row in points]
            axis.plot(sizes, train, "o-", color=colour, ms=3, lw=1, label=name)
            axis.plot(sizes, held_out, "x--", color=colour, ms=4, lw=0.8)
        axis.set_ylim(bottom=15.0)
        axis.set_xscale("log")
        axis.set_xlabel("parameters")
        axis.set_ylabel("PSNR (dB)")
        axis.set_title(SETUPS[setup], fontsize=10)
        axis.grid(alpha=0.3)
    axes[0][0].legend(fontsize=7)
    figure.suptitle("solid: training directions, dashed: held-out directions", fontsize=9)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path


def samples_sheet(folder: Path) -> np.ndarray | None:
    """Rows: samples. Columns: truth, then each model and its error. uint8 [H, W, 3], or None without panels."""
    rows = []
    for setup in ("synthetic", "pixels"):
        files = [next(iter(sorted(folder.glob(f"{setup}-{label}-seed*.npz"))), None) for label in SHOWN]
        if None in files:
            continue
        loaded = [dict(np.load(file)) for file in files]
        nearest = nearest_direction(torch.from_numpy(loaded[0]["directions"]), setup == "synthetic")
        for sample in range(len(loaded[0]["truth"])):
            truth = loaded[0]["truth"][sample].astype(float)
            columns = [truth]
            for arrays in loaded:
                model = arrays["model"][sample].astype(float)
                columns += [model, np.clip(ERROR_GAIN * np.abs(model - truth), 0.0, 255.0)]
            rows.append(np.concatenate([padded(paint(colors, nearest)) for colors in columns], axis=1))
    return np.concatenate(rows) if rows else None


def nearest_direction(directions: Tensor, sphere: bool) -> np.ndarray:
    """Index of the direction nearest to each pixel of a panel, -1 outside.

    The whole sphere is laid out by longitude and height (equal areas), a cap as seen from above (angle = radius).
    """
    if sphere:
        height, width = PANEL, 2 * PANEL
        z = 1.0 - 2.0 * (torch.arange(height)[:, None] + 0.5) / height
        phi = 2.0 * math.pi * (torch.arange(width)[None] + 0.5) / width
        s = (1.0 - z.square()).sqrt()
        at = torch.stack([s * phi.cos(), s * phi.sin(), z.expand(-1, width)], dim=-1)
        inside = torch.ones(height, width, dtype=torch.bool)
    else:
        height, width = PANEL, 2 * PANEL
        y = (torch.arange(height)[:, None] + 0.5 - height / 2) / (height / 2)
        x = (torch.arange(width)[None] + 0.5 - width / 2) / (height / 2)
        radius = (x.square() + y.square()).sqrt()
        theta = radius * math.radians(CAP_DEGREES)
        inside = radius <= 1.0
        sine = theta.sin() / radius.clamp_min(1e-6)
        at = torch.stack([x * sine, -y * sine, theta.cos()], dim=-1)
    index = (at.view(-1, 3) @ directions.T).argmax(-1).view(height, width)
    return torch.where(inside, index, -1).numpy()


def paint(colors: np.ndarray, nearest: np.ndarray) -> np.ndarray:
    """Panel of colours [E, 3], white outside."""
    panel = colors[nearest]
    panel[nearest < 0] = 255.0
    return panel.round().astype(np.uint8)


def titled(sheet: np.ndarray) -> np.ndarray:
    """With the columns' titles above."""
    from PIL import Image, ImageDraw

    band = Image.new("RGB", (sheet.shape[1], 16), "white")
    for column, title in enumerate(TITLES):
        ImageDraw.Draw(band).text((column * sheet.shape[1] // len(TITLES) + 4, 2), title, fill="black")
    return np.concatenate([np.asarray(band), sheet])


def padded(panel: np.ndarray) -> np.ndarray:
    """With a white rim."""
    return np.pad(panel, ((3, 3), (3, 3), (0, 0)), constant_values=255)


def image_sheet(folder: Path) -> np.ndarray | None:
    """The image from one held-out direction: truth, then each model and its error; or None without panels."""
    files = [next(iter(sorted(folder.glob(f"image-{label}-seed*.npz"))), None) for label in SHOWN]
    if None in files:
        return None
    loaded = [dict(np.load(file)) for file in files]
    side = math.isqrt(len(loaded[0]["truth"]))
    truth = loaded[0]["truth"].astype(float)
    columns = [truth]
    for arrays in loaded:
        columns += [arrays["model"].astype(float), np.clip(ERROR_GAIN * np.abs(arrays["model"] - truth), 0.0, 255.0)]
    middle = slice(0, min(side, 240))
    return np.concatenate(
        [padded(column.reshape(side, side, 3)[middle, middle].round().astype(np.uint8)) for column in columns], axis=1
    )
