# SPDX-License-Identifier: Apache-2.0
"""`nrfgs inspect`: see `ablate.py` for what is measured."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from nrfgs_ns.errors import InputError


@dataclass
class Inspect:
    """Find out what each part of a trained field is worth, and what it costs."""

    load_config: Path
    """config.yml of the training"""
    output: Path | None = None
    """folder for inspect.json and inspect.png; None: the folder "inspect" beside the config"""
    views: int = 12
    """test views to measure on, evenly spaced"""
    budget: float = 0.05
    """dB that the parts may cost together that are left out at once"""

    def main(self) -> None:
        # Heavy imports only when there is work to do: `nrfgs --help` answers at once.
        import torch
        from nerfstudio.utils.rich_utils import CONSOLE
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        from nrfgs_ns.appearance.nrf import NeuralResidualField
        from nrfgs_ns.appearance.reduce import latent_basis
        from nrfgs_ns.data.views import evenly_spaced
        from nrfgs_ns.export.loading import load_model
        from nrfgs_ns.files import check_writable, write_whole
        from nrfgs_ns.inspect.ablate import changes, row, together
        from nrfgs_ns.inspect.report import advice, draw, table
        from nrfgs_ns.simplify.field_views import FieldViews, fastest
        from nrfgs_ns.simplify.residuals import look_over
        from nrfgs_ns.training.run import machine

        if self.views < 1:
            raise InputError(f"--views is {self.views}; it must be at least 1.")
        if not self.budget >= 0:
            raise InputError(f"--budget is {self.budget}; it must be zero or positive.")
        pipeline = load_model(self.load_config, "test")
        model = pipeline.model
        if not isinstance(model.head, NeuralResidualField):
            raise InputError(
                f"--load-config {self.load_config}: the {model.head.name!r} head has no parts to tell apart. Name a "
                "training of nrfgs."
            )
        images = pipeline.datamanager.fixed_indices_eval_dataloader
        images = [images[i] for i in evenly_spaced(len(images), self.views)]
        if not images:
            raise InputError(f"--load-config {self.load_config}: its data set has no test views to measure on.")
        folder = self.output if self.output is not None else self.load_config.parent / "inspect"
        check_writable(folder / "inspect.json", "--output")
        with (
            torch.no_grad(),
            CONSOLE.status(f"Looking at the splats from {len(pipeline.datamanager.train_dataset)} training views"),
        ):
            seen = look_over(model, pipeline.datamanager.train_dataset.cameras)
        field = model.field.detached()
        basis = latent_basis(field, seen.weight)
        views = FieldViews(model, images)
        rows = [row("nothing", "full", field, views, None)]
        columns = TextColumn("{task.description:<32}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
        with Progress(*columns, console=CONSOLE, transient=True) as progress:
            to_do = list(changes(field, seen, basis))
            task = progress.add_task("", total=len(to_do))
            for name, group, extra, change in to_do:
                progress.update(task, description=name)
                rows.append(row(name, group, change(field), views, rows[0].psnr, **extra))
                progress.advance(task)

            def trial(what: str) -> None:
                progress.update(task, description=f"together: {what}")

            all_together, left_out = together(field, rows, seen, views, self.budget, trial)
        result = {
            "machine": machine(),
            "splats": model.num_points,
            "views": len(images),
            "budget_db": self.budget,
            "image_seconds": sum(fastest(lambda c=c: model.get_outputs_for_camera(c)) for c, _ in images) / len(images),
            "latent_variances": basis.variances.tolist(),
            "rows": [asdict(one) for one in rows],
            "together": {**asdict(all_together), "left_out": left_out},
        }
        result["advice"] = advice(result["rows"], result["together"], left_out, self.budget)
        CONSOLE.print(table(result))
        share = 100 * rows[0].head_seconds / result["image_seconds"]
        CONSOLE.print(
            f"The head takes {share:.0f} % of the {1e3 * result['image_seconds']:.0f} ms of an image on this machine "
            f"({result['machine']['device']}). {result['advice']}",
            markup=False,
            soft_wrap=True,
        )
        for threshold_row in result["rows"]:
            if threshold_row["threshold"] == float("inf"):
                threshold_row["threshold"] = None  # JSON has no infinity
        write_whole(folder / "inspect.json", json.dumps(result, indent=1) + "\n")
        draw({**result, "rows": [asdict(one) for one in rows]}, folder / "inspect.png")
        CONSOLE.print(f"Figure: {folder / 'inspect.png'}. Numbers: {folder / 'inspect.json'}.", soft_wrap=True)
