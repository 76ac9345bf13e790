# SPDX-License-Identifier: Apache-2.0
"""Jobs of `device.py`. Each runs on all devices at once, in a process group of its own making."""

from pathlib import Path

import nerfstudio.configs.method_configs  # noqa: F401  (here, so that processes which are forked need not)
import short_trainings  # noqa: F401  (likewise)
import torch
import torch.distributed as dist
from device import BY_ERROR, PEAK, PIXELS, PLAIN, RICH, one_step, told, train
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.utils.rich_utils import CONSOLE

AVERAGED = {
    "--average-steps": 10,
    "--steps-per-save": 7,
    "--save-only-latest-checkpoint": False,
    "--pipeline.model.densification": f"{PEAK},stop_split_at=8",
}
"""Of 12 steps, the mean begins at step 2. The only refinement, at step 4, leaves the shards as it makes them."""


def everything(scene: Path, folder: Path) -> None:
    """All that the default suite looks at, in one meeting: to meet takes longer than most of it."""
    one_step(PLAIN, scene, folder, "plain")
    one_step(RICH, scene, folder, "rich")
    one_step(PIXELS, scene, folder, "pixels")
    thirty_steps(scene, folder)
    there_and_back(scene, folder)
    stops_together(scene, folder)
    held_together(scene, folder)
    averaged(scene, folder)


def thirty_steps(scene: Path, folder: Path) -> None:
    """30 steps with splits, pruning and resets; how the shards fared is saved beside the checkpoint."""
    counts = []

    def watch(trainer) -> None:
        model = trainer.pipeline.model
        after_each(trainer, lambda step: counts.append((step, model.num_points, list(model.counts))))

    trainer = train(scene, folder / "thirty", dist.get_world_size(), 30, watch=watch, **PLAIN)
    shared = {name: value.detach().cpu() for name, value in trainer.pipeline.model.head.named_parameters()}
    result = {"counts": counts, "shared": shared, "saved": str(told(trainer))}
    torch.save(result, folder / f"thirty-{dist.get_rank()}.pt")


def after_each(trainer, do) -> None:
    trainer.callbacks.append(TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], do))


def there_and_back(scene: Path, folder: Path) -> None:
    """Checkpoints from two devices to one and to two again, looked at before training; both evaluate the first."""
    world, main = dist.get_world_size(), dist.get_rank() == 0
    two = train(scene, folder / "half", world, 6, **BY_ERROR)
    scores, half = [evaluation(two)], told(two)

    def look(name: str):
        def see(trainer) -> None:
            torch.save(holds(trainer), folder / f"{name}-{dist.get_rank()}.pt")
            if name == "one":
                scores.append(evaluation(trainer))

        return see

    one = told(train(scene, folder / "one", 1, 12, load=half, watch=look("one"), **BY_ERROR) if main else None)
    again = told(train(scene, folder / "two", world, 18, load=one, watch=look("two"), **BY_ERROR))
    torch.save(scores, folder / f"scores-{dist.get_rank()}.pt")
    if main:
        torch.save([str(path) for path in (half, one, again)], folder / "there-and-back.pt")


def evaluation(trainer) -> dict:
    metrics = trainer.pipeline.get_average_eval_image_metrics()
    return {name: value for name, value in metrics.items() if name not in ("seconds_per_image", "fps")}


def holds(trainer) -> dict:
    """A device's splats, their moments and statistics."""
    model = trainer.pipeline.model
    optimizers = trainer.optimizers.optimizers
    held = {name: optimizers[name].param_groups[0]["params"][0] for name in model.gauss_params}
    return {
        "splats": {name: value.detach() for name, value in model.gauss_params.items()},
        "same": all(held[name] is value for name, value in model.gauss_params.items()),
        "moments": {name: optimizers[name].state[value]["exp_avg_sq"] for name, value in held.items()},
        "statistics": {k: v for k, v in model.densification.state.items() if isinstance(v, torch.Tensor)},
        "sampling": trainer.pipeline.datamanager.sampling_state()["unseen_cameras"],
    }


def fits_one_process(scene: Path, folder: Path) -> None:
    """Device 0's image and loss in the first step, and those of one process; in the devices' own precision."""
    one_step(PLAIN, scene, folder, "step", prepare=lambda trainer: None)
    thirty_steps(scene, folder)


def stops_together(scene: Path, folder: Path) -> None:
    """The second device's image has NaN at step 7; then all splats are pruned, at step 10."""
    from nrfgs_ns.training.guard import TrainingStopped

    def break_image(trainer) -> None:
        step = trainer.pipeline.get_train_loss_dict

        def broken(step_number: int, *how):
            outputs, losses, metrics = step(step_number, *how)
            if step_number == 7 and dist.get_rank() == 1:
                losses["main_loss"] = losses["main_loss"] * float("nan")
                trainer.pipeline.model.watched["loss main_loss"] = losses["main_loss"].detach()
            return outputs, losses, metrics

        trainer.pipeline.get_train_loss_dict = broken

    said = []
    pruned = {"--pipeline.model.densification": "splatfacto,warmup_length=1,refine_every=2,cull_alpha_thresh=0.49"}
    for name, how in (("stopped", {"watch": break_image}), ("pruned", pruned)):
        try:
            train(scene, folder / name, dist.get_world_size(), 14, **PLAIN | how)
        except TrainingStopped as stopped:
            said.append(str(stopped))
    torch.save(said, folder / f"stopped-{dist.get_rank()}.pt")


def held_together(scene: Path, folder: Path) -> None:
    """The second device has memory for no more splats than it has."""
    from nrfgs_ns.densification import memory

    of_one, counts = memory.most_splats, []

    def limit(trainer) -> None:
        model = trainer.pipeline.model
        memory.most_splats = lambda *_: model.num_points if dist.get_rank() else 10**6
        after_each(trainer, lambda step: counts.append(model.num_points))

    try:
        trainer = train(scene, folder / "held", dist.get_world_size(), 10, watch=limit, **BY_ERROR)
    finally:
        memory.most_splats = of_one
    held = trainer.pipeline.model.densification.state["held_at"]
    torch.save({"counts": counts, "held": held}, folder / f"held-{dist.get_rank()}.pt")


def averaged(scene: Path, folder: Path) -> None:
    """12 steps with a mean over the last 10, and the last 4 of them again, from the checkpoint in between."""
    from nrfgs_ns.training import averaging

    averaging.LARGEST_SHARE = 1.0
    world, main = dist.get_world_size(), dist.get_rank() == 0
    after, counts = [], []

    def lopsided(trainer) -> None:
        """Only the second device refines."""
        rules = trainer.pipeline.model.densification
        rules.strategy.pause_refine_after_reset = 0
        if main:
            rules.strategy._grow_gs, rules._prune = lambda *_: (0, 0), lambda *_: 0

    def watch(trainer) -> None:
        lopsided(trainer)

        def keep(step: int) -> None:
            after.append(parameters(trainer))
            counts.append(trainer.mean.count)

        after_each(trainer, keep)

    options = {**PLAIN, **AVERAGED, "--pipeline.model.photographs": "on"}
    with CONSOLE.capture() as log:
        trainer = train(scene, folder / "averaged", world, 12, watch=watch, **options)
    whole, ended = told(trainer), parameters(trainer)
    result = {"after": after[:], "counts": counts[:], "ended": ended, "said": log.get(), "saved": [str(whole)]}
    result["exposures"] = trainer.pipeline.model.photograph.shots.detach().clone()
    counts.clear()
    train(scene, folder / "averaged-rest", world, 12, load=whole, watch=watch, **options, **{"--load-step": 7})
    torch.save(result | {"resumed": counts}, folder / f"averaged-{dist.get_rank()}.pt")
    dist.barrier()


def parameters(trainer) -> dict:
    named = trainer.pipeline.model.named_parameters()
    return {name: value.detach().clone() for name, value in named if name.startswith(("gauss_params.", "head."))}
