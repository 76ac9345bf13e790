# SPDX-License-Identifier: Apache-2.0
"""`nrfgs bench`: methods x strategies x scenes x seeds, one table, one figure, one sheet of crops for each scene.

Each training is a process of its own (`bench_run.py`) that leaves OUT/runs/NAME.json when it is finished. What is there
is not repeated, what was cut off goes on from its checkpoint, what failed is tried again at the next call and listed
as FAILED until then. A record that was made with other arguments is never mixed in: the benchmark stops and names it.
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
from typing import IO, Annotated, Literal

import tyro
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from nrfgs_lab.bench.executor import Queue, Submitted
from nrfgs_lab.lock import only_one
from nrfgs_ns.errors import InputError
from nrfgs_ns.files import check_writable, write_whole

CHILD = (sys.executable, "-m", "nrfgs_lab.bench.run")
"""The command that does a job; the file that describes the job is appended."""
POLL_SECONDS = 0.2


@dataclass
class Running:
    """A child at work."""

    name: str
    process: "subprocess.Popen | Submitted"
    log: IO
    work: Path
    record: Path
    identity: dict

    def steps(self) -> int:
        """How far its training is, as far as it said."""
        try:
            return int(json.loads((self.work / "progress.json").read_text(encoding="utf-8"))["step"])
        except (OSError, ValueError, KeyError):
            return 0


@dataclass
class Bench:
    """Compare methods over strategies, scenes and seeds: train all, and report. See docs/bench.md."""

    spec: Annotated[Path | None, tyro.conf.Positional] = None
    """YAML file with runs, strategies, scenes, seeds, ...; options given here override it"""
    scenes: Path = Path(".")
    """folder in which the data sets lie"""
    out: Path = Path("bench")
    """folder for runs/*.json and the report"""
    work: Path = Path("outputs/bench")
    """folder for checkpoints, pictures and logs"""
    data: tuple[str, ...] = ()
    """data sets: folders in --scenes; the file may say how to read them"""
    runs: tuple[str, ...] = ()
    """runs of the file by name, or methods, each METHOD or "NAME=METHOD OPTIONS" """
    strategies: tuple[str, ...] = ()
    """densification: splatfacto, original, mcmc, mcmc@BUDGET, own"""
    seeds: tuple[int, ...] = ()
    """seeds (--machine.seed), one training for each"""
    steps: int | None = None
    """training steps, except of runs and presets that have their own"""
    options: str | None = None
    """options of ns-train for every run"""
    train_views: int | None = None
    """number of training images to evaluate, too"""
    jobs: int | None = None
    """runs at once on each GPU, or on the CPU; times are reported only with 1"""
    gpus: int | None = None
    """GPUs to spread the runs over"""
    executor: Literal["local", "slurm"] | None = None
    """run each training as a task of submitit: on this machine, or in a Slurm queue. None: as a child process"""
    slurm: tuple[str, ...] = ()
    """parameters of a task, KEY=VALUE: timeout_min=600 partition=gpu gpus_per_node=1 cpus_per_task=8 ..."""
    queued: int = 64
    """slurm: largest number of runs in the queue"""
    report_only: bool = False
    """run nothing: report what is there"""
    redo_stale: bool = False
    """rename records of other arguments to NAME.stale, and run them again"""

    def main(self) -> None:
        asked, whole = self.plans()
        self.carry_out(asked, whole)
        self.complain(asked)

    def carry_out(self, asked, whole):
        """Train what is missing of what is asked for, and report.

        Args:
            asked: a `Spec`.
            whole: the same with everything else of its file, which is reported as far as it is there.

        Returns:
            The `Spec` of the report, and name -> difference of the records that it could not use.
        """
        from nrfgs_lab.bench.choice import is_method
        from nrfgs_lab.bench.report import report  # matplotlib takes a second; `nrfgs --help` should not
        from nrfgs_lab.bench.spec import steps_of

        check_writable(self.out / "table.md", "--out")
        parsers = None if self.report_only else self.parsers(asked)
        stale = self.stale(asked, parsers)
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
        jobs = self.jobs_of(asked, parsers) if parsers else {}
        pending = {name: job for name, job in jobs.items() if not self.record(name).exists()}
        own = [f"{run.name} ({steps_of(asked, run)})" for run in asked.runs if steps_of(asked, run) != asked.steps]
        for run in asked.runs if pending else ():
            if not is_method(run.method):
                raise InputError(f"{self.spec}: runs: {run.name}: {run.method!r} is no method of ns-train.")
        if pending and own and self.steps is not None:
            print(f"--steps does not change runs that have their own: {', '.join(own)}.")
        if pending:
            # A terminated benchmark must not leave its children behind; an exception reaches the `finally` below.
            signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
            self.run_all(pending, asked)
        # Another command may end at this moment: whoever reports last must have read the records of both.
        with only_one(self.out / ".lock", "Another command reports here; waiting for it to end."):
            shown = self.shown(asked, whole)
            stale = self.stale(shown, parsers)
            report(shown, self.out, self.work, stale)
        return shown, stale

    def shown(self, asked, whole):
        """The `Spec` of what a report shows now."""
        from nrfgs_lab.bench.choice import with_records

        return with_records(whole, asked, lambda name: self.record(name).exists() or self.has_failed(name))

    def complain(self, asked) -> None:
        """End with status 1 if a training that was asked for has failed."""
        from nrfgs_lab.bench.spec import cells_of

        failed = [cell.name for cell in cells_of(asked) if self.has_failed(cell.name)]
        if failed and not self.report_only:
            sys.exit(f"nrfgs: {len(failed)} of the runs FAILED: {', '.join(failed)}. Logs: {self.work}/NAME.log")

    def plan(self):
        """The `Spec` that is asked for: the file, with this command's options over it."""
        return self.plans()[0]

    def plans(self):
        """The `Spec` that is asked for, and that with all of its file."""
        from nrfgs_lab.bench.choice import chosen_runs, chosen_scenes, united
        from nrfgs_lab.bench.spec import load_spec, make_spec

        where = str(self.spec or "nrfgs bench")
        file = load_spec(self.spec) if self.spec else {}
        given = {"strategies": self.strategies, "seeds": self.seeds, "steps": self.steps, "options": self.options}
        given |= {"train_views": self.train_views, "jobs": self.jobs, "gpus": self.gpus}
        asked = {**file, **{key: value for key, value in given.items() if value not in (None, ())}}
        if self.runs:
            of_file = file.get("runs") or {}
            if not isinstance(of_file, dict):
                raise InputError(f"{where}: runs must map names to methods.")
            asked["runs"] = chosen_runs(self.runs, {str(name): run for name, run in of_file.items()}, where)
        if self.data:
            asked["scenes"] = chosen_scenes(self.data, file.get("scenes") or [])
        chosen, whole = make_spec(asked, where), make_spec(united(file, asked), where)
        if unknown := sorted(set(whole.crops) - {scene.name for scene in whole.scenes}):
            raise InputError(f"{where}: crops: {unknown[0]!r} is none of its scenes. Correct or remove it.")
        return chosen, whole

    def record(self, name: str) -> Path:
        """The file that a finished run leaves."""
        return self.out / "runs" / f"{name}.json"

    def has_failed(self, name: str) -> bool:
        """Whether a run's last attempt failed."""
        return failure(self.record(name)).exists() and not self.record(name).exists()

    def parsers(self, plan) -> dict:
        """Scene -> the data parser and its options. A data set that cannot be read fails now."""
        from nrfgs_lab.bench.data import parser_options

        return {scene: parser_options(self.scenes, scene, self.work / "scenes") for scene in plan.scenes}

    def jobs_of(self, plan, parsers: dict) -> dict:
        """Name -> `Job` of every training."""
        from nrfgs_lab.bench.spec import Job, cells_of, command, identity, steps_of

        return {
            cell.name: Job(
                args=command(plan, cell, parsers[cell.scene], self.work / cell.name),
                identity=identity(plan, cell, parsers[cell.scene]),
                steps=steps_of(plan, cell.run),
                record=str(self.record(cell.name)),
                work=str(self.work / cell.name),
                train_views=plan.train_views,
                jobs=plan.jobs,
            )
            for cell in cells_of(plan)
        }

    def stale(self, plan, parsers: dict | None) -> dict[str, str]:
        """Name -> difference, of the records whose arguments are not those of the plan."""
        from nrfgs_lab.bench.spec import cells_of, differences, identity, read_record

        result = {}
        for cell in cells_of(plan):
            if self.record(cell.name).exists():
                made_with = read_record(self.record(cell.name))["identity"]
                wanted = identity(plan, cell, parsers.get(cell.scene) if parsers else None)
                if difference := differences(made_with, wanted):
                    result[cell.name] = difference
        return result

    def run_all(self, pending: dict, plan) -> None:
        """Run the jobs, `plan.jobs` at once on each GPU, with the time that is left."""
        for folder in (self.out / "runs", self.work):
            folder.mkdir(parents=True, exist_ok=True)
        waiting, running, finished, steps_finished = list(pending.items()), {}, 0, 0
        queue = Queue(self.executor, self.work, self.slurm) if self.executor else None
        if self.executor == "slurm":
            slots = [""] * self.queued
        else:
            slots = [gpu for _ in range(plan.jobs) for gpu in gpu_names(plan.gpus)]
        # A training on a GPU needs few CPU threads, but torch takes all cores: side by side they wait for each other.
        threads = max(1, (os.cpu_count() or 1) // len(slots))
        columns = TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn()
        with Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True)) as progress:

            def say(text: str) -> None:
                progress.console.print(text, highlight=False, markup=False, soft_wrap=True)

            bar = progress.add_task("", total=sum(job.steps for job in pending.values()))
            try:
                while waiting or running:
                    for slot, gpu in enumerate(slots):
                        if slot in running and running[slot].process.poll() is not None:
                            done = running.pop(slot)
                            done.log.close()
                            finished, steps_finished = finished + 1, steps_finished + pending[done.name].steps
                            good = done.process.returncode == 0 and done.record.exists()
                            say(f"{done.name}: {'done' if good else 'FAILED'}")
                            if not good:
                                note = {"returncode": done.process.returncode, "identity": done.identity}
                                write_whole(failure(done.record), json.dumps(note, indent=1) + "\n")
                                say(f"  see {done.log.name}")
                        if slot not in running and waiting:
                            running[slot] = self.start(*waiting.pop(0), gpu, threads, queue)
                            say(f"{running[slot].name}: started")
                    steps = steps_finished + sum(child.steps() for child in running.values())
                    label = f"{finished} of {len(pending)} runs"
                    progress.update(bar, completed=steps, description=label)
                    time.sleep(POLL_SECONDS)
            finally:
                for child in running.values():
                    child.process.terminate()
                for child in running.values():
                    child.process.wait()
                    child.log.close()

    def start(self, name: str, job, gpu: str, threads: int, queue: Queue | None) -> Running:
        """Start one job on a GPU, with as many CPU threads unless OMP_NUM_THREADS says otherwise, or queue it."""
        failure(self.record(name)).unlink(missing_ok=True)
        file = self.work / f"{name}.job.json"
        write_whole(file, json.dumps(asdict(job), indent=1))
        log = (self.work / f"{name}.log").open("a")
        if queue is not None:
            command, note = [*CHILD, str(file.resolve())], self.work / f"{name}.task.json"
            process = queue.start(name, command, Path(log.name), gpu, note)
            return Running(name, process, log, Path(job.work), self.record(name), job.identity)
        environment = {"OMP_NUM_THREADS": str(threads), **os.environ, "CUDA_VISIBLE_DEVICES": gpu}
        process = subprocess.Popen([*CHILD, str(file)], stdout=log, stderr=subprocess.STDOUT, env=environment)
        return Running(name, process, log, Path(job.work), self.record(name), job.identity)


def failure(record: Path) -> Path:
    """The note that a run's last attempt failed."""
    return record.with_suffix(".failed")


def gpu_names(count: int) -> list[str]:
    """Values of CUDA_VISIBLE_DEVICES for `count` GPUs, out of those that this process may see.

    An empty one, which hides all GPUs, stays empty.

    Raises:
        InputError: it may see fewer.
    """
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is not None:
        names, limit = visible.split(","), f"CUDA_VISIBLE_DEVICES is {visible!r}"
    elif count > 1:
        import torch  # takes seconds, and one may be asked for where there is none: then the CPU trains

        names = [str(index) for index in range(torch.cuda.device_count())]
        limit = f"this machine has {len(names)}"
    else:
        return ["0"]
    if len(names) < count:
        raise InputError(f"gpus is {count}, but {limit}. Ask for at most {max(1, len(names))}.")
    return names[:count]
