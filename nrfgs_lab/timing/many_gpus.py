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
from typing import Literal

import torch.distributed as dist
import torch.multiprocessing as mp
import tyro
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation

from nrfgs_lab.bench.spec import QUIET
from nrfgs_lab.many_processes import join_group
from nrfgs_lab.timing.scale import WARM, Stopwatch
from nrfgs_lab.training_run import machine, parse, set_up, synchronize
from nrfgs_ns.files import write_whole
from nrfgs_ns.model import initial_splats

EXTENT = 2.0  # Side of the cube that the splats fill, in scene units; the cameras lie within [-1, 1].
STEPS = 200  # On the clock.


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
                mp.spawn(one_device, args=(self, world, folder), nprocs=world)
                parts = [json.loads(Path(folder, f"{rank}.json").read_text()) for rank in range(world)]
            step_ms, peaks = max(ms for ms, _ in parts), [peak for _, peak in parts]
            run = {"options": self.options, "splats": self.splats, "devices": world, "steps": STEPS}
            run |= {"images_per_second": 1000 * world / step_ms, "step_ms": step_ms, "peak_memory_bytes": peaks}
            runs.append(run)
            print(runs[-1], flush=True)
        content = {"machine": machine(), "scene": self.scene.name, "runs": runs}
        write_whole(self.out, json.dumps(content, indent=1) + "\n")


def one_device(rank: int, load: Load, world: int, folder: str) -> None:
    """Train in one process of `Load`, and write FOLDER/RANK.json: milliseconds of a step, peak memory in bytes."""
    if world > 1:
        join_group(rank, world, f"file://{folder}/meeting", load.device_type)
    watch = Stopwatch(STEPS)
    options = {
        "--data": load.scene,
        "--output-dir": folder,
        "--machine.device-type": load.device_type,
        "--max-num-iterations": watch.steps,
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
    # The spacing of a grid: the search for the neighbours of millions takes longer than the measurement.
    initial_splats.mean_distance = lambda means: means.new_full((len(means), 1), EXTENT / load.splats ** (1 / 3))
    trainer = set_up(config, rank, world)

    def before(step: int) -> None:
        if world > 1 and step in (WARM, watch.end):
            synchronize()
            dist.barrier()
        watch.before(step)

    trainer.callbacks.insert(0, TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], before))
    trainer.save_checkpoint = lambda step: None
    trainer.train()
    Path(folder, f"{rank}.json").write_text(json.dumps([watch.step_ms, watch.peak_bytes]))
    if world > 1:
        dist.destroy_process_group()


if __name__ == "__main__":
    tyro.cli(Load).main()
