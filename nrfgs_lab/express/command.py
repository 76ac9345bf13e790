# SPDX-License-Identifier: Apache-2.0
"""`nrfgs express`: runs the plan, one record for each cell, and makes table and figures from the records."""

import json
import math
import os
import platform
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from nrfgs_ns.errors import InputError
from nrfgs_ns.files import write_whole

SETUPS = ("synthetic", "pixels", "image")
MIN_SAMPLES = 120
"""Fewer samples cannot carry the shared weights of every model within the budget."""


@dataclass
class Express:
    """Fit colours over directions with harmonics, the field and others, at one budget, and compare them.

    Interrupted runs go on where they stopped: each finished fit is a record in OUT/runs, and is not repeated.
    """

    out: Path = Path("express")
    """folder for runs/*.json, summary.json, table.md and pictures"""
    setups: tuple[str, ...] = SETUPS
    """synthetic: random harmonics of degree 5. pixels: measured reflectance, unrelated samples. image: a picture of it.
    The measured ones need --reflectance or --btf, and are skipped without"""
    reflectance: Path | None = None
    """folder with nbrdf_weights.npz: measured BRDFs as small networks"""
    btf: Path | None = None
    """folder of one UBO2003 material's photographs, instead of --reflectance"""
    btf_light: tuple[int, int] = (30, 0)
    """the light under which the photographs are taken: angle from the normal, azimuth, degrees"""
    seeds: tuple[int, ...] = (0, 1, 2)
    """seeds of targets and starts"""
    image_seeds: tuple[int, ...] = (0,)
    """the same for the image, which takes longest"""
    samples: int = 328
    """samples in the synthetic set-up and of pixels"""
    side: int = 400
    """pixels along the image's edge"""
    passes: int = 500
    """how often a sample is seen"""
    image_passes: int = 12
    """the same for the image; so few leave every model short of its optimum, but each pass takes seconds"""
    device: Literal["cpu", "cuda"] = "cpu"
    """where to fit"""
    quick: bool = False
    """few samples and passes: seconds, to see that everything works"""

    def main(self) -> None:
        # Heavy imports only when there is work to do: `nrfgs --help` answers at once.
        from nrfgs_lab.express import figures, plan, report

        if self.quick:
            self.samples, self.side, self.passes = min(self.samples, 128), min(self.side, 16), min(self.passes, 4)
            self.image_passes = 1
            self.seeds, self.image_seeds = self.seeds[:1], self.image_seeds[:1]
        screen = Console()
        setups = self.checked_setups(screen)
        source = TargetSource(self)
        columns = TextColumn("{task.description:<44}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
        with Progress(*columns, console=screen) as progress:
            for setup in setups:
                num_samples = self.num_samples(setup, source)
                for label, spec in plan.models(num_samples).items():
                    count = spec.build().count(num_samples)
                    progress.console.print(f"[dim]{setup}: {label:<12} {count:>10,} parameters", highlight=False)
                self.run_setup(setup, source, progress)
        records = sorted((self.out / "runs").glob("*.json"))
        summary = report.summarise([{"name": path.stem, **json.loads(path.read_text())} for path in records])
        write_whole(self.out / "summary.json", json.dumps(summary, indent=1) + "\n")
        write_whole(self.out / "table.md", report.markdown(summary))
        screen.print(report.table(summary))
        for path in figures.draw(summary, self.out):
            screen.print(f"Picture: {path}")

    def checked_setups(self, screen: Console) -> list[str]:
        """The set-ups that can be run.

        Raises:
            InputError: an unknown set-up, two sources of measured reflectance, a size that is too small, no GPU.
        """
        import torch

        for setup in self.setups:
            if setup not in SETUPS:
                raise InputError(f"--setups has {setup!r}, but knows {', '.join(SETUPS)} only.")
        if self.reflectance is not None and self.btf is not None:
            raise InputError("--reflectance and --btf are both given. Give one: the measured set-ups have one source.")
        for name, least in (
            ("samples", MIN_SAMPLES),
            ("side", math.isqrt(MIN_SAMPLES - 1) + 1),
            ("passes", 1),
            ("image_passes", 1),
        ):
            if getattr(self, name) < least:
                raise InputError(f"--{name.replace('_', '-')} is {getattr(self, name)}, but must be at least {least}.")
        if self.device == "cuda" and not torch.cuda.is_available():
            raise InputError("--device is cuda, but PyTorch finds no CUDA GPU. Leave it out to fit on the CPU.")
        if not self.seeds or not self.image_seeds:
            raise InputError("--seeds and --image-seeds must name at least one seed each.")
        measured = self.reflectance is not None or self.btf is not None
        setups = [setup for setup in self.setups if measured or setup == "synthetic"]
        if len(setups) < len(self.setups):
            screen.print("No measured reflectance is given (--reflectance or --btf): only the synthetic set-up is run.")
        return setups

    def num_samples(self, setup: str, source: "TargetSource") -> int:
        """Samples of a set-up."""
        return source.image_side() ** 2 if setup == "image" else self.samples

    def run_setup(self, setup: str, source: "TargetSource", progress: Progress) -> None:
        """All cells of one set-up: rates first, because the others use the chosen ones."""
        from nrfgs_lab.express import plan
        from nrfgs_lab.express.fit import FitConfig

        image = setup == "image"
        seeds = self.image_seeds if image else self.seeds
        num_samples = self.num_samples(setup, source)
        fit = FitConfig(passes=self.image_passes, block=500) if image else FitConfig(passes=self.passes)
        specs = plan.models(num_samples)
        # Rates are chosen on other data. For the image on a smaller one, with as many steps in a pass, and variations
        # are tried on such a one, too.
        trial, small = fit, {}
        if image:
            specs = {label: spec for label, spec in specs.items() if label in plan.IMAGE_MODELS}
            small = {"side": max(source.image_side() // 4, 2)}
            trial = replace(fit, block=max(fit.block // 16, 1))
        chosen: dict[str, FitConfig] = {}
        for label, spec in specs.items():
            cells = plan.rate_cells(setup, label, spec, trial, small)
            records = [self.run_cell(cell, source, progress) for cell in cells]
            best = max(records, key=lambda record: record["train_psnr"])["settings"]["fit"]
            chosen[label] = replace(fit, sample_lr=best["sample_lr"], shared_lr=best["shared_lr"])
        cells = []
        for seed in seeds:
            cells += plan.reference_cells(setup, seed)
            cells += [plan.main_cell(setup, label, spec, chosen[label], seed) for label, spec in specs.items()]
        varied = replace(chosen["nrf"], block=trial.block)
        for seed in seeds:
            cells += plan.variation_cells(setup, specs["nrf"], varied, seed, small)
            if not image:
                cells += plan.sweep_cells(setup, specs["nrf"], chosen["nrf"], seed)
        for cell in cells:
            # Photographs have the directions and the material that they have.
            if self.btf is None or setup == "synthetic" or not set(cell.targets) - {"side"}:
                self.run_cell(cell, source, progress)

    def run_cell(self, cell: Any, source: "TargetSource", progress: Progress) -> dict[str, Any]:
        """The cell's record: read if it is there with the same settings, else measured and written."""
        from nrfgs_lab.express import figures

        path = self.out / "runs" / f"{cell.name}.json"
        settings = {**cell.settings(), "source": source.describe(cell.setup)}
        settings = json.loads(json.dumps(settings))  # tuples become lists, as in the file
        if path.exists():
            record = json.loads(path.read_text())
            if record.get("settings") == settings:
                return record
        targets = source.make(cell.setup, cell.seed, **cell.targets)
        steps = 1 if cell.fit is None else cell.fit.steps(len(targets))
        task = progress.add_task(cell.name, total=steps)
        record, fitted = measure_cell(cell, targets, lambda: progress.advance(task))
        progress.remove_task(task)
        record = {"settings": settings, **record, "machine": machine(self.device)}
        if fitted is not None:
            figures.keep_panel(cell, targets, fitted, self.out / "panels")
        write_whole(path, json.dumps(record, indent=1) + "\n")
        return record


def measure_cell(cell: Any, targets: Any, on_step: Callable[[], None]) -> tuple[dict[str, Any], Any]:
    """Fit and measure: sizes, PSNRs and seconds; and what was fitted, if anything was."""
    from nrfgs_lab.express.fit import fit, least_squares, linear_bound, measure
    from nrfgs_lab.express.plan import FIELD_NUMBERS

    sizes = {"samples": len(targets), "directions": len(targets.directions)}
    sizes["held_out_directions"] = len(targets.held_out_directions)
    if cell.model is None:
        return {**sizes, "numbers_per_sample": FIELD_NUMBERS, "train_psnr": linear_bound(targets, FIELD_NUMBERS)}, None
    if cell.fit is None:
        fitted = least_squares(targets, cell.model.build().degree)
        on_step()
    else:
        fitted = fit(cell.model.build, targets, cell.fit, cell.seed, on_step)
    sizes |= {"numbers_per_sample": fitted.model.numbers_per_sample(), "shared": fitted.model.num_shared()}
    sizes["parameters"] = fitted.model.count(len(targets))
    return {**sizes, **measure(fitted, targets), "seconds": fitted.seconds}, fitted


class TargetSource:
    """Makes targets; keeps the last ones, since neighbouring cells share them."""

    def __init__(self, study: Express):
        self.study = study
        self.last: tuple[Any, Any] = (None, None)
        self._networks: Any = None
        self._btf: Any = None

    def describe(self, setup: str) -> dict[str, Any]:
        """What the targets are made of, without the path."""
        if setup == "synthetic":
            return {"kind": "random harmonics", "samples": self.study.samples}
        samples = {"side": self.image_side()} if setup == "image" else {"samples": self.study.samples}
        if self.study.btf is not None:
            return {"kind": "photographs", "material": self.study.btf.name, "light": self.study.btf_light, **samples}
        return {"kind": "BRDF networks", "materials": len(self.networks()), **samples}

    def image_side(self) -> int:
        """Edge of the image: smaller than asked for if the photographs are."""
        if self.study.btf is None:
            return self.study.side
        return min(self.study.side, *self.photographs().images.shape[1:3])

    def networks(self) -> Any:
        from nrfgs_lab.express.reflectance import read_networks

        self._networks = self._networks or read_networks(self.study.reflectance)
        return self._networks

    def photographs(self) -> Any:
        from nrfgs_lab.express.reflectance import read_btf

        self._btf = self._btf or read_btf(self.study.btf, self.study.btf_light)
        return self._btf

    def make(self, setup: str, seed: int, **others: Any) -> Any:
        """Targets of a set-up; `others` as in `targets.py`."""
        key = (setup, seed, tuple(sorted(others.items())))
        if self.last[0] != key:
            self.last = (None, None)  # free the old ones before the new ones are made
            self.last = (key, self._make(setup, seed, others).to(self.study.device))
        return self.last[1]

    def _make(self, setup: str, seed: int, others: dict[str, Any]) -> Any:
        from nrfgs_lab.express import targets

        if setup == "synthetic":
            return targets.synthetic(seed, samples=self.study.samples, **others)
        if self.study.btf is not None:
            samples = None if setup == "image" else self.study.samples
            return targets.from_btf(self.photographs(), seed, samples, side=others.get("side", self.image_side()))
        if setup == "image":
            return targets.measured_image(self.networks(), seed, **{"side": self.study.side, **others})
        return targets.measured_pixels(self.networks(), seed, samples=self.study.samples, **others)


def machine(device: str) -> dict[str, str]:
    """What the numbers were taken on."""
    import torch

    name = f"{os.cpu_count()} CPU cores, {torch.get_num_threads()} thread"
    if device == "cuda":
        name = torch.cuda.get_device_name()
    return {"device": name, "python": platform.python_version(), "torch": torch.__version__}
