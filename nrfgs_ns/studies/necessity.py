# SPDX-License-Identifier: Apache-2.0
"""What a scene needs, over the procedural scenes' gloss dial.

    python -m nrfgs_ns.studies.necessity --out FOLDER

For each gloss and seed: a training of the full model, the first of which `nrfgs inspect` looks into and `nrfgs export
compact` writes; one without any residual; some in which splats become diffuse; and one in which capacity is "auto".
What is there already is not done again. The summary goes to FOLDER/necessity.json and FOLDER/necessity.md.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
import tyro

from nrfgs_ns.appearance.diffuse import DIFFUSE
from nrfgs_ns.appearance.reduce import Field
from nrfgs_ns.capacity.report import read_report
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
    budgets: tuple[float, ...] = (0.05, 0.1)
    """dB that a look may cost, where it chooses the threshold"""
    views: int = 96
    """of each scene, an eighth of them for tests. Few views leave nothing to learn of how looks change between them"""
    width: int = 48
    """of the photographs, pixels; three quarters of it high"""
    samples: int = 4
    """rays per pixel side of the photographs. With few, textures alias, from each view in another way"""
    points: int = 1000
    """that a training starts from. It adds none: so short a training would only split. With more of them than about one
    for each pixel of a view, splats are smaller than pixels, where no rasteriser draws them as the scene is"""
    steps: int = 1200
    """of each training; splats become diffuse after half of them and are looked at once more after three quarters, when
    capacity is decided"""
    rasterize_mode: Literal["classic", "antialiased"] = "antialiased"
    """classic blurs each splat by 0.3 pixels without dimming it, so that small ones look the brighter the farther away
    they are, whatever the gloss"""
    residual_cost: float = 0.05
    """of the trainings with looks or capacity auto: weight of the residuals' length in the loss"""
    average_steps: int = 50
    """last steps of every training, whose mean is its model: so that what auto installs, a mean too, has no lead"""
    inspect: bool = True
    """look into the full model and write it as a compact file, too"""
    seeds: tuple[int, ...] = (42, 43)
    """of the trainings; the first one's full model is looked into"""

    def main(self) -> None:
        for gloss in self.gloss:
            data = self.scene(gloss)
            for seed in self.seeds:
                full = self.trained(gloss, seed, "full", data, {})
                if self.inspect and seed == self.seeds[0]:
                    self.look_into(gloss, Path(full["config"]))
                for name, options in self.variants().items():
                    self.trained(gloss, seed, name, data, options)
        keys = (
            "views",
            "width",
            "samples",
            "points",
            "steps",
            "rasterize_mode",
            "residual_cost",
            "average_steps",
            "seeds",
        )
        summary = {**{key: getattr(self, key) for key in keys}, "machine": machine(), "scenes": list(self.summary())}
        write_whole(self.out / "necessity.json", json.dumps(summary, indent=1) + "\n")
        write_whole(self.out / "necessity.md", table(summary))

    def scene(self, gloss: float) -> Path:
        """Folder of the photographs, drawn if they are not there."""
        size = {"width": self.width, "height": self.width * 3 // 4, "samples": self.samples}
        return write_scene(
            SceneConfig(gloss=gloss, views=self.views, points=self.points, **size), self.out / f"scene-{gloss:g}"
        )

    def look_into(self, gloss: float, config: Path) -> None:
        """What the trained full model could do without, and its compact file."""
        if not (self.out / f"{gloss:g}-inspect" / "inspect.json").exists():
            Inspect(config, self.out / f"{gloss:g}-inspect").main()
        report = self.out / f"{gloss:g}-compact.json"
        if not report.exists():
            export_compact(config, self.out / f"{gloss:g}.nrf", CompactOptions(), True, report)

    def variants(self) -> dict[str, dict[str, Any]]:
        """Names and options of the trainings that leave something out."""
        option = "--pipeline.model.diffuse"
        schedule = {
            f"{option}.start": self.steps // 2,
            f"{option}.every": self.steps // 4,
            f"{option}.stop": self.steps * 3 // 4,
        }
        below = {f"below-{threshold:g}": {f"{option}.threshold": threshold} for threshold in self.thresholds}
        budgets = {f"budget-{budget:g}": {f"{option}.budget": budget} for budget in self.budgets}
        scale = "--pipeline.model.appearance"
        none = {f"{scale}.color-scale": 0.0, f"{scale}.opacity-scale": 0.0}
        auto = {"--pipeline.model.capacity": "auto", "--pipeline.model.capacity-search.step": self.steps * 3 // 4}
        cost = {"--pipeline.model.residual-cost": self.residual_cost}
        looks = {name: {**schedule, **cost, **how} for name, how in {**below, **budgets}.items()}
        return {"none": none, **looks, "auto": {**cost, **auto}}

    def trained(self, gloss: float, seed: int, variant: str, data: Path, options: dict[str, Any]) -> dict[str, Any]:
        """Train and evaluate one model, or read what it gave."""
        name = f"{gloss:g}-{seed}-{variant}"
        path = self.out / f"{name}.json"
        if path.exists():
            return json.loads(path.read_text())
        chosen = {
            "--data": data,
            "--output-dir": self.out / "outputs",
            "--experiment-name": name,
            "--max-num-iterations": self.steps,
            "--average-steps": self.average_steps,
            "--machine.seed": seed,
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
        field = Field(model.head, {name: value.detach() for name, value in model._splats_to_draw().items()})
        result = {
            "config": str(config),
            "seconds": record.seconds,
            "splats": results["splats"],
            "psnr": results["psnr"],
            "ssim": results["ssim"],
            "diffuse": 0.0 if diffuse is None else float(diffuse.float().mean()),
            "bytes": field.bytes,
        }
        report = read_report(config.parent)
        for key in ("dropped", "head", "trials", "looks"):
            if key in report:
                result[key] = report[key]
        write_whole(path, json.dumps(result, indent=1) + "\n")
        return result

    def summary(self) -> Iterator[dict[str, Any]]:
        """What was measured of each scene, without paths: the trainings that are there, by name and seed."""
        for gloss in self.gloss:
            runs: dict[str, dict[int, dict[str, Any]]] = {}
            for name in ("full", *self.variants()):
                paths = {seed: self.out / f"{gloss:g}-{seed}-{name}.json" for seed in self.seeds}
                runs[name] = {seed: json.loads(path.read_text()) for seed, path in paths.items() if path.exists()}
                for run in runs[name].values():
                    run.pop("config")
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
    """Markdown: a row for each training."""
    lines = ["| gloss | seed | training | PSNR (dB) | against full | diffuse splats | bytes | dropped |"]
    lines += ["|---|---|---|---|---|---|---|---|"]
    names = {"full": "full", "none": "no residual at all", "auto": "capacity auto"}
    for scene in summary["scenes"]:
        for name, runs in scene["runs"].items():
            kind, _, number = name.partition("-")
            what = {"below": f"diffuse below {number} steps", "budget": f"diffuse, what {number} dB allow"}.get(kind)
            for seed, run in runs.items():
                full = scene["runs"]["full"][seed]
                lines.append(
                    f"| {scene['gloss']:g} | {seed} | {what or names[kind]} | {run['psnr']:.2f} "
                    f"| {run['psnr'] - full['psnr']:+.2f} | {100 * run['diffuse']:.0f} % "
                    f"| {100 * (run['bytes'] / full['bytes'] - 1):+.0f} % "
                    f"| {', '.join(run.get('dropped', [])) or '-'} |"
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
