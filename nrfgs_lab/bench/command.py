# SPDX-License-Identifier: Apache-2.0
"""`nrfgs bench`: methods x strategies x scenes x seeds, one table, one figure, one sheet of crops for each scene.

Each training is a process of its own (`run.py`) that writes OUT/runs/NAME.json at its end. The next call skips finished
runs, resumes interrupted ones and retries failed ones. A record with other arguments stops the benchmark.

Several commands may share a file and a folder, also at once: a report has the trainings that its command chose, and all
others of the file with a record there.
"""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro
from filelock import FileLock

from nrfgs_lab.bench.data import parser_options
from nrfgs_lab.bench.file import as_list, load_spec, make_spec, scene_path
from nrfgs_lab.bench.job import Job, command, differences, identity, read_record
from nrfgs_lab.bench.report import FAILURE, report
from nrfgs_lab.bench.spec import DEFAULT, Cell, Scene, Spec, cells_of, steps_of
from nrfgs_ns.errors import InputError
from nrfgs_ns.files import check_writable, write_whole

CHILD = (sys.executable, "-m", "nrfgs_lab.bench.run")
"""Command of a child; the file that describes its job is appended."""


@dataclass
class Bench:
    """Compare methods over strategies, scenes and seeds: train all, and report. See docs/bench.md."""

    spec: Annotated[Path, tyro.conf.Positional]
    """YAML file with runs or knobs, strategies, scenes, ..., or a name in nrfgs_lab/bench/plans; options override it"""
    plan: str = ""
    """the plan to run, of a file with several"""
    scenes: Path = Path(".")
    """folder in which the data sets lie"""
    out: Path = Path("bench")
    """folder for runs/*.json and the report"""
    work: Path = Path("outputs/bench")
    """folder for checkpoints, pictures and logs"""
    data: tuple[str, ...] = ()
    """only these data sets, of the file or others: folders in --scenes"""
    runs: tuple[str, ...] = ()
    """only these runs or knobs of the file"""
    seeds: tuple[int, ...] = ()
    """only these seeds, of the file or others"""
    steps: int | None = None
    """training steps, except of scenes, runs and presets that have their own"""
    options: str | None = None
    """options of ns-train for every run"""
    jobs: int | None = None
    """runs at once on each GPU, or on the CPU; times are reported only with 1"""
    gpus: int | None = None
    """GPUs to spread the runs over"""
    minutes: float | None = None
    """stop after this time; the next call goes on"""
    report_only: bool = False
    """run nothing: report what is there"""
    redo_stale: bool = False
    """rename records of other arguments to NAME.stale, and run them again"""

    def main(self) -> None:
        plan, chosen = self.chosen()
        check_writable(self.out / "table.md", "--out")
        parsers = None  # Scene -> the data parser and its options. A data set that cannot be read fails now.
        if not self.report_only:
            scenes = dict.fromkeys(cell.scene for cell in chosen)
            parsers = {scene: parser_options(self.scenes, scene, self.work / "scenes") for scene in scenes}
        stale = self.stale(plan, chosen, parsers)
        if stale and not self.report_only:
            if not self.redo_stale:
                name, difference = next(iter(stale.items()))
                raise InputError(
                    f"{len(stale)} of the records in {self.out / 'runs'} were made with other arguments; {name} had "
                    f"{difference}. Give --redo-stale to rename them and run them again, or another --out."
                )
            for name in stale:
                with contextlib.suppress(FileNotFoundError):  # another command has done it
                    os.replace(self.record(name), self.record(name).with_suffix(".stale"))
        jobs = self.jobs_of(plan, chosen, parsers) if parsers else {}
        pending = {name: job for name, job in jobs.items() if not self.record(name).exists()}
        if pending:
            from nerfstudio.configs.method_configs import all_methods  # takes seconds

            from nrfgs_lab.training_run import parse

            for job in pending.values():
                where = f"{self.spec}: runs: {job.cell['run']}"
                if job.args[0] not in all_methods:
                    raise InputError(f"{where}: {job.args[0]!r} is no method of ns-train.")
                try:
                    parse(job.args)
                except SystemExit:  # its reason is on the terminal
                    raise InputError(f"{where}: ns-train refuses the options, as told above. Correct them.") from None
            # A terminated benchmark must not leave its children behind; an exception reaches the `finally` below.
            signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
            self.run_all(pending, plan)
        # Another command may end at this moment: whoever reports last must have read the records of both.
        with FileLock(self.out / ".lock"):
            cells = self.shown(plan, chosen)
            report(plan, cells, self.out, self.work, self.stale(plan, cells, parsers))
        failed = [cell.name for cell in chosen if self.has_failed(cell.name)]
        if failed and not self.report_only:
            sys.exit(f"nrfgs: {len(failed)} of the runs FAILED: {', '.join(failed)}. Logs: {self.work}/NAME.log")

    def chosen(self) -> tuple[Spec, list[Cell]]:
        """The whole benchmark, and the trainings that this command chooses."""
        given = {"steps": self.steps, "options": self.options, "jobs": self.jobs, "gpus": self.gpus}
        content = load_spec(self.spec, self.plan)
        content |= {key: value for key, value in given.items() if value is not None}
        data = [scene_path(name) for name in self.data]
        listed = as_list(content.get("scenes", []))
        content["scenes"] = listed + [name for name in data if name not in map(scene_path, listed)]
        seeds = as_list(content.get("seeds", 42))
        content["seeds"] = seeds + [seed for seed in self.seeds if seed not in seeds]
        plan = make_spec(content, str(self.spec))
        known = {name for run in plan.runs for name in (run.name, run.knob) if name}
        for name in self.runs:
            if name not in known:
                listed = ", ".join(sorted(known))
                raise InputError(f"--runs {name!r}: {self.spec} has no run of that name. It has {listed}.")

        def is_chosen(cell: Cell) -> bool:
            return (
                (not self.runs or cell.run.name in self.runs or cell.run.knob in (*self.runs, DEFAULT))
                and (not data or cell.scene.path in data)
                and (not self.seeds or cell.seed in self.seeds)
            )

        return plan, [cell for cell in cells_of(plan) if is_chosen(cell)]

    def shown(self, plan: Spec, chosen: list[Cell]) -> list[Cell]:
        """The trainings of a report: the chosen ones, and all others of the file with a record or a failure."""
        every = cells_of(plan)
        rows = list(dict.fromkeys((cell.scene, cell.strategy, cell.run) for cell in every))
        others = [cell for cell in every if self.record(cell.name).exists() or self.has_failed(cell.name)]
        return sorted(
            {*chosen, *others}, key=lambda cell: (rows.index((cell.scene, cell.strategy, cell.run)), cell.seed)
        )

    def record(self, name: str) -> Path:
        """The record of a finished run."""
        return self.out / "runs" / f"{name}.json"

    def has_failed(self, name: str) -> bool:
        """Whether a run's last attempt failed."""
        return self.record(name).with_suffix(FAILURE).exists() and not self.record(name).exists()

    def jobs_of(self, plan: Spec, cells: list[Cell], parsers: dict[Scene, list[str]]) -> dict[str, Job]:
        """Name -> job of every training."""
        return {
            cell.name: Job(
                args=command(plan, cell, parsers[cell.scene], self.work / cell.name),
                cell={"run": cell.run.name, "strategy": cell.strategy, "scene": cell.scene.name, "seed": cell.seed},
                identity=identity(plan, cell, parsers[cell.scene]),
                steps=steps_of(plan, cell.run, cell.scene),
                record=str(self.record(cell.name)),
                work=str(self.work / cell.name),
                **{name: getattr(plan, name) for name in ("train_views", "jobs", "quick")},
            )
            for cell in cells
        }

    def stale(self, plan: Spec, cells: list[Cell], parsers: dict[Scene, list[str]] | None) -> dict[str, str]:
        """Records whose arguments are not those of the plan: name -> difference."""
        result = {}
        for cell in cells:
            if self.record(cell.name).exists():
                made_with = read_record(self.record(cell.name))["identity"]
                wanted = identity(plan, cell, parsers.get(cell.scene) if parsers else None)
                if difference := differences(made_with, wanted):
                    result[cell.name] = difference
        return result

    def run_all(self, pending: dict[str, Job], plan: Spec) -> None:
        """Run the jobs, `plan.jobs` at once on each GPU, with the time that is left."""
        for folder in (self.out / "runs", self.work):
            folder.mkdir(parents=True, exist_ok=True)
        waiting, running = list(pending.items()), {}
        finished = 0
        slots = [gpu for _ in range(plan.jobs) for gpu in gpu_names(plan.gpus)]
        # A training on a GPU needs few CPU threads, but torch takes all cores: side by side they wait for each other.
        threads = max(1, (os.cpu_count() or 1) // len(slots))
        end = float("inf") if self.minutes is None else time.monotonic() + 60 * self.minutes
        try:
            while waiting or running:
                if time.monotonic() > end:
                    say(f"Time is up: {len(waiting) + len(running)} runs are left for the next call.")
                    break
                for slot, gpu in enumerate(slots):
                    if slot in running and running[slot][1].poll() is not None:
                        finished += 1
                        say(f"{self.ended(*running.pop(slot))} ({finished} of {len(pending)})")
                    if slot not in running and waiting:
                        name, job = waiting.pop(0)
                        running[slot] = name, self.start(name, job, gpu, threads)
                        say(f"{name}: started")
                time.sleep(0.2)
        finally:
            for _, child in running.values():
                child.terminate()
            for _, child in running.values():
                child.wait()

    def ended(self, name: str, child: subprocess.Popen) -> str:
        """What became of a child, in words; a failure is noted beside its record."""
        record = self.record(name)
        if child.returncode == 0 and record.exists():
            return f"{name}: done"
        write_whole(record.with_suffix(FAILURE), f"{child.returncode}\n")
        return f"{name}: FAILED, see {self.work / name}.log"

    def start(self, name: str, job: Job, gpu: str, threads: int) -> subprocess.Popen:
        """Start a job on a GPU. OMP_NUM_THREADS goes before `threads`."""
        self.record(name).with_suffix(FAILURE).unlink(missing_ok=True)
        file = self.work / f"{name}.job.json"
        write_whole(file, json.dumps(asdict(job), indent=1))
        environment = {"OMP_NUM_THREADS": str(threads), **os.environ, "CUDA_VISIBLE_DEVICES": gpu}
        with (self.work / f"{name}.log").open("a") as log:
            return subprocess.Popen([*CHILD, str(file)], stdout=log, stderr=subprocess.STDOUT, env=environment)


def say(text: str) -> None:
    """Print a line of progress."""
    print(text, file=sys.stderr, flush=True)


def gpu_names(count: int) -> list[str]:
    """Values of CUDA_VISIBLE_DEVICES for `count` of the visible GPUs, or InputError; "", which hides all, stays."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is None and count == 1:
        return ["0"]  # perhaps there is none: then the CPU trains
    if visible is None:
        import torch  # takes seconds

        names = [str(index) for index in range(torch.cuda.device_count())]
    else:
        names = visible.split(",")
    if len(names) < count:
        raise InputError(f"gpus is {count}, but there are {len(names)}. Ask for at most {max(1, len(names))}.")
    return names[:count]
