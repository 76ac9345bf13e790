# SPDX-License-Identifier: Apache-2.0
"""`nrfgs demo`: make a glossy scene whose truth is known, train NRF and SH on it, compare them.

Runs what a user would type (`ns-train`, `ns-eval`) in one process, on the CPU if there is no GPU.
"""

import contextlib
import json
import shlex
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from PIL import Image, ImageDraw
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from nrfgs_ns.scenes import SceneConfig, write_scene

METHODS = {"nrfgs": "NRF", "nrfgs-sh": "SH"}
RESIDUAL_GAIN = 4.0
"""How much the contact sheet amplifies NRF's view-dependent part around mid grey."""


@dataclass
class Demo:
    """Make a scene with known reflectance, train NRF and SH on it for the same number of steps, and compare them."""

    out: Path = Path("demo")
    """folder for the data set, the trainings, results.json and contact_sheet.png"""
    gloss: float = 1.0
    """0: everything is diffuse. 1: glossy and mirror-like."""
    steps: int = 1000
    """training steps of each method"""
    quick: bool = False
    """a smaller scene and fewer steps: a minute, to see that everything works"""
    seed: int = 42
    """seed of the scene and of both trainings"""

    def main(self) -> None:
        screen = Console(file=sys.__stdout__)
        scene, steps = self.scene(), min(self.steps, 150) if self.quick else self.steps
        results: dict[str, dict[str, Any]] = {}
        self.out.mkdir(parents=True, exist_ok=True)
        columns = TextColumn("{task.description:<24}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
        with Progress(*columns, console=screen) as progress:
            with _bar(progress, "make the scene", scene.views) as advance:
                data = write_scene(scene, self.out / self.scene_folder, progress=lambda *_: advance())
            # Heavy imports only when there is work to do: `nrfgs --help` answers at once, and so does a refusal.
            from nrfgs_ns.training.run import evaluate, machine, train

            for method, label in METHODS.items():
                args = self.train_args(method, data, steps)
                progress.console.print(f"[dim]$ ns-train {shlex.join(args)}", highlight=False, soft_wrap=True)
                with (self.out / f"{method}.log").open("w") as log, contextlib.redirect_stdout(log):
                    with _bar(progress, f"train {label}", steps) as advance:
                        record = train(args, on_step=lambda _: advance())
                    config = Path(record.config_path)
                    with _bar(progress, f"evaluate {label}", 1):
                        results[method] = {"eval": evaluate(config, config.parent / "eval.json")}
                results[method]["train"] = asdict(record)
        screen.print(comparison(results, steps))
        sheet = self.out / "contact_sheet.png"
        with (self.out / "contact_sheet.log").open("w") as log, contextlib.redirect_stdout(log):
            contact_sheet({method: Path(result["train"]["config_path"]) for method, result in results.items()}, sheet)
        summary = {"steps": steps, "scene": asdict(scene), "machine": machine(), "methods": results}
        (self.out / "results.json").write_text(json.dumps(summary, indent=1) + "\n")
        screen.print(f"Pictures: {sheet}. Numbers: {self.out / 'results.json'}. Look around with:")
        screen.print(f"  ns-viewer --load-config {results['nrfgs']['train']['config_path']}", soft_wrap=True)

    @property
    def scene_folder(self) -> str:
        """Folder of the data set inside `out`; its name tells one demo's scene from another's."""
        return f"scene-gloss{self.gloss:g}-seed{self.seed}" + ("-quick" if self.quick else "")

    def scene(self) -> SceneConfig:
        """The scene's configuration."""
        if self.quick:
            return SceneConfig(gloss=self.gloss, seed=self.seed, views=24, width=100, height=76, points=2000)
        return SceneConfig(gloss=self.gloss, seed=self.seed)

    def train_args(self, method: str, data: Path, steps: int) -> list[str]:
        """The options of `ns-train`: everything default but the number of steps and where things go.

        Splatfacto's schedules are made for 30,000 steps; here resolution and spherical harmonics reach their full size
        within the first third.
        """
        options = {
            "--data": data,
            "--output-dir": self.out / "outputs",
            "--max-num-iterations": steps,
            "--machine.seed": self.seed,
            "--vis": "tensorboard",
            "--steps-per-eval-image": 10 * steps,
            "--steps-per-eval-all-images": 10 * steps,
            "--logging.profiler": "none",
            "--pipeline.model.num-downscales": 1,
            "--pipeline.model.resolution-schedule": max(steps // 5, 1),
        }
        if method == "nrfgs-sh":
            options["--pipeline.model.appearance.degree-interval"] = max(steps // 10, 1)
        return [method, *(str(word) for option in options.items() for word in option)]


@contextlib.contextmanager
def _bar(progress: Progress, description: str, total: int):
    """A progress bar that is full when the block ends; yields what advances it."""
    task = progress.add_task(description, total=total)
    yield lambda: progress.advance(task)
    progress.update(task, completed=total)


def comparison(results: dict[str, dict[str, Any]], steps: int) -> Table:
    """The table at the end, one column for each method."""
    table = Table(title=f"Test views after {steps} steps each")
    table.add_column("")
    for label in METHODS.values():
        table.add_column(label, justify="right")

    def row(name: str, part: str, key: str, form: str, unit: float = 1.0) -> None:
        values = [results[method][part].get(key) for method in METHODS]
        table.add_row(name, *("-" if value is None else form.format(value / unit) for value in values))

    row("PSNR (dB)", "eval", "psnr", "{:.2f}")
    row("SSIM", "eval", "ssim", "{:.4f}")
    row("L1", "eval", "l1", "{:.4f}")
    row("splats", "eval", "splats", "{:,.0f}")
    row("parameters (MB)", "eval", "parameter_bytes", "{:.2f}", 1e6)
    row("training (s)", "train", "seconds", "{:.0f}")
    row("rendering (ms per image)", "eval", "seconds_per_image", "{:.0f}", 1e-3)
    return table


def contact_sheet(configs: dict[str, Path], path: Path, views: int = 3) -> None:
    """Write a picture of `views` test images: truth, NRF, SH, NRF's base colour alone, and its residual.

    Args:
        configs: method -> config.yml of its training.
        path: where the PNG goes.
    """
    from nerfstudio.utils.eval_utils import eval_setup

    columns: list[tuple[str, list[torch.Tensor]]] = []
    for method, label in METHODS.items():
        _, pipeline, _, _ = eval_setup(configs[method], test_mode="test")
        model = pipeline.model
        pairs = pipeline.datamanager.fixed_indices_eval_dataloader
        pairs = pairs[:: max(len(pairs) // views, 1)][:views]
        renders = [model.get_outputs_for_camera(camera)["rgb"] for camera, _ in pairs]
        if method == "nrfgs":
            bases = [model.get_base_color(camera) for camera, _ in pairs]
            columns.append(("truth", [model.get_gt_img(batch["image"])[..., :3] for _, batch in pairs]))
            residuals = [0.5 + RESIDUAL_GAIN * (render - base) for render, base in zip(renders, bases, strict=True)]
        columns.append((label, renders))
    columns += [("base colour only", bases), (f"view-dependent part x {RESIDUAL_GAIN:g}", residuals)]

    height, width = renders[0].shape[:2]
    gap, title = 4, 16
    sheet = Image.new("RGB", (len(columns) * (width + gap) - gap, title + len(pairs) * (height + gap)), "white")
    draw = ImageDraw.Draw(sheet)
    for column, (label, images) in enumerate(columns):
        x = column * (width + gap)
        draw.text((x + 2, 2), label, fill="black")
        for row, image in enumerate(images):
            pixels = (image.clamp(0, 1) * 255).round().byte().cpu().numpy()
            sheet.paste(Image.fromarray(pixels), (x, title + row * (height + gap)))
    sheet.save(path)
