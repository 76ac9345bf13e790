# SPDX-License-Identifier: Apache-2.0
"""`nrfgs demo` runs what a user would type (`ns-train`, `ns-eval`) in one process, on the CPU if there is no GPU."""

import contextlib
import json
import math
import shlex
import shutil
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean, stdev
from time import process_time
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Column, Table

from nrfgs_lab.scenes import SceneConfig, write_scene
from nrfgs_ns.errors import InputError
from nrfgs_ns.files import check_writable

NRF, SH = "nrfgs", "nrfgs-sh"
METHODS = {NRF: "NRF", SH: "SH"}
"""Method -> its label."""
RATES = {
    NRF: {"--optimizers.latents.optimizer.lr": 0.01},
    SH: {"--optimizers.features-rest.optimizer.lr": 0.003, "--pipeline.model.appearance.degree-interval": 3000},
}
"""Best of a few rates on another seed of the scene; splatfacto's rates for harmonics are for 30,000 steps."""
ENOUGH_STEPS = 400
"""Fewer are too few for a verdict: neither method has learnt its view dependence."""
SMALLEST_GAIN = 0.2
"""Mean gain where it shines, in dB, below which there is no clear difference."""


@dataclass
class Demo:
    """Make a glossy scene, train the field on it, and show what view dependence adds; with harmonics, compare them."""

    out: Path = Path("demo")
    """folder for the data set, the trainings, results.json and the pictures"""
    gloss: float = 1.0
    """0: everything is diffuse. 1: satin."""
    compare: bool = False
    """train harmonics, too, for as many steps"""
    steps: int = 700
    """training steps of each method"""
    quick: bool = False
    """a smaller scene and fewer steps: half a minute, to see that everything works"""
    seed: int = 42
    """seed of the scene and of both trainings"""

    def main(self) -> None:
        from nrfgs_ns.threads import few_threads  # imports torch

        with few_threads():
            self._run(Console(file=sys.__stdout__, highlight=False))

    def _run(self, screen: Console) -> None:
        if self.steps < 1:  # ns-train nrfgs would take 0 for as many as it finds right
            raise InputError(f"--steps is {self.steps}; it must be at least 1.")
        scene = self.scene()
        folder = f"scene-gloss{self.gloss:g}-seed{self.seed}" + ("-quick" if self.quick else "")
        check_writable(self.out / "results.json", "--out")
        steps = min(self.steps, 150) if self.quick else self.steps
        results: dict[str, dict[str, Any]] = {}
        columns = TextColumn("{task.description:<24}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
        with Progress(*columns, console=screen) as progress:
            with _bar(progress, "make the scene", scene.views) as advance:
                data = write_scene(scene, self.out / folder, advance)
            # Heavy imports only when there is work to do: `nrfgs --help` answers at once, and so does a refusal.
            from nrfgs_lab.demo.pictures import contact_sheet, strip
            from nrfgs_lab.demo.views import Look, where_it_shines
            from nrfgs_lab.training_run import evaluate, machine, train

            views, highlights = {}, {}
            for method, label in METHODS.items() if self.compare else [(NRF, METHODS[NRF])]:
                args = self.train_args(method, data, steps)
                progress.console.print(f"[dim]$ ns-train {shlex.join(args)}", soft_wrap=True)
                with (self.out / f"{method}.log").open("w") as log, contextlib.redirect_stdout(log):
                    start = process_time()
                    with _bar(progress, f"train {label}", steps) as advance:
                        record = train(args, on_step=lambda _: advance())
                    seconds = process_time() - start
                    config = Path(record.config_path)
                    with _bar(progress, f"evaluate {label}", 1):
                        scores = evaluate(config, config.parent / "eval.json")
                        look = Look(config, scene)
                        views[label] = look.test_views()
                        brightest = max(range(len(look.poses)), key=lambda i: float(views[label][i].shine.mean()))
                        highlights[label] = look.highlight(brightest, views[label][brightest].shine)
                train_record = {**asdict(record), "processor_seconds": seconds}
                results[method] = {"eval": scores, "shine": where_it_shines(views[label]), "train": train_record}
        contact_sheet(views, self.out / "contact_sheet.png")
        strip(highlights, self.out / "highlight.png")
        said = verdict(results, steps)
        summary = {"steps": steps, "scene": asdict(scene), "machine": machine(), "verdict": said, "methods": results}
        (self.out / "results.json").write_text(json.dumps(summary, indent=1) + "\n")
        screen.print(comparison(results, steps))
        screen.print(f"[bold]{said}")
        screen.print(f"In {self.out}: contact_sheet.png, highlight.png, results.json.")
        screen.print("Look around with:")
        if activate := _activation():
            screen.print(f"  {activate}", soft_wrap=True)
        screen.print(f"  nrfgs view {results[NRF]['train']['config_path']}", soft_wrap=True)

    def scene(self) -> SceneConfig:
        """The scene's configuration: many views, close together, as small highlights need."""
        normal = dict(views=200, width=96, height=72, points=2000)
        sizes = dict(views=60, width=64, height=48, points=1000) if self.quick else normal
        return SceneConfig(gloss=self.gloss, studio=True, arc=120.0, test_every=20, seed=self.seed, **sizes)

    def train_args(self, method: str, data: Path, steps: int) -> list[str]:
        """The options of `ns-train`.

        Splats start on the true surfaces, and none come or go: what differs is appearance. Schedules, made for 30,000
        steps, are stretched to `steps`.
        """
        options = {
            "--data": data,
            "--output-dir": self.out / "outputs",
            "--max-num-iterations": steps,
            "--schedule-steps": 30_000,
            "--average-steps": steps // 10,
            "--machine.seed": self.seed,
            "--vis": "tensorboard",
            "--steps-per-eval-image": 10 * steps,
            "--steps-per-eval-all-images": 10 * steps,
            "--pipeline.model.densification": "splatfacto,stop_split_at=0",
            "--pipeline.model.dense-start": "off",  # the scene's points are exact
            "--pipeline.model.num-downscales": 0,
            **RATES[method],
        }
        return [method, *(str(word) for option in options.items() for word in option)]


def verdict(results: dict[str, dict[str, Any]], steps: int) -> str:
    """What the test views say, in a sentence: of NRF against SH, or else against NRF's base colour alone.

    A difference is clear if its mean over the test views, in dB where the scene shines, is at least SMALLEST_GAIN and
    twice its standard error.
    """
    if steps < ENOUGH_STEPS:
        return f"Too short for a verdict: {steps} steps of at least {ENOUGH_STEPS}."
    shine, other, rest = results[NRF]["shine"], "its base colour alone", ""
    against = shine["views_base"]
    if SH in results:
        other, against = "SH", results[SH]["shine"]["views"]
        whole, ssim = (results[NRF]["eval"][key] - results[SH]["eval"][key] for key in ("psnr", "ssim"))
        rest = f"; over whole pictures {whole:+.2f} dB, in SSIM {ssim:+.4f}"
    gains = [a - b for a, b in zip(shine["views"], against, strict=True) if a is not None and b is not None]
    if len(gains) < 2:
        return f"Nothing shines, so NRF and {other} cannot be told apart."
    mean, error = fmean(gains), stdev(gains) / math.sqrt(len(gains))
    ahead = sum(gain > 0 for gain in gains)
    where = f"{mean:+.2f} dB where it shines (ahead in {ahead} of {len(gains)} test views){rest}."
    if abs(mean) < max(SMALLEST_GAIN, 2 * error):
        return f"No clear difference between NRF and {other}: {where}"
    return f"NRF is {'ahead of' if mean > 0 else 'behind'} {other}: {where}"


def _activation() -> str | None:
    """The command that puts `nrfgs` on the path; None if it is there."""
    script = Path(sys.prefix) / "bin" / "activate"
    if not script.is_file() or Path(shutil.which("nrfgs") or "").parent == script.parent:
        return None
    with contextlib.suppress(ValueError):
        script = script.relative_to(Path.cwd())
    return f". {script}"


@contextlib.contextmanager
def _bar(progress: Progress, description: str, total: int):
    """A progress bar that is full when the block ends; yields what advances it."""
    task = progress.add_task(description, total=total)
    yield lambda: progress.advance(task)
    progress.update(task, completed=total)


def comparison(results: dict[str, dict[str, Any]], steps: int) -> Table:
    """The table at the end, one column for each method."""
    columns = (Column(METHODS[method], justify="right") for method in results)
    table = Table("", *columns, title=f"Test views after {steps} steps each")

    def row(name: str, part: str, key: str, form: str, unit: float = 1.0) -> None:
        values = [results[method][part].get(key) for method in results]
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
