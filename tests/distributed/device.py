# SPDX-License-Identifier: Apache-2.0
"""`python device.py JOB WORLD SCENE FOLDER DEVICE_TYPE` runs a function of `jobs.py` in a process for each of WORLD
devices, which save their results in FOLDER for the tests to look at."""

import sys
from pathlib import Path

import torch
import torch.distributed as dist
from torch.multiprocessing import start_processes

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "helpers"))

COMMON = {
    "--pipeline.model.num-downscales": 0,
    "--pipeline.model.background-color": "black",
    "--pipeline.model.few-views": "off",
    "--pipeline.model.shrinkage": 0,
    "--pipeline.model.warmup-steps": 0,  # is for one device
    "--pipeline.model.view-noise": 0,  # one device draws other numbers than two
}
PEAK = "splatfacto,opacity_seen=peak,warmup_length=2,refine_every=4,reset_alpha_every=6,densify_grad_thresh=1e-6"
"""Densify every 4th step, reset opacity every 24th."""
PLAIN = {"--pipeline.model.densification": PEAK, "--pipeline.model.shrinkage": 3}
BY_ERROR = {"--pipeline.model.densification": "error-guided,warmup_length=2,refine_every=4,threshold=1e-5"}
RICH = {
    "--pipeline.model.densification": "mcmc,warmup_length=2,refine_every=4",
    "--pipeline.model.rasterize-mode": "antialiased",
    "--pipeline.model.camera-optimizer.mode": "SO3xR3",
}
PIXELS = {**PLAIN, "method": "nrfgs-latent-spec"}
BUSY = {"--pipeline.model.view-noise": 0.5}


def trainer_of(scene: Path, out: Path, world: int, method: str = "nrfgs", **options):
    """A trainer, set up, on `world` devices, of which this process is one."""
    from short_trainings import command_line

    from nrfgs_lab.training_run import parse, set_up

    loud = {"--pipeline.model.appearance.output-init": "default"} if method == "nrfgs" else {}
    return set_up(parse(command_line(method, scene, out, None, COMMON, options, loud)), dist.get_rank(), world)


def precise(trainer) -> None:
    """Go on in float64, with odd training images of another size than the even: 40 x 30 of 48 x 36."""
    torch.set_default_dtype(torch.float64)
    trainer.pipeline.double()
    splats = trainer.pipeline.model.gauss_params
    splats["scales"].data += torch.sin(37.0 * splats["means"].data)  # a round splat has no gradient by its rotation
    data = trainer.pipeline.datamanager
    cameras = data.train_dataset.cameras
    cameras.camera_to_worlds = cameras.camera_to_worlds.double()
    for index in range(1, len(data.cached_train), 2):
        data.cached_train[index]["image"] = data.cached_train[index]["image"][:30, :40]
        cameras.width[index], cameras.height[index] = 40, 30


def one_step(options: dict, scene: Path, folder: Path, name: str, prepare=precise) -> None:
    """A step on two devices, and, on the main one, the same step by one process; by default all in float64."""
    rank, world = dist.get_rank(), dist.get_world_size()
    trainer = trainer_of(scene, folder / name, world, **options)
    prepare(trainer)
    torch.save(step_together(trainer), folder / f"{name}-{rank}.pt")
    torch.set_default_dtype(torch.float32)
    if rank == 0:
        trainer = trainer_of(scene, folder / f"{name}-alone", 1, **options)
        prepare(trainer)
        cameras, _ = trainer.pipeline.datamanager.next_train_views(world, 0)
        torch.save(step_alone(trainer, cameras), folder / f"{name}-alone.pt")
        torch.set_default_dtype(torch.float32)
    dist.barrier()


def step_together(trainer) -> dict:
    from nrfgs_ns.distributed import comm

    pipeline, model = trainer.pipeline, trainer.pipeline.model
    model.step_cb(trainer.optimizers, 0)
    outputs, losses, _ = pipeline.get_train_loss_dict(0)
    (sum(losses.values()) / comm.world()).backward()
    shared = [value.grad for name, value in pipeline.named_parameters() if "gauss_params" not in name]
    comm.sum_over_devices([gradient for gradient in shared if gradient is not None])
    return {
        "rgb": outputs["rgb"].detach(),
        "losses": {key: value.detach() for key, value in losses.items()},
        "statistics": statistics(model, model._screen_info()),
        **values_and_gradients(pipeline),
    }


def step_alone(trainer, cameras) -> dict:
    """The same cameras one after the other; gradients of the mean of their losses, statistics of each by itself."""
    pipeline, model = trainer.pipeline, trainer.pipeline.model
    model.step_cb(trainer.optimizers, 0)
    images, all_losses, stats = [], [], {}
    for camera in cameras:
        outputs = model(camera)
        losses = model.get_loss_dict(outputs, pipeline.datamanager.train_view(camera.metadata["cam_idx"])[1], {})
        before = {name: value.grad for name, value in pipeline.named_parameters()}
        pipeline.zero_grad()
        sum(losses.values()).backward()
        stats = statistics(model, model.info)
        for name, value in pipeline.named_parameters():
            if value.grad is not None:
                value.grad = value.grad / len(cameras) + (0 if before[name] is None else before[name])
            else:
                value.grad = before[name]
        images.append(outputs["rgb"].detach())
        all_losses.append({key: value.detach() for key, value in losses.items()})
    return {"rgb": images, "losses": all_losses, "statistics": stats} | values_and_gradients(pipeline)


def values_and_gradients(pipeline) -> dict:
    splats = pipeline.model.gauss_params
    return {
        "splats": {key: value.detach() for key, value in splats.items()},
        "gradients": {key: value.grad for key, value in splats.items()},
        "shared": {name: value.grad for name, value in pipeline.named_parameters() if "gauss_params" not in name},
    }


def statistics(model, info) -> dict:
    from nrfgs_ns.densification.gradient import GradientDensification

    rules = model.densification
    rules.take_changes(info, model.num_points)
    if isinstance(rules, GradientDensification):
        rules._update_statistics(info, model.num_points)
    return {key: value.clone() for key, value in rules.state.items() if isinstance(value, torch.Tensor)}


def train(scene: Path, out: Path, world: int, steps: int, load: Path | None = None, watch=None, **options):
    """The trainer after some steps, from a folder of checkpoints; `watch` is called with it before it trains."""
    more = {"--max-num-iterations": steps, **BUSY, **options, **({"--load-dir": load} if load else {})}
    trainer = trainer_of(scene, out, world, **more)
    if watch is not None:
        watch(trainer)
    trainer.train()
    return trainer


def told(trainer) -> Path:
    """The main device's folder of checkpoints, on all: each has a time stamp of its own."""
    box = [trainer and trainer.checkpoint_dir]
    dist.broadcast_object_list(box)
    return box[0]


def work(rank: int, job: str, world: int, scene: Path, folder: Path, device_type: str) -> None:
    """What one process does."""
    import device
    import jobs
    from processes import keep_what_is_imported, let_go

    from nrfgs_lab.many_processes import join_group

    torch.set_num_threads(1)
    device.COMMON["--machine.device-type"] = device_type  # what `jobs` reads; this file runs as another module
    join_group(rank, world, f"file://{folder / 'meeting'}", device_type)
    keep_what_is_imported()
    getattr(jobs, job)(scene, folder)
    let_go()
    dist.barrier()
    dist.destroy_process_group()


if __name__ == "__main__":
    job, world, scene, folder, device_type = sys.argv[1:]
    if device_type == "cpu":
        import jobs  # noqa: F401  (once for all processes: they are forked)
    given = (job, int(world), Path(scene), Path(folder), device_type)
    start_processes(work, given, nprocs=int(world), start_method="fork" if device_type == "cpu" else "spawn")
