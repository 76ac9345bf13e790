# SPDX-License-Identifier: Apache-2.0
"""Seconds from a command to a picture that is worth looking at, and what they are spent on.

    python -m nrfgs_lab.timing.first_sight RECORD.json --targets 30 31.7 -- nrfgs --data SCENE --vis tensorboard

starts `ns-train` with the words behind the dashes in a process of its own, and tells when it has imported, read the
images, made its first step, and when the mean PSNR of all test views has reached each target. Looking costs time, which
is not counted; it is done twice a second (--every). The training ends with the last target, unless it is to go on
(--whole); of one that comes to its end, the end is told, too.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from nrfgs_ns.files import write_whole

BEGAN, RECORD, TARGETS, WHOLE, EVERY = (f"NRFGS_{name}" for name in ("BEGAN", "RECORD", "TARGETS", "WHOLE", "EVERY"))
"""What the process is told by its environment."""


class Clock:
    """Seconds since the command was given, without those that were spent on looking."""

    def __init__(self, began: float):
        self.began, self.looked = began, 0.0
        self.stages: dict[str, float] = {}

    def now(self) -> float:
        return time.time() - self.began - self.looked

    def after(self, owner: Any, name: str, stage: str) -> None:
        """Note when a function has returned for the first time."""
        original = getattr(owner, name)

        def noted(*args: Any, **kwargs: Any) -> Any:
            result = original(*args, **kwargs)
            self.stages.setdefault(stage, round(self.now(), 3))
            return result

        setattr(owner, name, noted)


def child() -> None:
    """`ns-train` with the words of this process's command line, watched."""
    clock = Clock(float(os.environ[BEGAN]))
    from nerfstudio.scripts import train

    clock.stages["imported"] = round(clock.now(), 3)
    import torch

    from nrfgs_ns.data.datamanager import NrfgsDatamanager
    from nrfgs_ns.image.metrics import psnr
    from nrfgs_ns.training import pipeline
    from nrfgs_ns.training.run import machine
    from nrfgs_ns.training.trainer import NrfgsTrainer

    whole, every = os.environ[WHOLE] == "True", float(os.environ[EVERY])
    targets = [float(word) for word in os.environ[TARGETS].split()]
    reached: dict[str, Any] = {}
    curve: list[list[float]] = []
    end: dict[str, Any] = {}
    last = [0.0]
    clock.after(NrfgsDatamanager, "__init__", "data set checked")
    clock.after(pipeline.VanillaPipeline, "__init__", "model made")
    clock.after(NrfgsDatamanager, "load_all_images", "images read")
    clock.after(pipeline, "photograph_model", "photographs compared")
    clock.after(NrfgsTrainer, "setup", "set up")
    step_of = NrfgsTrainer.train_iteration

    def train_iteration(self: NrfgsTrainer, step: int) -> Any:
        result = step_of(self, step)
        if step in (0, 1, 10):
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            clock.stages[f"step {step}"] = round(clock.now(), 3)
        return result

    def look(self: NrfgsTrainer, step: int) -> None:
        if clock.now() - last[0] >= every and len(reached) < len(targets):
            found = measure(self, step)
            curve.append([found["seconds"], found["steps"], round(found["psnr"], 3)])
        if len(reached) == len(targets) and not whole:
            self.stop_training = True

    def measure(self: NrfgsTrainer, step: int) -> dict[str, float]:
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        start = last[0] = clock.now()
        model, data = self.pipeline.model, self.pipeline.datamanager
        self.pipeline.eval()
        values = []
        with torch.no_grad():
            for camera, batch in data.fixed_indices_eval_dataloader:
                outputs = model.get_outputs_for_camera(camera)
                truth = model.truth_of(batch, outputs["background"])
                values.append(psnr(outputs["rgb"], truth, model.mask_of(batch)))
        self.pipeline.train()
        known = [value for value in values if value is not None]
        mean = sum(known) / len(known)
        found = {"seconds": round(start, 3), "steps": step + 1, "psnr": mean}
        for target in targets:
            if mean >= target:
                reached.setdefault(f"{target:g}", found)
        clock.looked += clock.now() - start
        write_whole(Path(os.environ[RECORD]), json.dumps(content()))
        return found

    def content() -> dict[str, Any]:
        peak = torch.cuda.max_memory_allocated() if torch.cuda.is_available() else None
        return {
            "machine": machine(),
            "stages": clock.stages,
            "reached": reached,
            "curve": curve,
            "end": end,
            "seconds_of_looking": round(clock.looked, 2),
            "peak_host_bytes": 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
            "peak_device_bytes": peak,
        }

    mean_of = NrfgsTrainer.take_the_mean

    def take_the_mean(self: NrfgsTrainer) -> None:
        mean_of(self)
        end.update(measure(self, self._made), splats=self.pipeline.model.num_points)

    def save_checkpoint(self: NrfgsTrainer, step: int) -> None:
        pass  # what is measured ends before the first one that counts

    eval_of = NrfgsTrainer.eval_iteration

    def eval_iteration(self: NrfgsTrainer, step: int) -> None:
        eval_of(self, step)
        look(self, step)

    NrfgsTrainer.train_iteration, NrfgsTrainer.eval_iteration = train_iteration, eval_iteration
    NrfgsTrainer.take_the_mean = take_the_mean
    if not whole:
        NrfgsTrainer.save_checkpoint = save_checkpoint
    train.entrypoint()
    write_whole(Path(os.environ[RECORD]), json.dumps(content()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("record", type=Path, help="JSON to write")
    parser.add_argument("--targets", type=float, nargs="+", default=[30.0], help="dB")
    parser.add_argument("--every", type=float, default=0.5, help="seconds of training between two looks")
    parser.add_argument("--whole", action="store_true", help="train on when the last target is reached")
    parser.add_argument("words", nargs="+", help="of ns-train, after --")
    options = parser.parse_args()
    code = "from nrfgs_lab.timing.first_sight import child; child()"
    environment = {
        **os.environ,
        BEGAN: repr(time.time()),
        RECORD: str(options.record.absolute()),
        TARGETS: " ".join(map(str, options.targets)),
        WHOLE: str(options.whole),
        EVERY: str(options.every),
    }
    options.record.parent.mkdir(parents=True, exist_ok=True)
    subprocess.run([sys.executable, "-c", code, *options.words], env=environment, check=True)
    found = {"args": options.words, **json.loads(options.record.read_text(encoding="utf-8"))}
    write_whole(options.record, json.dumps(found, indent=1) + "\n")
    print(json.dumps({name: found[name] for name in ("stages", "reached", "end")}, indent=1))


if __name__ == "__main__":
    main()
