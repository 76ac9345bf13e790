# SPDX-License-Identifier: Apache-2.0
"""When capacity "auto" decides, and what it leaves behind: a line, a file, and scalars for whatever listens."""

import math
from pathlib import Path
from time import perf_counter
from typing import Any

from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.utils import writer
from nerfstudio.utils.rich_utils import CONSOLE

from nrfgs_ns.appearance.nrf import NeuralResidualField
from nrfgs_ns.capacity.aside import Decider, ViewsAside
from nrfgs_ns.capacity.charge import charge_for
from nrfgs_ns.capacity.config import CapacitySearch
from nrfgs_ns.capacity.install import head_changes, install
from nrfgs_ns.capacity.report import add_to_report, continue_report, forget_report
from nrfgs_ns.capacity.search import Decision, decide
from nrfgs_ns.diffuse_splats import schedule_for
from nrfgs_ns.errors import InputError
from nrfgs_ns.pace import TimedPace


class CapacitySchedule:
    """Decides once, after the configured step.

    Args:
        model: an NrfgsModel.
        data: its datamanager.
        optimizers: the training's LeanOptimizers.
        folder: where the report goes; None for nowhere.

    Raises:
        InputError: an option is out of range.
    """

    option = "pipeline.model.capacity 'auto'"

    def __init__(self, model, data, optimizers, folder: Path | None):
        self.model, self.data, self.optimizers, self.folder = model, data, optimizers, folder
        self.config: CapacitySearch = model.config.capacity_search
        for name, least in (("step", 0), ("views", 1), ("settle", 1), ("tolerance_db", 0)):
            value = getattr(self.config, name)
            if value is not None and not value >= least:
                raise InputError(f"pipeline.model.capacity-search.{name} is {value}; it must be at least {least}.")
        if self.config.settle_most < self.config.settle:
            raise InputError(
                f"pipeline.model.capacity-search.settle-most is {self.config.settle_most}; it must be at least as many "
                f"steps as pipeline.model.capacity-search.settle, {self.config.settle}."
            )

    @property
    def last_decision(self) -> int:
        return self.config.step

    @property
    def stretched(self) -> bool:
        return self.model.pace is not None

    def views_wanted(self) -> int | None:
        return self.config.views

    def is_done(self, step: int) -> bool:
        return self.model.capacity_found is not None

    def after_step(self, step: int) -> None:
        """Decide, if it is time, and let the model train on with what pays."""
        if self.is_done(step) or self.model.schedule_step < self.config.step:
            return
        started = perf_counter()

        def trying(what: str) -> None:  # lines, not a bar alone: a log has no other sign that training goes on
            CONSOLE.print(f"Step {step}: which parts of the field pay? Trying {what}", soft_wrap=True)

        with CONSOLE.status("Which parts of the field pay?"):
            decision = decide(self.model, self.data, self.optimizers.optimizers, self.config, trying)
        if decision.chosen is not None:
            install(self.model, self.optimizers, decision.chosen)
        head = head_changes(self.model.head.config)
        self.model.capacity_found = {"step": step, "head": head, "dropped": decision.dropped}
        self.tell(decision, step, perf_counter() - started)

    def tell(self, decision: Decision, step: int, seconds: float) -> None:
        """Log what was decided, and by which evidence."""
        tolerance = self.config.tolerance_db
        measured = [trial for trial in decision.trials[1:] if math.isfinite(trial.loss_db)]
        if decision.dropped:
            aside = f"{len(self.data.views_aside)} views set aside"
            found = f"{aside} say that the field needs no {', no '.join(decision.dropped)}."
        elif measured:
            found = "every part of the field pays; it stays whole."
        else:
            found = "the views set aside have no pixel inside their masks, and say nothing; the field stays whole."
        CONSOLE.print(f"Step {step}: {found}", soft_wrap=True)
        for trial in measured:
            CONSOLE.print(
                f"  {'dropped' if trial.dropped else 'kept'}: {trial.part}, worth {trial.loss_db:.3f} dB after "
                f"{trial.steps} steps (standard error {trial.error_db:.3f}; up to {trial.limit_db:.3g} may go)",
                soft_wrap=True,
            )
        names = [Path(name).name for name in self.data.train_dataset.image_filenames]
        report: dict[str, Any] = {
            **self.model.capacity_found,
            "tolerance_db": tolerance,
            "views_aside": [names[index] for index in self.data.views_aside],
            "splats": self.model.num_points,
            "seconds": seconds,
            "trials": decision.evidence,
        }
        add_to_report(self.folder, report)
        numbers = {name: float(value) for name, value in self.model.capacity_found["head"].items()}
        numbers |= {f"worth of {trial.part} (dB)": trial.loss_db for trial in decision.trials[1:]}
        for listener in writer.EVENT_WRITERS:
            if isinstance(listener, writer.Writer):
                listener.write_scalar_dict("Capacity", numbers, step)


def deciding_callbacks(model, attributes: TrainingCallbackAttributes) -> list[TrainingCallback]:
    """What a training does after each step to find out what its scene needs; nothing unless it is asked for.

    Raises:
        InputError: what is asked for cannot be done in this training.
    """
    data, trainer = attributes.pipeline.datamanager, attributes.trainer
    start = 0 if trainer is None else trainer._start_step
    calls, deciders, lookers = [], [], []
    optimizers = attributes.optimizers
    folder = None if trainer is None else trainer.base_dir
    if model.config.capacity not in ("full", "auto"):
        raise InputError(f"pipeline.model.capacity is {model.config.capacity!r}; use 'full' or 'auto'.")
    # First: after a step in which both are due, a trial has ended, and all splats have their residual.
    if model.config.capacity == "auto":
        _check(model, attributes.pipeline.world_size)
        capacity = CapacitySchedule(model, data, optimizers, folder)
        calls.append(capacity.after_step)
        lookers.append(capacity)
        deciders.append(capacity)
    diffuse = schedule_for(
        model, data, attributes.pipeline.world_size, None if optimizers is None else optimizers.optimizers, folder
    )
    if diffuse is not None:
        calls.append(lambda step: diffuse.after_step(model, step))
        lookers.append(diffuse)
        deciders += [diffuse] if diffuse.config.threshold is None else []
    model.residual_charge = charge_for(model, lookers, trainer, start)
    calls.append(ViewsAside(data, deciders, start).after_step)
    for decider in deciders if trainer is not None else ():
        if not decider.is_done(start - 1):
            _warn_of_early_end(decider, trainer, start)
    if start == 0:
        forget_report(folder)
    elif trainer.config.load_dir is not None or trainer.config.load_checkpoint is not None:
        models = trainer.config.load_dir or Path(trainer.config.load_checkpoint).parent
        continue_report(folder, Path(models).parent, start)
    return [TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], call) for call in calls]


def _check(model, devices: int) -> None:
    option = CapacitySchedule.option
    if not isinstance(model.head, NeuralResidualField):
        raise InputError(f"{option}: the {model.head.name!r} head has no parts to drop. Use full, or the method nrfgs.")
    if devices > 1:
        raise InputError(f"{option}: the splats are spread over {devices} devices. Use one device, or full.")


def _warn_of_early_end(decider: Decider, trainer, start: int) -> None:
    if decider.stretched:
        last = trainer.pace.length - 1
    elif isinstance(trainer.pace, TimedPace):
        return  # nobody knows the last step yet
    else:
        last = start + trainer.config.max_num_iterations - 1
    if decider.last_decision > last:
        kind = " of the schedules" if decider.stretched else ""
        CONSOLE.print(
            f"[bold yellow]{decider.option} sets views aside until step {decider.last_decision}{kind}, but this "
            f"training ends at step {last:g}{kind}: they are never trained on. Let it decide earlier, or leave it out.",
            soft_wrap=True,
        )
