# SPDX-License-Identifier: Apache-2.0
"""`nrfgs tradeoff`: a benchmark made from knobs, run by `nrfgs bench`, and read as a trade."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from nrfgs_lab.bench.command import Bench


@dataclass
class Tradeoff:
    """Find out what each option buys and what it costs, one at a time. See docs/trade-off.md."""

    spec: Annotated[Path, tyro.conf.Positional]
    """YAML file with the default, knobs, scenes, seeds, ...; what is given as an option here has precedence"""
    scenes: Path = Path(".")
    """folder in which the data sets lie"""
    out: Path = Path("tradeoff")
    """folder for runs/*.json and the report"""
    work: Path = Path("outputs/tradeoff")
    """folder for checkpoints, pictures and logs"""
    data: tuple[str, ...] = ()
    """data sets: folders in --scenes; the file may say how to read them"""
    knobs: tuple[str, ...] = ()
    """knobs to turn, or single settings such as "steps 7000"; none for all of the file"""
    seeds: tuple[int, ...] = ()
    """seeds (--machine.seed), one training for each"""
    steps: int | None = None
    """training steps, except of runs and presets that have their own"""
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
    """rename records that were made with other arguments to NAME.stale, and make them anew"""

    def main(self) -> None:
        from nrfgs_lab.bench.spec import make_spec
        from nrfgs_lab.tradeoff.report import report

        content, everything, settings = self.plan()
        bench = self.bench()
        given = {key: value for key, value in (("jobs", self.jobs), ("gpus", self.gpus)) if value is not None}
        asked, whole = (make_spec({**plan, **given}, str(self.spec)) for plan in (content, everything))
        shown, stale = bench.carry_out(asked, whole)
        self.leave_file(everything, shown)
        runs = {run.name for run in shown.runs}
        report(shown, [setting for setting in settings if setting.name in runs], self.out, stale)
        bench.complain(asked)

    def plan(self) -> tuple[dict[str, Any], dict[str, Any], list]:
        """The benchmark that is asked for and that with all of the file, as `nrfgs bench` reads them, and the settings
        behind the runs of the latter."""
        from nrfgs_lab.bench.choice import chosen_scenes, united
        from nrfgs_lab.bench.spec import load_spec
        from nrfgs_lab.tradeoff.plan import bench_plan

        file = load_spec(self.spec)
        content = file if self.steps is None else {**file, "steps": self.steps}
        asked, _ = bench_plan(content, str(self.spec), self._has_cuda(), self.knobs)
        whole, settings = bench_plan(content, str(self.spec), True)
        if self.data:
            asked["scenes"] = chosen_scenes(self.data, file.get("scenes") or [])
        if self.seeds:
            asked["seeds"] = list(self.seeds)
        return asked, united(whole, asked), settings

    def leave_file(self, everything: dict[str, Any], shown) -> None:
        """Write OUT/bench.yaml: of everything, what a report shows."""
        import yaml

        from nrfgs_lab.bench.spec import as_list, scene_name
        from nrfgs_ns.files import write_whole

        runs, scenes = {run.name for run in shown.runs}, {scene.name for scene in shown.scenes}
        content = {
            **everything,
            "scenes": [scene for scene in as_list(everything["scenes"]) if scene_name(scene) in scenes],
            "seeds": shown.seeds,
            "runs": {name: run for name, run in everything["runs"].items() if name in runs},
        }
        write_whole(self.out / "bench.yaml", yaml.safe_dump(content, sort_keys=False, width=120))

    def bench(self) -> Bench:
        """What runs a plan."""
        return Bench(
            spec=self.spec,
            scenes=self.scenes,
            out=self.out,
            work=self.work,
            steps=self.steps,
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
