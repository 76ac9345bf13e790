# SPDX-License-Identifier: Apache-2.0
"""Many trainings in few processes, several to a GPU: for quality, where seconds do not count.

    python -m nrfgs_lab.trials PLAN.yaml SCENES OUT.jsonl [--seconds 600] [--workers 6] [--gpus 1]

A plan is a list, what is worth most first; each entry is trained on each of its scenes with each of its seeds:

    - {name: nrfgs, method: nrfgs, scenes: [fern, fox], seeds: [42, 43]}
    - {name: harmonics, method: nrfgs-sh, options: --schedule-steps 30000, steps: 10000, scenes: [fern]}

A scene is a folder below SCENES, or one of its files (fern/dev0.json), which every method reads alike (nrfgs-data).
OUT.jsonl gets a line for each training: its entry, PSNR, SSIM, MS-SSIM and FLIP (where `flip-evaluator` is installed)
of each test view, and what eight training views have. What OUT.jsonl has is not repeated; what does not fit into the
seconds is left for another call.
`nrfgs bench` takes times, goes on where it was stopped, and makes tables; it starts Python for each training.
"""

import gc
import json
import multiprocessing
import os
import queue
import shutil
import tempfile
import time
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import tyro
import yaml

from nrfgs_lab.bench.command import gpu_names
from nrfgs_ns.errors import InputError

TRAIN_VIEWS = 8
QUIET = (
    *("--vis", "tensorboard", "--logging.local-writer.enable", "False", "--logging.profiler", "none"),
    *("--steps-per-eval-image", "100000000", "--steps-per-eval-all-images", "100000000"),
)
CHECKED_EVERY = 500
"""Steps between two looks at the clock."""
SURE = 0.8
"""Share of what a training would take, as things look, that must fit into what is left."""


@dataclass(frozen=True)
class Trial:
    """One training."""

    name: str
    method: str
    scene: str
    seed: int = 42
    steps: int | None = None
    """None: the method's own"""
    options: str = ""

    @property
    def key(self) -> tuple:
        return self.name, self.scene, self.seed


@dataclass
class Trials:
    """Train what a plan lists, several trainings at once on each GPU."""

    plan: Annotated[Path, tyro.conf.Positional]
    """YAML file"""
    scenes: Annotated[Path, tyro.conf.Positional]
    """folder of the captures"""
    out: Annotated[Path, tyro.conf.Positional]
    """file that gets a line for each training"""
    seconds: float = 1e9
    """after which nothing runs"""
    workers: int = 1
    """trainings at once on each GPU, or on the CPU"""
    gpus: int = 1
    """how many to use"""

    def main(self) -> None:
        end = time.time() + self.seconds
        done = {tuple(one[part] for part in ("name", "scene", "seed")) for one in read(self.out)}
        context = multiprocessing.get_context("spawn")
        waiting, results = context.Queue(), context.Queue()
        for trial in read_plan(self.plan):
            if trial.key not in done:
                waiting.put(trial)
        slots, processes = [gpu for _ in range(self.workers) for gpu in gpu_names(self.gpus)], []
        os.environ.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // len(slots))))
        for gpu in slots:
            # A new process reads it before it looks for a GPU.
            os.environ["CUDA_VISIBLE_DEVICES"] = gpu
            processes.append(
                context.Process(target=quiet_worker, args=(waiting, results, self.scenes, end), daemon=True)
            )
            processes[-1].start()
        while any(process.is_alive() for process in processes) or not results.empty():
            try:
                trial, found = results.get(timeout=1.0)
            except queue.Empty:
                continue
            if "left" not in found:
                with self.out.open("a", encoding="utf-8") as file:
                    file.write(json.dumps({**asdict(trial), **found}) + "\n")
            summary = found.get("left") or f"{found['psnr']:.2f} dB, {found['ssim']:.4f}, {found['splats']:,} splats"
            print(*trial.key, summary, flush=True)


def read(file: Path) -> list[dict[str, Any]]:
    """The records of a file; none if it is not there."""
    return [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()] if file.exists() else []


def read_plan(file: Path) -> list[Trial]:
    """The trainings of a plan, in its order.

    Raises:
        InputError: an entry lacks something, or has something unknown.
    """
    entries = yaml.safe_load(file.read_text(encoding="utf-8"))
    trials = []
    for entry in entries if isinstance(entries, list) else [entries]:
        try:
            entry = dict(entry)
            scenes, seeds = entry.pop("scenes"), entry.pop("seeds", [42])
            trials += [Trial(**entry, scene=scene, seed=seed) for seed in seeds for scene in scenes]
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(
                f"{file}: {entry} is no entry of a plan ({error}). Each needs name, method and scenes, and may have "
                "seeds, steps and options."
            ) from error
    return trials


def quiet_worker(*args: Any) -> None:
    """`work`, as all that a process does."""
    from nerfstudio.utils.rich_utils import CONSOLE

    CONSOLE.quiet = True
    work(*args)


def work(waiting, results, scenes: Path, end: float) -> None:
    """Take trials from the queue `waiting` until `end` (of time.time()), and put pairs of a trial and its record into
    `results`, or {"left": why} of what was not done.
    """
    import torch

    while True:
        try:
            trial = waiting.get(timeout=1.0)
        except queue.Empty:
            return
        if time.time() > end:
            results.put((trial, {"left": "no time"}))
            continue
        folder = tempfile.mkdtemp()
        try:
            results.put((trial, train_and_measure(trial, scenes, Path(folder), end)))
        except Exception as error:  # one that fails must not end the others
            results.put((trial, {"left": f"{type(error).__name__}: {error}"}))
        finally:
            shutil.rmtree(folder, ignore_errors=True)
            gc.collect()
            torch.cuda.empty_cache()


def train_and_measure(trial: Trial, scenes: Path, folder: Path, end: float) -> dict[str, Any]:
    """Train as `ns-train` does, and look at test views and training views; nothing is kept in `folder`.

    Raises:
        TimeoutError: it would not have ended in time.
    """
    import torch
    from nerfstudio.scripts.train import _set_random_seed

    from nrfgs_lab.bench.measure import over_views
    from nrfgs_lab.flip import flip
    from nrfgs_lab.run import host_without_downloads
    from nrfgs_ns.data.views import evenly_spaced
    from nrfgs_ns.training.run import machine, parse

    steps = [] if trial.steps is None else ["--max-num-iterations", str(trial.steps)]
    paths = ["--data", str(scenes / trial.scene), "--output-dir", str(folder)]
    seed = ["--machine.seed", str(trial.seed)]
    with host_without_downloads(trial.method):
        config = parse([trial.method, *paths, *QUIET, *seed, *steps, *trial.options.split(), "nrfgs-data"])
        _set_random_seed(config.machine.seed)
        trainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        trainer.save_checkpoint = lambda step: None
        iteration, looked = trainer.train_iteration, {}

        def in_time(step: int):
            if step % CHECKED_EVERY == 0:
                now, left = time.time(), trainer.config.max_num_iterations - step
                looked[step] = now
                done = step - CHECKED_EVERY  # the first steps compile
                rate = (now - looked[CHECKED_EVERY]) / done if done > 0 else 0.0
                if now + SURE * rate * left > end:
                    raise TimeoutError(f"no time after {step} steps")
            return iteration(step)

        trainer.train_iteration = in_time
        trainer.train()
        model, loader = trainer.pipeline.model.eval(), trainer.pipeline.datamanager
        names = [Path(name).name for name in loader.eval_dataset.image_filenames]
        with torch.no_grad():
            views = zip(names, loader.fixed_indices_eval_dataloader, strict=True)
            test = over_views(model, views, flip if find_spec("flip_evaluator") else None)
            images, cameras = loader.cached_train, loader.train_dataset.cameras
            chosen = evenly_spaced(len(images), TRAIN_VIEWS)
            learnt = ((str(i), (cameras[i : i + 1].to(model.device), images[i])) for i in chosen)
            train = over_views(model, learnt)
    shown = ("psnr", "ssim", "ms_ssim")
    return {
        **{metric: test[metric] for metric in shown},
        **{f"train_{metric}": train[metric] for metric in shown[:2]},
        "flip": [view.get("flip") for view in test["per_image"]],
        "per_image": [[view["image"], *(view[metric] for metric in shown)] for view in test["per_image"]],
        "splats": int(model.num_points),
        "made_steps": trainer.step + 1,
        "machine": machine(),
    }


if __name__ == "__main__":
    tyro.cli(Trials).main()
