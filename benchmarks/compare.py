# SPDX-License-Identifier: Apache-2.0
"""Train and evaluate methods on scenes, several seeds each, and print one table.

    python benchmarks/compare.py --scenes SCENES/fox --methods nrfgs-sh nrfgs --steps 1000 --out docs/results/fox

Each run is a process of its own (`python -m nrfgs_ns.studies.run`) that leaves OUT/runs/METHOD-SCENE-SEED.json; a run
whose file is there is not repeated. Several runs may share a GPU where wall-clock is not what is measured: with
--jobs 1 the seconds can be compared, otherwise they are left out of the table. A run that failed is listed as missing.
A method may carry options: "nrfgs:zero=--pipeline.model.appearance.output-init zero" is reported as "nrfgs:zero".
"""

import json
import os
import shlex
import statistics
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn


@dataclass
class Compare:
    """Which runs, and where their results go."""

    scenes: tuple[Path, ...]
    """folders of data sets in nerfstudio's layout"""
    out: Path
    """folder for runs/*.json, table.md and summary.json"""
    methods: tuple[str, ...] = ("nrfgs-sh", "nrfgs")
    """methods, each NAME or NAME:LABEL=OPTIONS"""
    seeds: tuple[int, ...] = (42,)
    """--machine.seed of each repetition"""
    steps: int = 30_000
    """training steps"""
    res_scale: float = 1.0
    """scale of the images (--pipeline.datamanager.camera-res-scale-factor)"""
    jobs: int = 1
    """runs at once on each GPU, or on the CPU"""
    gpus: int = 1
    """GPUs to spread the runs over; ignored on a machine without"""
    work: Path = Path("outputs/compare")
    """folder for checkpoints and logs"""
    options: str = ""
    """further options of ns-train for every run"""
    report_only: bool = False
    """run nothing: make the table from the runs that are there"""
    pending: list[tuple[str, list[str], Path]] = field(init=False, default_factory=list)

    def command(self, method: str, scene: Path, seed: int, record: Path) -> list[str]:
        """The child's command line."""
        name, _, options = method.partition("=")
        return [
            *(sys.executable, "-m", "nrfgs_ns.studies.run", str(record), name.partition(":")[0]),
            *("--output-dir", str(self.work / record.stem), "--experiment-name", scene.name),
            *("--max-num-iterations", str(self.steps), "--steps-per-save", str(self.steps)),
            *("--machine.seed", str(seed)),
            *("--pipeline.datamanager.camera-res-scale-factor", str(self.res_scale)),
            *QUIET,
            *shlex.split(self.options),
            *shlex.split(options),
            *("nrfgs-data", "--data", str(scene)),
        ]

    def main(self) -> None:
        runs = self.out / "runs"
        runs.mkdir(parents=True, exist_ok=True)
        self.work.mkdir(parents=True, exist_ok=True)
        for seed in self.seeds:
            for scene in self.scenes:
                for method in self.methods:
                    label = method.partition("=")[0]
                    record = runs / f"{label.replace(':', '_')}-{scene.name}-{seed}.json"
                    if not record.exists() and not self.report_only:
                        self.pending.append((record.stem, self.command(method, scene, seed, record), record))
        self.run_all()
        self.report(runs)

    def run_all(self) -> None:
        """Run what is pending, `jobs` at once on each GPU."""
        slots = [gpu for _ in range(self.jobs) for gpu in range(self.gpus)]
        running: dict[int, tuple[str, subprocess.Popen]] = {}
        columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
        with Progress(*columns, console=Console(stderr=True)) as progress:
            task = progress.add_task("runs", total=len(self.pending))
            while self.pending or running:
                for slot, gpu in enumerate(slots):
                    if slot not in running and self.pending:
                        name, command, _ = self.pending.pop(0)
                        log = (self.work / f"{name}.log").open("w")
                        environment = {**os.environ, "CUDA_VISIBLE_DEVICES": str(gpu)}
                        process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=environment)
                        running[slot] = (name, process)
                    elif slot in running and running[slot][1].poll() is not None:
                        name, process = running.pop(slot)
                        progress.console.print(f"{name}: {'done' if process.returncode == 0 else 'FAILED'}")
                        progress.advance(task)
                time.sleep(0.2)

    def report(self, runs: Path) -> None:
        """Write and print the table: mean and sample deviation over seeds."""
        summary = []
        for scene in self.scenes:
            for method in self.methods:
                label = method.partition("=")[0]
                files = [runs / f"{label.replace(':', '_')}-{scene.name}-{seed}.json" for seed in self.seeds]
                records = [json.loads(file.read_text()) for file in files if file.exists()]
                row: dict[str, object] = {"scene": scene.name, "method": label, "seeds": len(records)}
                row["missing"] = len(files) - len(records)
                for column, value_of in COLUMNS.items():
                    values = [value_of(record) for record in records]
                    values = [value for value in values if value is not None]
                    if values:
                        deviation = statistics.stdev(values) if len(values) > 1 else None
                        row[column] = [statistics.fmean(values), deviation]
                row["machine"] = records[0]["machine"] if records else None
                summary.append(row)
        (self.out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
        table = markdown(summary, with_seconds=self.jobs == 1)
        (self.out / "table.md").write_text(table)
        print(table)


COLUMNS = {
    "PSNR": lambda run: run["eval"]["psnr"],
    "SSIM": lambda run: run["eval"]["ssim"],
    "MS-SSIM": lambda run: run["eval"].get("ms_ssim"),
    "L1": lambda run: run["eval"].get("l1"),
    "splats": lambda run: run["train"]["splats"][-1][1],
    "MB": lambda run: run["eval"].get("parameter_bytes"),
    "train s": lambda run: run["train"]["seconds"],
    "peak MB": lambda run: run["train"]["peak_memory_bytes"],
}
"""Column -> its value in a run's record; None where the method does not report it."""

FORMATS = {"PSNR": "{:.2f}", "SSIM": "{:.4f}", "MS-SSIM": "{:.4f}", "L1": "{:.4f}", "splats": "{:,.0f}"}
UNITS = {"MB": 1e6, "peak MB": 1e6}


def markdown(summary: list[dict], with_seconds: bool) -> str:
    """The table, one row for each scene and method."""
    columns = [column for column in COLUMNS if with_seconds or column != "train s"]
    lines = ["| scene | method | seeds | " + " | ".join(columns) + " |", "|" + "---|" * (len(columns) + 3)]
    for row in summary:
        cells = []
        for column in columns:
            mean, deviation = row.get(column, [None, None])
            if mean is None:
                cells.append("-")
                continue
            form, unit = FORMATS.get(column, "{:.1f}"), UNITS.get(column, 1.0)
            spread = f" ± {form.format(deviation / unit)}" if deviation is not None else ""
            cells.append(form.format(mean / unit) + spread)
        seeds = f"{row['seeds']}" + (f" ({row['missing']} missing)" if row["missing"] else "")
        lines.append(f"| {row['scene']} | {row['method']} | {seeds} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


QUIET = (
    "--vis tensorboard --steps-per-eval-image 1000000 --steps-per-eval-all-images 1000000 "
    "--logging.local-writer.enable False --logging.profiler none"
).split()
"""Options that keep evaluation, the viewer and the terminal table out of the timing."""


if __name__ == "__main__":
    tyro.cli(Compare).main()
