# SPDX-License-Identifier: Apache-2.0
"""Runs of a benchmark as tasks of submitit: on this machine, or in the queue of a Slurm cluster.

A task runs the command that a child process of `nrfgs bench` would run; its record lies in a folder that all machines
share. A task that the cluster interrupts (preemption, time limit) is queued again by submitit and goes on from the last
checkpoint. Tasks in a queue outlive the benchmark. Their numbers are noted beside the jobs: the next call waits for
those that are still there instead of queueing the runs twice.
"""

import json
import subprocess
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nrfgs_ns.errors import InputError
from nrfgs_ns.files import write_whole

GENERIC = ("timeout_min", "mem_gb", "cpus_per_task", "gpus_per_node")
"""Parameters that submitit knows for every executor; others are Slurm's own."""
LOCAL_TIMEOUT_MIN = 60 * 24 * 30
"""Long enough for any run: by default submitit ends local tasks after minutes."""


@dataclass
class Task:
    """The command of one job, as submitit calls it on another machine."""

    command: list[str]
    """of one job"""
    log: str
    """file that its output is appended to"""
    child: subprocess.Popen | None = field(default=None, repr=False)

    def __call__(self) -> None:
        """Run the command.

        Raises:
            RuntimeError: it failed.
        """
        with open(self.log, "a") as log:
            self.child = subprocess.Popen(self.command, stdout=log, stderr=subprocess.STDOUT)
            try:
                returncode = self.child.wait()
            finally:
                self.end()
        if returncode != 0:
            raise RuntimeError(f"{' '.join(self.command)} ended with code {returncode}; see {self.log}")

    def end(self) -> None:
        """End the command, if it still runs."""
        if self.child is not None and self.child.poll() is None:
            self.child.terminate()
            self.child.wait()

    def checkpoint(self) -> Any:
        """The same command, later: called by submitit before the cluster interrupts the task."""
        from submitit.helpers import DelayedSubmission

        self.end()
        return DelayedSubmission(Task(self.command, self.log))


class Submitted:
    """A task of submitit with the interface of a child process.

    Args:
        job: submitit's.
        lives_on: whether the task is to outlive this process.
    """

    def __init__(self, job, lives_on: bool):
        self.job = job
        self.lives_on = lives_on
        self.returncode: int | None = None

    def poll(self) -> int | None:
        """None while the task waits or runs, 0 when it has done its work, 1 when it has failed."""
        if self.returncode is None and self.job.done():
            self.returncode = int(self.job.exception() is not None)
        return self.returncode

    def terminate(self) -> None:
        """End the task, unless it is to live on."""
        if not self.lives_on and self.returncode is None:
            self.job.cancel()

    def wait(self) -> None:
        """Wait for a task that was terminated."""
        if not self.lives_on and self.returncode is None:
            self.job.wait()


class Queue:
    """A queue of tasks.

    Args:
        name: "local" or "slurm".
        folder: for submitit's files and logs; on a cluster, all machines must see it.
        parameters: KEY=VALUE for submitit, such as timeout_min=600 or partition=gpu.

    Raises:
        InputError: submitit is not installed, or a parameter is not one of its.
    """

    def __init__(self, name: str, folder: Path, parameters: tuple[str, ...] = ()):
        try:
            import submitit
        except ImportError as error:
            raise InputError("--executor needs submitit: pip install 'nrfgs-ns[cluster]'.") from error
        self.name = name
        self.folder = folder.resolve() / "submitit"
        self.executor = submitit.AutoExecutor(folder=self.folder, cluster=name)
        options = {"timeout_min": LOCAL_TIMEOUT_MIN} if name == "local" else {}
        for parameter in parameters:
            key, equals, value = parameter.partition("=")
            if not equals:
                raise InputError(f"--slurm {parameter}: give KEY=VALUE, such as partition=gpu.")
            options[key if key in GENERIC else f"slurm_{key}"] = int(value) if value.isdigit() else value
        try:
            self.executor.update_parameters(stderr_to_stdout=True, **options)
        except (NameError, AssertionError) as error:
            raise InputError(f"--slurm: {error}") from error

    def start(self, name: str, command: list[str], log: Path, gpu: str, note: Path) -> Submitted:
        """Submit a task, or return the one that an earlier benchmark submitted and that is still there.

        Args:
            name: of the run.
            command: that does it.
            log: file for its output.
            gpu: value of CUDA_VISIBLE_DEVICES; a cluster decides by itself.
            note: file that remembers the task.
        """
        if self.name == "slurm" and (earlier := self._earlier(note)) is not None:
            return Submitted(earlier, lives_on=True)
        if self.name == "local":
            # submitit would hide all GPUs from a task that asks for none.
            command = ["env", f"CUDA_VISIBLE_DEVICES={gpu}", *command]
        self.executor.update_parameters(name=name)
        job = self.executor.submit(Task(command, str(log.resolve())))
        write_whole(note, json.dumps({"executor": self.name, "job": job.job_id}))
        return Submitted(job, lives_on=self.name == "slurm")

    def _earlier(self, note: Path):
        """The task of a note, if it still waits or runs."""
        import submitit

        if not note.exists():
            return None
        task = json.loads(note.read_text(encoding="utf-8"))
        if task["executor"] != self.name:
            return None
        job = submitit.SlurmJob(folder=self.folder, job_id=task["job"])
        return None if job.done(force_check=True) else job
