# SPDX-License-Identifier: Apache-2.0
"""Memory and images per second of one scene on several GPUs.

    python -m nrfgs_lab.timing.many_gpus --scene SCENES/bonsai --splats 4000000 --out load.json

Trains from random splats with densification off, at full resolution, on each number of devices in turn. The file is
written after each run; a run in it is not repeated. With `--device-type cpu` the same on gloo and the CPU rasterizer.
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
from nrfgs_lab.training_run import machine, parse
from nrfgs_ns.distributed.launch import free_port, join_group
from nrfgs_ns.files import write_whole
from nrfgs_ns.model import initial_splats


@dataclass
class Load:
    """Peak memory and images per second at a given number of splats."""

    scene: Path
    """folder of a data set in nerfstudio's layout"""
    out: Path
    """JSON file of the results"""
    devices: tuple[int, ...] = (1, 2)
    """numbers of devices"""
    method: str = "nrfgs"
    """method of ns-train"""
    options: str = ""
    """more options of ns-train"""
    device_type: Literal["cuda", "cpu"] = "cuda"
    """cpu: to try the command"""
    splats: tuple[int, ...] = (4_000_000,)
    """numbers of splats"""
    extent: float = 2.0
    """side of the cube that the splats fill, in scene units; the cameras lie within [-1, 1]"""
    warm: int = 50
    """steps before the clock starts"""
    steps: int = 200
    """steps on the clock"""
    rounds: int = 2
    """turns of each number of devices"""

    def main(self) -> None:
        runs = json.loads(self.out.read_text())["runs"] if self.out.exists() else []
        for turn in range(self.rounds):
            for count in self.splats:
                for world in self.devices:
                    key = {"method": self.method, "options": self.options, "splats": count}
                    key |= {"devices": world, "round": turn, "steps": self.steps}
                    if any(all(run.get(name) == value for name, value in key.items()) for run in runs):
                        continue
                    with tempfile.TemporaryDirectory() as folder:
                        url = f"tcp://127.0.0.1:{free_port()}"
                        mp.spawn(one_device, args=(self, count, world, url, folder), nprocs=world)
                        parts = [json.loads(Path(folder, f"{rank}.json").read_text()) for rank in range(world)]
                    seconds = max(part["seconds"] for part in parts)
                    speed = {"images_per_second": world * self.steps / seconds, "step_ms": 1000 * seconds / self.steps}
                    peaks = ("peak_memory_bytes", "peak_memory_setup_bytes")
                    runs.append({**key, **speed, **{peak: [part[peak] for part in parts] for peak in peaks}})
                    content = {"machine": machine(), "scene": self.scene.name, "runs": runs}
                    write_whole(self.out, json.dumps(content, indent=1) + "\n")
                    print(runs[-1], flush=True)


def one_device(rank: int, load: Load, count: int, world: int, url: str, folder: str) -> None:
    """Train in one process of `Load`, and write FOLDER/RANK.json."""
    if world > 1:
        join_group(rank, world, url, load.device_type)
    options = {
        "--data": load.scene,
        "--output-dir": folder,
        "--machine.device-type": load.device_type,
        "--max-num-iterations": load.warm + load.steps + 1,
        "--steps-per-save": 10**9,
        "--pipeline.model.random-init": True,
        "--pipeline.model.num-random": count,
        "--pipeline.model.random-scale": load.extent,
        "--pipeline.model.densification": "splatfacto,stop_split_at=0",
        "--pipeline.model.num-downscales": 0,
        "--pipeline.model.warmup-steps": 0,
    }
    words = [str(word) for option in options.items() for word in option]
    config = parse([load.method, *QUIET, *words, *shlex.split(load.options)])
    torch.manual_seed(config.machine.seed)
    # The spacing of a grid: the search for the neighbours of millions takes longer than the measurement.
    initial_splats.mean_distance = lambda means: means.new_full((len(means), 1), load.extent / count ** (1 / 3))
    trainer = config.setup(local_rank=rank, world_size=world)
    trainer.setup()
    measured: dict[str, Any] = {}

    def before(step: int) -> None:
        if step == load.warm:
            together(world)
            measured["peak_memory_setup_bytes"] = peak_memory()
            if torch.cuda.is_available():
                torch.cuda.reset_peak_memory_stats()
            measured["start"] = perf_counter()
        if step == load.warm + load.steps:
            together(world)
            measured["seconds"] = perf_counter() - measured.pop("start")
            measured["peak_memory_bytes"] = peak_memory()
            Path(folder, f"{rank}.json").write_text(json.dumps(measured))

    trainer.callbacks.insert(0, TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], before))
    trainer.save_checkpoint = lambda step: None
    trainer.train()
    if world > 1:
        dist.destroy_process_group()


def together(world: int) -> None:
    """Wait until all devices are idle."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    if world > 1:
        dist.barrier()


def peak_memory() -> int:
    """Largest number of bytes in tensors on this GPU since the last reset; 0 on a CPU."""
    return torch.cuda.max_memory_allocated() if torch.cuda.is_available() else 0


if __name__ == "__main__":
    tyro.cli(Load).main()
