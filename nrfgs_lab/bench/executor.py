# SPDX-License-Identifier: Apache-2.0
"""Runs of a benchmark as tasks of submitit: on this machine, or in the queue of a Slurm cluster.

A task runs the command of a child process. All machines share the folders. submitit queues an interrupted task again
(preemption, time limit), and it resumes from its last checkpoint. Tasks in a queue outlive the benchmark: the next call
finds their numbers beside the jobs, and waits for them.
"""

import json
import subprocess
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nrfgs_ns.errors import InputError
from nrfgs_ns.files import write_whole

GENERIC = ("timeout_min", "mem_gb", "cpus_per_task", "gpus_per_node")
"""Parameters of every executor; others are Slurm's."""
LOCAL_TIMEOUT_MIN = 60 * 24 * 30
"""By default submitit ends local tasks after minutes."""


@dataclass
class Task:
    """Command of a job, called by submitit on another machine."""

    command: list[str]
    log: str
    """file for its output, appended"""
    child: subprocess.Popen | None = field(default=None, repr=False)

    def __call__(self) -> None:
        """Run the command; RuntimeError if it fails."""
        with open(self.log, "a") as log:
            self.child = subprocess.Popen(self.command, stdout=log, stderr=subprocess.STDOUT)
            try:
                returncode = self.child.wait()
            finally:
                self.end()
        if returncode != 0:
            raise RuntimeError(f"{' '.join(self.command)} ended with code {returncode}; see {self.log}")

    def end(self) -> None:
        """End the command if it runs."""
        if self.child is not None and self.child.poll() is None:
            self.child.terminate()
            self.child.wait()

    def checkpoint(self) -> Any:
        """Queue the same command again; submitit calls this before the cluster interrupts the task."""
        from submitit.helpers import DelayedSubmission

        self.end()
        return DelayedSubmission(Task(self.command, self.log))


class Submitted:
    """A task of submitit with the interface of a child process; `lives_on`: it outlives this process."""

    def __init__(self, job, lives_on: bool):
        self.job = job
        self.lives_on = lives_on
        self.returncode: int | None = None

    def poll(self) -> int | None:
        """None while the task waits or runs, 0 after success, 1 after a failure."""
        if self.returncode is None and self.job.done():
            self.returncode = int(self.job.exception() is not None)
        return self.returncode

    def terminate(self) -> None:
        """End the task, unless it lives on."""
        if not self.lives_on and self.returncode is None:
            self.job.cancel()

    def wait(self) -> None:
        """Wait for a terminated task."""
        if not self.lives_on and self.returncode is None:
            self.job.wait()


class Queue:
    """A queue of tasks.

    Args:
        name: "local" or "slurm".
        folder: folder for submitit's files and logs.
        parameters: KEY=VALUE for submitit, such as timeout_min=600 or partition=gpu.

    Raises:
        InputError: submitit is not installed, or has no such parameter.
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
        """Submit a run's command, or return its task if that is still queued or running.

        Args:
            gpu: CUDA_VISIBLE_DEVICES of a local task.
            note: file with the task's number.
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
        """Task of a note, if it waits or runs."""
        import submitit

        if not note.exists():
            return None
        task = json.loads(note.read_text(encoding="utf-8"))
        if task["executor"] != self.name:
            return None
        job = submitit.SlurmJob(folder=self.folder, job_id=task["job"])
        return None if job.done(force_check=True) else job
