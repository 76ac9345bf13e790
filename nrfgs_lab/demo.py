# SPDX-License-Identifier: Apache-2.0
"""`nrfgs demo`: make a glossy scene whose truth is known, train NRF and SH on it, compare them.

Runs what a user would type (`ns-train`, `ns-eval`) in one process, on the CPU if there is no GPU.
"""

import contextlib
import json
import shlex
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from PIL import Image, ImageDraw, ImageFont
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from nrfgs_lab.scenes import SceneConfig, build_scene, dome_cameras, render, split_names, write_scene
from nrfgs_ns.errors import InputError
from nrfgs_ns.files import check_writable

METHODS = {"nrfgs": "NRF", "nrfgs-sh": "SH"}
RESIDUAL_GAIN = 4.0
"""How much the contact sheet amplifies NRF's view-dependent part around mid grey."""
CELL = 280
"""Width of a picture in the contact sheet, pixels."""
SHINES = 0.1
"""How much of white gloss must change a pixel's truth for it to count as one that shines."""


@dataclass
class Demo:
    """Make a glossy scene, train NRF and SH on it for the same number of steps, and compare them."""

    out: Path = Path("demo")
    """folder for the data set, the trainings, results.json and contact_sheet.png"""
    gloss: float = 1.0
    """0: everything is diffuse. 1: satin and glossy."""
    steps: int = 800
    """training steps of each method"""
    quick: bool = False
    """a smaller scene and fewer steps: a minute, to see that everything works"""
    seed: int = 42
    """seed of the scene and of both trainings"""

    def main(self) -> None:
        with _one_thread():
            self._run(Console(file=sys.__stdout__))

    def _run(self, screen: Console) -> None:
        if self.steps < 1:  # ns-train nrfgs would take 0 for as many as it finds right
            raise InputError(f"--steps is {self.steps}; it must be at least 1.")
        try:
            scene = self.scene()
        except ValueError as error:
            raise InputError(f"{error}. Change --gloss or --seed.") from error
        check_writable(self.out / "results.json", "--out")
        steps = min(self.steps, 150) if self.quick else self.steps
        results: dict[str, dict[str, Any]] = {}
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
        with (self.out / "contact_sheet.log").open("w") as log, contextlib.redirect_stdout(log):
            views = {method: seen_views(Path(one["train"]["config_path"]), scene) for method, one in results.items()}
        for method, seen in views.items():
            results[method]["shine"] = where_it_shines(seen)
        screen.print(comparison(results, steps))
        sheet = self.out / "contact_sheet.png"
        contact_sheet(views, sheet)
        summary = {"steps": steps, "scene": asdict(scene), "machine": machine(), "methods": results}
        (self.out / "results.json").write_text(json.dumps(summary, indent=1) + "\n")
        screen.print(f"Pictures: {sheet}. Numbers: {self.out / 'results.json'}. Look around with:")
        screen.print(f"  nrfgs view {results['nrfgs']['train']['config_path']}", soft_wrap=True)

    @property
    def scene_folder(self) -> str:
        """Folder of the data set inside `out`; its name tells one demo's scene from another's."""
        return f"scene-gloss{self.gloss:g}-seed{self.seed}" + ("-quick" if self.quick else "")

    def scene(self) -> SceneConfig:
        """The scene's configuration."""
        if self.quick:
            return SceneConfig(
                gloss=self.gloss, mirror=0.0, seed=self.seed, views=24, width=100, height=76, points=2000
            )
        return SceneConfig(gloss=self.gloss, mirror=0.0, seed=self.seed, views=72, width=160, height=120, points=6000)

    def train_args(self, method: str, data: Path, steps: int) -> list[str]:
        """The options of `ns-train`: as many splats for both as the scene has points, and schedules that fit the steps.

        Splatfacto's are made for 30,000 steps; here resolution and spherical harmonics reach their full size within the
        first third.
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
            "--pipeline.model.densification": f"mcmc,budget={self.scene().points}",
            "--pipeline.model.num-downscales": 1,
            "--pipeline.model.resolution-schedule": max(steps // 5, 1),
        }
        if method == "nrfgs-sh":
            options["--pipeline.model.appearance.degree-interval"] = max(steps // 10, 1)
        return [method, *(str(word) for option in options.items() for word in option)]


@contextlib.contextmanager
def _one_thread():
    """Let torch compute with one CPU thread until the block ends.

    Threads that share their cores with another program wait for each other, most of the time in loops: two on two busy
    cores take as long as one, and several times the CPU.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


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

    row("PSNR where it shines (dB)", "shine", "psnr", "{:.2f}")
    row("  of the base colour alone", "shine", "psnr_base", "{:.2f}")
    row("PSNR (dB)", "eval", "psnr", "{:.2f}")
    row("SSIM", "eval", "ssim", "{:.4f}")
    row("L1", "eval", "l1", "{:.4f}")
    row("splats", "eval", "splats", "{:,.0f}")
    row("parameters (MB)", "eval", "parameter_bytes", "{:.2f}", 1e6)
    row("training (s)", "train", "seconds", "{:.0f}")
    row("rendering (ms per image)", "eval", "seconds_per_image", "{:.0f}", 1e-3)
    return table


@dataclass
class SeenView:
    """One test view of the demo, as a trained model shows it. Pictures are [H, W, 3] in [0, 1]."""

    truth: torch.Tensor
    dull: torch.Tensor
    """the truth without gloss, as the ray tracer has it"""
    rendered: torch.Tensor
    base: torch.Tensor
    """base colours and opacities alone"""

    @property
    def shine(self) -> torch.Tensor:
        """What gloss does to a pixel, its strongest channel, [H, W]."""
        return (self.truth - self.dull).abs().amax(dim=-1)


def seen_views(config: Path, scene: SceneConfig) -> list[SeenView]:
    """All test views of a training on a procedural scene."""
    from nrfgs_ns.trained.loading import load_model

    pipeline = load_model(config, "test")
    model, dull = pipeline.model, build_scene(replace(scene, gloss=0.0))
    cameras = dict(zip(sorted(sum(split_names(scene), [])), dome_cameras(scene), strict=True))
    views = []
    names = pipeline.datamanager.eval_dataset.image_filenames
    for name, (camera, batch) in zip(names, pipeline.datamanager.fixed_indices_eval_dataloader, strict=True):
        truth = model.get_gt_img(batch["image"])[..., :3].cpu()
        without = torch.from_numpy(render(dull, cameras[f"images/{Path(name).name}"]))
        rendered, base = model.get_outputs_for_camera(camera)["rgb"], model.get_base_color(camera)
        views.append(SeenView(truth, without, rendered.cpu(), base.cpu()))
    return views


def where_it_shines(views: list[SeenView]) -> dict[str, float | None]:
    """PSNR of the pixels whose truth gloss changes by more than SHINES, over all views; with the share of such pixels.

    None where there are none, as without gloss.
    """
    shines = [view.shine > SHINES for view in views]
    share = float(torch.stack(shines).float().mean())
    if share == 0:
        return {"share": share, "psnr": None, "psnr_base": None}

    def psnr(name: str) -> float:
        pairs = zip(views, shines, strict=True)
        wrong = torch.cat([(getattr(view, name) - view.truth)[shine] for view, shine in pairs])
        return float(-10 * torch.log10(wrong.square().mean()))

    return {"share": share, "psnr": psnr("rendered"), "psnr_base": psnr("base")}


def brightest_window(shine: torch.Tensor) -> tuple[int, int, int, int]:
    """The window of a third of a picture's sides in which gloss does most: top, left, height, width, pixels."""
    height, width = (max(size // 3, 1) for size in shine.shape)
    sums = torch.nn.functional.avg_pool2d(shine[None, None], (height, width), stride=1)[0, 0]
    place = int(sums.argmax())
    return place // sums.shape[1], place % sums.shape[1], height, width


def contact_sheet(views: dict[str, list[SeenView]], path: Path) -> None:
    """Write a picture of three test views, each whole and below it where it shines most: truth, NRF, SH, NRF's base
    colour alone, and what NRF adds to it.

    Args:
        views: method -> its test views.
    """
    nrf, sh = views["nrfgs"], views["nrfgs-sh"]
    chosen = range(0, len(nrf), max(len(nrf) // 3, 1))[:3]
    columns = {
        "truth": [view.truth for view in nrf],
        METHODS["nrfgs"]: [view.rendered for view in nrf],
        METHODS["nrfgs-sh"]: [view.rendered for view in sh],
        "NRF's base colour alone": [view.base for view in nrf],
        f"what NRF adds to it, x {RESIDUAL_GAIN:g}": [
            0.5 + RESIDUAL_GAIN * (view.rendered - view.base) for view in nrf
        ],
    }
    height = round(CELL * nrf[0].truth.shape[0] / nrf[0].truth.shape[1])
    gap, title, font = 6, 26, ImageFont.load_default(16)
    size = len(columns) * (CELL + gap) - gap, title + len(chosen) * (2 * height + 3 * gap)
    sheet = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(sheet)
    for column, (label, images) in enumerate(columns.items()):
        x = column * (CELL + gap)
        draw.text((x + 2, 3), label, fill="black", font=font)
        for row, index in enumerate(chosen):
            y = title + row * (2 * height + 3 * gap)
            top, left, high, wide = brightest_window(nrf[index].shine)
            part = images[index][top : top + high, left : left + wide]
            for image, below in ((images[index], 0), (part, height + gap)):
                pixels = (image.clamp(0, 1) * 255).round().byte().numpy()
                sheet.paste(Image.fromarray(pixels).resize((CELL, height), Image.Resampling.BICUBIC), (x, y + below))
    sheet.save(path)
