# SPDX-License-Identifier: Apache-2.0
"""`nrfgs tradeoff`: a benchmark made from knobs, run by `nrfgs bench`, and read as a trade."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from nrfgs_ns.studies.bench import Bench


@dataclass
class Tradeoff:
    """Find out what each knob buys and what it costs: turn one at a time, and report. See docs/trade-off.md."""

    spec: Annotated[Path, tyro.conf.Positional]
    """YAML file with the default, knobs, scenes, seeds, ...; what is given as an option here has precedence"""
    scenes: Path = Path(".")
    """folder in which the data sets lie"""
    out: Path = Path("tradeoff")
    """folder for runs/*.json and the report"""
    work: Path = Path("outputs/tradeoff")
    """folder for checkpoints, pictures and logs"""
    data: tuple[str, ...] = ()
    """data sets: folders below --scenes"""
    knobs: tuple[str, ...] = ()
    """knobs to turn; none for all of the file"""
    seeds: tuple[int, ...] = ()
    """--machine.seed of each repetition"""
    steps: int | None = None
    """training steps, but for runs that name their own"""
    jobs: int | None = None
    """runs at once on each GPU, or on the CPU; times are reported only with 1"""
    gpus: int | None = None
    """GPUs to spread the runs over"""
    executor: Literal["local", "slurm"] | None = None
    """run each training as a task of submitit: on this machine, or in a Slurm queue. None: as a child process"""
    slurm: tuple[str, ...] = ()
    """parameters of a task, KEY=VALUE, as in `nrfgs bench`"""
    cuda: bool | None = None
    """turn the knobs that only a GPU has. None: if there is one"""
    report_only: bool = False
    """run nothing: report what is there"""
    redo_stale: bool = False
    """put records that were made with other arguments aside, and make them anew"""

    def main(self) -> None:
        import yaml

        from nrfgs_ns.studies.files import write_whole
        from nrfgs_ns.studies.tradeoff.report import report

        content, settings = self.plan()
        file = self.out / "bench.yaml"
        write_whole(file, yaml.safe_dump(content, sort_keys=False, width=120))
        bench = self.bench(file)
        bench.main()
        plan = bench.plan()
        report(plan, settings, self.out, bench.stale(plan, None))

    def plan(self) -> tuple[dict[str, Any], list]:
        """The benchmark as `nrfgs bench` reads it, and the settings behind its runs."""
        from nrfgs_ns.studies.bench_spec import load_spec
        from nrfgs_ns.studies.tradeoff.plan import bench_plan

        content = load_spec(self.spec)
        given = {"scenes": list(self.data), "seeds": list(self.seeds), "steps": self.steps}
        content |= {key: value for key, value in given.items() if value}
        return bench_plan(content, str(self.spec), self._has_cuda(), self.knobs)

    def bench(self, file: Path) -> Bench:
        """The benchmark that runs a plan."""
        return Bench(
            spec=file,
            scenes=self.scenes,
            out=self.out,
            work=self.work,
            jobs=self.jobs,
            gpus=self.gpus,
            executor=self.executor,
            slurm=self.slurm,
            report_only=self.report_only,
            redo_stale=self.redo_stale,
        )

    def _has_cuda(self) -> bool:
        if self.cuda is not None:
            return self.cuda
        import torch

        return torch.cuda.is_available()
