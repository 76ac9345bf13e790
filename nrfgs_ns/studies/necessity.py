# SPDX-License-Identifier: Apache-2.0
"""What a scene needs, over the procedural scenes' gloss dial.

    python -m nrfgs_ns.studies.necessity --out FOLDER

For each gloss: one training of the full model, which `nrfgs inspect` looks into and `nrfgs export compact` writes;
trainings in which splats become diffuse, at several thresholds; and one in which capacity is "auto". What is there
already is not done again. The summary
goes to FOLDER/necessity.json and FOLDER/necessity.md.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
import tyro

from nrfgs_ns.appearance.diffuse import DIFFUSE
from nrfgs_ns.capacity.schedule import REPORT
from nrfgs_ns.compact.options import CompactOptions
from nrfgs_ns.compact.verb import export_compact
from nrfgs_ns.export import load_model
from nrfgs_ns.scenes import SceneConfig, write_scene
from nrfgs_ns.studies.files import write_whole
from nrfgs_ns.studies.inspect.verb import Inspect
from nrfgs_ns.studies.run import evaluate, machine, train


@dataclass
class Necessity:
    """Train the full model and models with diffuse splats over the gloss dial, and write what they need."""

    out: Path
    """folder for everything"""
    gloss: tuple[float, ...] = (0.0, 0.5, 1.0)
    """gloss of the scenes"""
    thresholds: tuple[float, ...] = ()
    """8-bit steps below which a splat's residual is dropped"""
    budgets: tuple[float, ...] = (0.05,)
    """dB that a look may cost, where it chooses the threshold"""
    views: int = 96
    """of each scene, an eighth of them for tests. Few views leave nothing to learn of how looks change between them"""
    width: int = 48
    """of the photographs, pixels; three quarters of it high"""
    points: int = 4000
    """that a training starts from. It adds none: so short a training would only split"""
    steps: int = 800
    """of each training; splats become diffuse, and capacity is decided, after half of them"""
    rasterize_mode: Literal["classic", "antialiased"] = "antialiased"
    """classic blurs each splat by 0.3 pixels without dimming it, so that small ones look the brighter the farther away
    they are, whatever the gloss"""
    inspect: bool = True
    """look into the full model and write it as a compact file, too"""
    seed: int = 42
    """of the trainings"""

    def main(self) -> None:
        for gloss in self.gloss:
            height = self.width * 3 // 4
            scene = SceneConfig(gloss=gloss, views=self.views, width=self.width, height=height, points=self.points)
            data = write_scene(scene, self.out / f"scene-{gloss:g}")
            full = self.trained(f"{gloss:g}-full", data, {})
            config = Path(full["config"])
            if self.inspect and not (self.out / f"{gloss:g}-inspect" / "inspect.json").exists():
                Inspect(config, self.out / f"{gloss:g}-inspect").main()
            if self.inspect and not (self.out / f"{gloss:g}-compact.json").exists():
                report = self.out / f"{gloss:g}-compact.json"
                export_compact(config, self.out / f"{gloss:g}.nrf", CompactOptions(), True, report)
            for name, options in self.variants().items():
                self.trained(f"{gloss:g}-{name}", data, options)
        summary = {
            **{key: getattr(self, key) for key in ("views", "width", "points", "steps", "rasterize_mode", "seed")},
            "machine": machine(),
            "scenes": list(self.summary()),
        }
        write_whole(self.out / "necessity.json", json.dumps(summary, indent=1) + "\n")
        write_whole(self.out / "necessity.md", table(summary))

    def variants(self) -> dict[str, dict[str, Any]]:
        """Names and options of the trainings that leave something out."""
        option = "--pipeline.model.diffuse"
        schedule = {f"{option}.start": self.steps // 2, f"{option}.every": self.steps, f"{option}.stop": self.steps}
        below = {f"below-{threshold:g}": {f"{option}.threshold": threshold} for threshold in self.thresholds}
        budgets = {f"budget-{budget:g}": {f"{option}.budget": budget} for budget in self.budgets}
        auto = {"--pipeline.model.capacity": "auto", "--pipeline.model.capacity-search.step": self.steps // 2}
        return {**{name: {**schedule, **how} for name, how in {**below, **budgets}.items()}, "auto": auto}

    def trained(self, name: str, data: Path, options: dict[str, Any]) -> dict[str, Any]:
        """Train and evaluate one model, or read what it gave."""
        path = self.out / f"{name}.json"
        if path.exists():
            return json.loads(path.read_text())
        chosen = {
            "--data": data,
            "--output-dir": self.out / "outputs",
            "--experiment-name": name,
            "--max-num-iterations": self.steps,
            "--machine.seed": self.seed,
            "--vis": "tensorboard",
            "--steps-per-eval-image": 10 * self.steps,
            "--steps-per-eval-all-images": 10 * self.steps,
            "--logging.profiler": "none",
            "--logging.local-writer.enable": False,
            "--pipeline.model.rasterize-mode": self.rasterize_mode,
            "--pipeline.model.num-downscales": 0,
            "--pipeline.model.warmup-length": 10 * self.steps,
            **options,
        }
        record = train(["nrfgs", *(str(word) for option in chosen.items() for word in option)])
        config = Path(record.config_path)
        results = evaluate(config, config.parent / "eval.json")
        model = load_model(config, "test").model
        diffuse = model.densification.state.get(DIFFUSE)
        result = {
            "config": str(config),
            "seconds": record.seconds,
            "splats": results["splats"],
            "psnr": results["psnr"],
            "ssim": results["ssim"],
            "diffuse": 0.0 if diffuse is None else float(diffuse.float().mean()),
            "bytes": results["parameter_bytes"],
        }
        if model.capacity_found is not None:
            report = json.loads((config.parent / REPORT).read_text())
            result["capacity"] = {key: report[key] for key in ("dropped", "head", "trials", "seconds")}
        write_whole(path, json.dumps(result, indent=1) + "\n")
        return result

    def summary(self) -> Iterator[dict[str, Any]]:
        """What was measured of each scene, without paths."""
        for gloss in self.gloss:
            runs = {}
            for name in ("full", *self.variants()):
                runs[name] = json.loads((self.out / f"{gloss:g}-{name}.json").read_text())
                runs[name].pop("config")
            yield {"gloss": gloss, "runs": runs, **(self.looked_into(gloss) if self.inspect else {})}

    def looked_into(self, gloss: float) -> dict[str, Any]:
        """What `nrfgs inspect` and `nrfgs export compact` say of the full model."""
        inspected = json.loads((self.out / f"{gloss:g}-inspect" / "inspect.json").read_text())
        compact = json.loads((self.out / f"{gloss:g}-compact.json").read_text())
        parts = {row["part"]: row for row in inspected["rows"]}
        return {
            "together": inspected["together"],
            "losses": {part: row["loss_db"] for part, row in parts.items()},
            "shares": {part: row["diffuse"] for part, row in parts.items() if row["group"] == "residual"},
            "bytes": parts["nothing"]["bytes"],
            "head_seconds": parts["nothing"]["head_seconds"],
            "compact": {key: value for key, value in compact.items() if key != "per_image"},
        }


def table(summary: dict[str, Any]) -> str:
    """Markdown."""
    lines = ["| gloss | splats become diffuse below | PSNR (dB) | against full | diffuse | splats | training (s) |"]
    lines.append("|---|---|---|---|---|---|---|")
    for scene in summary["scenes"]:
        full = scene["runs"]["full"]["psnr"]
        for name, run in scene["runs"].items():
            kind, _, number = name.partition("-")
            if kind == "auto":
                continue
            what = {"full": "(full)", "below": f"{number} steps", "budget": f"what {number} dB allow"}[kind]
            lines.append(
                f"| {scene['gloss']:g} | {what} | {run['psnr']:.2f} | {run['psnr'] - full:+.2f} | "
                f"{100 * run['diffuse']:.0f} % | {run['splats']:,} | {run['seconds']:.0f} |"
            )
    lines += [
        "",
        "| gloss | PSNR (dB), full | auto | dropped | bytes | worth on the views set aside (dB) |",
        "|---|---|---|---|---|---|",
    ]
    for scene in summary["scenes"]:
        full, auto = scene["runs"]["full"], scene["runs"]["auto"]
        found = auto["capacity"]
        worth = ", ".join(f"{trial['part']} {trial['loss_db']:.3f}" for trial in found["trials"][1:])
        lines.append(
            f"| {scene['gloss']:g} | {full['psnr']:.2f} | {auto['psnr']:.2f} "
            f"| {', '.join(found['dropped']) or 'nothing'} | {100 * (auto['bytes'] / full['bytes'] - 1):+.0f} % "
            f"| {worth} |"
        )
    if "together" not in summary["scenes"][0]:
        return "\n".join(lines) + "\n"
    lines += [
        "",
        "| gloss | all residuals (dB) | left out of the full model within 0.05 dB | loss (dB) | bytes | head |",
    ]
    lines.append("|---|---|---|---|---|---|")
    for scene in summary["scenes"]:
        one, residuals = scene["together"], scene["losses"]["all residuals"]
        lines.append(
            f"| {scene['gloss']:g} | {residuals:.2f} | {', '.join(one['left_out']) or 'nothing'} "
            f"| {one['loss_db']:.3f} | {100 * (one['bytes'] / scene['bytes'] - 1):+.0f} % "
            f"| {100 * (one['head_seconds'] / scene['head_seconds'] - 1):+.0f} % |"
        )
    lines += [
        "",
        "| gloss | compact file | bytes a splat | times smaller than PLY | loss (dB) |",
        "|---|---|---|---|---|",
    ]
    for scene in summary["scenes"]:
        one = scene["compact"]
        lines.append(
            f"| {scene['gloss']:g} | {one['bytes'] / 1e3:.0f} kB | {one['bytes'] / one['written']:.1f} "
            f"| {one['ply_ratio']:.1f} | {one['loss_db']:.3f} |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    torch.set_num_threads(1)
    tyro.cli(Necessity).main()
