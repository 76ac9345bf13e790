# SPDX-License-Identifier: Apache-2.0
"""Memory and images per second of one scene on several GPUs.

    python -m nrfgs_lab.timing.many_gpus --scene SCENES/bonsai --splats 4000000 --out load.json

Trains from random splats with densification off, at full resolution, on each number of devices in turn. With
`--device-type cpu` the same on gloo and the CPU rasterizer, to try the command.
"""

import json
import shlex
import tempfile
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

import torch
import torch.distributed as dist
import torch.multiprocessing as mp
import tyro
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation

from nrfgs_lab.bench.spec import QUIET
from nrfgs_lab.many_processes import free_port, join_group
from nrfgs_lab.training_run import machine, parse, synchronize
from nrfgs_ns.files import write_whole
from nrfgs_ns.model import initial_splats

EXTENT = 2.0  # Side of the cube that the splats fill, in scene units; the cameras lie within [-1, 1].
WARM, STEPS = 50, 200  # Steps before the clock starts, and on it.


@dataclass
class Load:
    """Peak memory and images per second at a given number of splats."""

    scene: Path  # folder of a data set in nerfstudio's layout
    out: Path  # JSON file of the results
    devices: tuple[int, ...] = (1, 2)  # numbers of devices
    options: str = ""  # more options of ns-train
    device_type: Literal["cuda", "cpu"] = "cuda"
    splats: int = 4_000_000

    def main(self) -> None:
        runs = []
        for world in self.devices:
            with tempfile.TemporaryDirectory() as folder:
                url = f"tcp://127.0.0.1:{free_port()}"
                mp.spawn(one_device, args=(self, world, url, folder), nprocs=world)
                parts = [json.loads(Path(folder, f"{rank}.json").read_text()) for rank in range(world)]
            seconds = max(part["seconds"] for part in parts)
            run = {"options": self.options, "splats": self.splats, "devices": world, "steps": STEPS}
            run |= {"images_per_second": world * STEPS / seconds, "step_ms": 1000 * seconds / STEPS}
            runs.append({**run, "peak_memory_bytes": [part["peak_memory_bytes"] for part in parts]})
            print(runs[-1], flush=True)
        content = {"machine": machine(), "scene": self.scene.name, "runs": runs}
        write_whole(self.out, json.dumps(content, indent=1) + "\n")


def one_device(rank: int, load: Load, world: int, url: str, folder: str) -> None:
    """Train in one process of `Load`, and write FOLDER/RANK.json."""
    if world > 1:
        join_group(rank, world, url, load.device_type)
    options = {
        "--data": load.scene,
        "--output-dir": folder,
        "--machine.device-type": load.device_type,
        "--max-num-iterations": WARM + STEPS + 1,
        "--steps-per-save": 10**9,
        "--pipeline.model.random-init": True,
        "--pipeline.model.num-random": load.splats,
        "--pipeline.model.random-scale": EXTENT,
        "--pipeline.model.densification": "splatfacto,stop_split_at=0",
        "--pipeline.model.num-downscales": 0,
        "--pipeline.model.warmup-steps": 0,
    }
    words = [str(word) for option in options.items() for word in option]
    config = parse(["nrfgs", *QUIET, *words, *shlex.split(load.options)])
    torch.manual_seed(config.machine.seed)
    # The spacing of a grid: the search for the neighbours of millions takes longer than the measurement.
    initial_splats.mean_distance = lambda means: means.new_full((len(means), 1), EXTENT / load.splats ** (1 / 3))
    trainer = config.setup(local_rank=rank, world_size=world)
    trainer.setup()
    measured: dict[str, Any] = {}

    def before(step: int) -> None:
        if step == WARM:
            together(world)
            if torch.cuda.is_available():
                torch.cuda.reset_peak_memory_stats()
            measured["start"] = perf_counter()
        if step == WARM + STEPS:
            together(world)
            measured["seconds"] = perf_counter() - measured.pop("start")
            measured["peak_memory_bytes"] = torch.cuda.max_memory_allocated() if torch.cuda.is_available() else 0
            Path(folder, f"{rank}.json").write_text(json.dumps(measured))

    trainer.callbacks.insert(0, TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], before))
    trainer.save_checkpoint = lambda step: None
    trainer.train()
    if world > 1:
        dist.destroy_process_group()


def together(world: int) -> None:
    """Wait until all devices are idle."""
    synchronize()
    if world > 1:
        dist.barrier()


if __name__ == "__main__":
    tyro.cli(Load).main()
