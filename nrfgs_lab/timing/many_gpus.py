# SPDX-License-Identifier: Apache-2.0
"""What several GPUs are worth on one scene: memory, images per second, and the same quality from as many images.

    python -m nrfgs_lab.timing.many_gpus load --scene SCENES/bonsai --splats 4000000 \
        --out load.json
    python -m nrfgs_lab.timing.many_gpus quality --scene SCENES/bonsai --out quality.json

`load` trains from random splats with densification off, at full resolution, on each number of devices in turn, and
notes each device's peak memory and the images per second. `quality` runs `ns-train` with
`--pipeline.sharding.schedules images`, and then `ns-eval`. Both write after each run and do not repeat what is there.
With `--device-type cpu` the same runs on gloo and the CPU rasterizer, to try it out.
"""

import json
import shlex
import subprocess
import sys
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

from nrfgs_ns.distributed.launch import free_port, join_group
from nrfgs_ns.model import initial_splats
from nrfgs_ns.training.run import evaluate, machine, parse

QUIET = {
    "--vis": "tensorboard",
    "--logging.local-writer.enable": "False",
    "--logging.profiler": "none",
    "--steps-per-eval-image": "0",
    "--steps-per-eval-all-images": "0",
}


@dataclass
class Common:
    """What both have."""

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
    """cpu: to try it out"""

    def read(self) -> list[dict[str, Any]]:
        """The runs that are there."""
        return json.loads(self.out.read_text())["runs"] if self.out.exists() else []

    def write(self, runs: list[dict[str, Any]]) -> None:
        self.out.parent.mkdir(parents=True, exist_ok=True)
        self.out.write_text(json.dumps({"machine": machine(), "scene": self.scene.name, "runs": runs}, indent=1) + "\n")

    def base(self) -> dict[str, Any]:
        """What tells a run from others."""
        return {"method": self.method, "options": self.options}


@dataclass
class Load(Common):
    """Peak memory and images per second at a given number of splats."""

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
        runs = self.read()
        for turn in range(self.rounds):
            for count in self.splats:
                for world in self.devices:
                    key = {**self.base(), "splats": count, "devices": world, "round": turn, "steps": self.steps}
                    if any(all(run.get(name) == value for name, value in key.items()) for run in runs):
                        continue
                    with tempfile.TemporaryDirectory() as folder:
                        url = f"tcp://127.0.0.1:{free_port()}"
                        mp.spawn(one_device, args=(self, count, world, url, folder), nprocs=world)
                        parts = [json.loads(Path(folder, f"{rank}.json").read_text()) for rank in range(world)]
                    seconds = max(part["seconds"] for part in parts)
                    runs.append(
                        {
                            **key,
                            "images_per_second": world * self.steps / seconds,
                            "step_ms": 1000 * seconds / self.steps,
                            "peak_memory_bytes": [part["peak_memory_bytes"] for part in parts],
                            "peak_memory_setup_bytes": [part["peak_memory_setup_bytes"] for part in parts],
                        }
                    )
                    self.write(runs)
        for run in runs:
            peak = max(run["peak_memory_bytes"]) / 2**30
            print(
                f"{run['splats']:,} splats, {run['devices']} devices: {run['images_per_second']:.1f} images/s, "
                f"peak {peak:.2f} GiB"
            )


def one_device(rank: int, load: Load, count: int, world: int, url: str, folder: str) -> None:
    """One process of `Load`: trains, and leaves what it measured in FOLDER/RANK.json."""
    if world > 1:
        join_group(rank, world, url, load.device_type)
    options = {
        **QUIET,
        "--data": load.scene,
        "--output-dir": folder,
        "--machine.device-type": load.device_type,
        "--max-num-iterations": load.warm + load.steps + 1,
        "--steps-per-save": 10**9,
        "--pipeline.model.random-init": True,
        "--pipeline.model.num-random": count,
        "--pipeline.model.random-scale": load.extent,
        "--pipeline.model.stop-split-at": 0,
        "--pipeline.model.num-downscales": 0,
        "--pipeline.model.warmup-steps": 0,
    }
    words = [str(word) for option in options.items() for word in option]
    config = parse([load.method, *words, *shlex.split(load.options)])
    torch.manual_seed(config.machine.seed)
    # Splats as wide as a grid of as many is fine: to look for the neighbours of millions takes longer than to measure.
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
    """Wait until all devices have finished what they were asked."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    if world > 1:
        dist.barrier()


def peak_memory() -> int:
    """Most bytes in tensors on this GPU since the last reset; 0 on a CPU."""
    return torch.cuda.max_memory_allocated() if torch.cuda.is_available() else 0


@dataclass
class Quality(Common):
    """PSNR after as many images, on each number of devices."""

    steps: int = 30_000
    """images in all; on W devices, 1 / W as many steps"""
    seeds: tuple[int, ...] = (42,)
    """--machine.seed of each repetition"""
    work: Path = Path("outputs/many-gpus")
    """folder for checkpoints"""

    def main(self) -> None:
        runs = self.read()
        for seed in self.seeds:
            for world in self.devices:
                key = {**self.base(), "images": self.steps, "devices": world, "seed": seed}
                if any(all(run.get(name) == value for name, value in key.items()) for run in runs):
                    continue
                runs.append({**key, **self.run(world, seed)})
                self.write(runs)
        for run in runs:
            print(
                f"{run['devices']} devices, seed {run['seed']}: PSNR {run['psnr']:.2f}, SSIM {run['ssim']:.4f}, "
                f"{run['splats']:,} splats, {run['wall_seconds']:.0f} s"
            )

    def run(self, world: int, seed: int) -> dict[str, Any]:
        """One `ns-train` and one `ns-eval`."""
        folder = self.work / f"{self.method}-{world}-{seed}"
        options = {
            **QUIET,
            "--data": self.scene,
            "--output-dir": folder,
            "--timestamp": "run",
            "--machine.seed": seed,
            "--machine.device-type": self.device_type,
            "--machine.num-devices": world,
            "--max-num-iterations": self.steps,
            "--pipeline.sharding.schedules": "images",
        }
        several_cpus = self.device_type == "cpu" and world > 1
        program = "nrfgs_ns.distributed.launch" if several_cpus else "nerfstudio.scripts.train"
        words = [str(word) for option in options.items() for word in option]
        start = perf_counter()
        subprocess.run([sys.executable, "-m", program, self.method, *words, *shlex.split(self.options)], check=True)
        seconds = perf_counter() - start
        (config,) = folder.rglob("run/config.yml")
        results = evaluate(config, folder / "eval.json")
        names = ("psnr", "ssim", "l1", "splats", "parameter_bytes")
        return {"wall_seconds": seconds, **{name: results[name] for name in names}}


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict({"load": Load, "quality": Quality}, description=__doc__).main()
