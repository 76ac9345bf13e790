# SPDX-License-Identifier: Apache-2.0
"""`nrfgs eval`: what `ns-eval` reports, also for a training from somebody else."""

import json
from dataclasses import dataclass
from pathlib import Path

from nrfgs_ns.files import check_writable, write_whole
from nrfgs_ns.trained.find import NamesTraining


@dataclass
class Eval(NamesTraining):
    """Evaluate a trained model on its test views. Its config.yml is read as options only and runs no code."""

    output_path: Path = Path("output.json")
    """the file for the numbers, as ns-eval writes it"""
    render_output_path: Path | None = None
    """folder for the pictures, truth and rendering side by side"""

    def main(self) -> None:
        path = self.config()
        check_writable(self.output_path, "--output-path")
        if self.render_output_path is not None:
            check_writable(self.render_output_path / "eval.png", "--render-output-path")
        from nerfstudio.utils.rich_utils import CONSOLE

        from nrfgs_ns.threads import few_threads
        from nrfgs_ns.trained.loading import load_training

        with few_threads() as threads:
            trained = load_training(path, "test")
            threads.suit_to(trained.pipeline)
            results = trained.pipeline.get_average_eval_image_metrics(output_path=self.render_output_path, get_std=True)
        config = trained.config
        names = {"experiment_name": config.experiment_name, "method_name": config.method_name}
        numbers = {**names, "checkpoint": str(trained.checkpoint), "results": results}
        write_whole(self.output_path, json.dumps(numbers, indent=2) + "\n")
        CONSOLE.print(f"Saved results to: {self.output_path}", markup=False, soft_wrap=True)
