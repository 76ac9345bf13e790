# SPDX-License-Identifier: Apache-2.0
"""A benchmark: runs x strategies x scenes x seeds. `file.py` reads one, `job.py` has the command of each training."""

import re
from dataclasses import dataclass, field
from functools import cache

QUIET = (
    "--vis tensorboard --steps-per-eval-image 1000000 --steps-per-eval-all-images 1000000 "
    "--logging.local-writer.enable False --logging.profiler none"
).split()
"""Options without evaluation, viewer and terminal table during a training."""
OWN = "own"
"""Strategy or number of steps that the method chooses: no option."""
DEFAULT = "default"
"""The run that a plan with knobs compares all others with."""
AVERAGE = "average"
"""In the column of scenes: the average over scenes."""
PRESET_STEPS = {"nrfgs-fast": 10_000}
"""Presets that differ from their method by the number of steps -> training steps."""


@dataclass(frozen=True)
class Method:
    """A run: a row of the table."""

    name: str
    method: str  # method of ns-train
    options: tuple[str, ...] = ()  # its options
    strategies: tuple[str, ...] = ()  # instead of the benchmark's; another project's methods have only `own` by default
    steps: int | str | None = None  # instead of the preset's, scene's or benchmark's; own: what the method chooses
    scenes: tuple[str, ...] = ()  # only these scenes
    knob: str = ""  # the knob that is varied


@dataclass(frozen=True)
class Scene:
    """A data set, and how it is read."""

    path: str  # folder below --scenes
    downscale: int | None = None  # read images_N; None: by size in nerfstudio's layout, full size in COLMAP's
    options: tuple[str, ...] = ()  # options of the data parser
    steps: int | None = None  # training steps, instead of the benchmark's
    views: int | None = None  # number of training views to keep, evenly spaced
    held_out: int | None = None  # first held-out view
    held_out_every: int = 8  # from one held-out view to the next
    held_out_by: str = "name"  # order of the views; place: blocks along the cameras' longest axis, which leaves gaps

    @property
    def name(self) -> str:
        """Name in tables and records."""
        if self.held_out is None:
            return self.path if self.views is None else f"{self.views} views/{self.path}"
        fold = self.held_out if self.held_out_every == 8 else f"{self.held_out} of {self.held_out_every}"
        fold = f"place {fold}" if self.held_out_by == "place" else fold
        return "/".join(str(part) for part in (fold, self.views, self.path) if part is not None)


@dataclass
class Spec:
    """A benchmark."""

    runs: list[Method]  # methods with options
    scenes: list[Scene]  # data sets
    strategies: list[str] = field(default_factory=lambda: [OWN])  # densification; NAME@N: NAME,budget=N; own: no option
    seeds: list[int] = field(default_factory=lambda: [42])  # --machine.seed of each repetition
    steps: int = 30_000  # training steps, except of scenes, presets and runs that have their own
    options: tuple[str, ...] = ()  # options of ns-train for every run
    held_out: list[int] = field(default_factory=list)  # first views; each makes a held-out version of each scene
    held_out_every: int = 8  # from one held-out view to the next
    held_out_by: str = "name"  # order of the views (see `Scene`)
    quick: bool = False  # quality alone: no ns-eval, pictures or frame rates; checkpoints are removed
    train_views: int = 16  # training images to evaluate, evenly spaced
    checkpoint_every: int = 5_000  # steps between checkpoints
    jobs: int = 1  # runs at once on each GPU, or on the CPU
    gpus: int = 1  # GPUs to spread the runs over


@dataclass(frozen=True)
class Cell:
    """One training of a benchmark."""

    run: Method
    strategy: str
    scene: Scene
    seed: int

    @property
    def name(self) -> str:
        """Name of its files."""
        return re.sub(r"[^A-Za-z0-9_.@-]", "_", f"{self.run.name}-{self.strategy}-{self.scene.name}-{self.seed}")


def cells_of(spec: Spec) -> list[Cell]:
    """All trainings: the first seed of everything before the second, strategy by strategy on each scene."""
    order = dict.fromkeys([*spec.strategies, *(name for run in spec.runs for name in strategies_of(run, spec))])
    return [
        Cell(run, strategy, scene, seed)
        for seed in spec.seeds
        for scene in spec.scenes
        for strategy in order
        for run in spec.runs
        if strategy in strategies_of(run, spec) and (not run.scenes or {scene.name, scene.path} & set(run.scenes))
    ]


@cache
def is_ours(method: str) -> bool:
    """Whether a method has this project's trainer, and so its strategies, and checkpoints to resume from."""
    if method.startswith(("nrfgs", "splatfacto")):
        return method.startswith("nrfgs")
    from nerfstudio.configs.method_configs import all_methods  # takes seconds

    from nrfgs_ns.training.trainer_config import NrfgsTrainerConfig

    return isinstance(all_methods.get(method), NrfgsTrainerConfig)


def strategies_of(run: Method, spec: Spec) -> tuple[str, ...]:
    """Strategies of a run; another project's methods have their own."""
    return run.strategies or (tuple(spec.strategies) if is_ours(run.method) else (OWN,))


def steps_of(spec: Spec, run: Method, scene: Scene) -> int | None:
    """Training steps: the run's, else the preset's, the scene's or the benchmark's; None: the method chooses them."""
    steps = run.steps or PRESET_STEPS.get(run.method) or scene.steps or spec.steps
    return None if steps == OWN else steps


def strategy_options(strategy: str) -> list[str]:
    """Options of ns-train for a strategy; NAME@N is NAME,budget=N. InputError if strategy or option is unknown."""
    if strategy == OWN:
        return []
    from nrfgs_ns.densification import strategy_from  # imports torch

    return ["--pipeline.model.densification", str(strategy_from(strategy.replace("@", ",budget=")))]
