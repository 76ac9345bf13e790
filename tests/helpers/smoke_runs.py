# SPDX-License-Identifier: Apache-2.0
"""What short trainings reach, from which the bounds of the tests follow that train so.

    OMP_NUM_THREADS=1 python tests/helpers/smoke_runs.py SCENES WORK      # SCENES holds fox and kitchen

writes results/smoke.json: for each case the PSNR of trainings with several seeds, and that after one step.
"""

import json
import sys
from functools import cache
from pathlib import Path
from statistics import stdev
from typing import Any

FILE = Path(__file__).resolve().parents[2] / "results" / "smoke.json"
METHODS = "nrfgs", "nrfgs-sh", "nrfgs-vdgs", "nrfgs-gsnb", "nrfgs-sg"
STEPS = 300
PLAIN = {
    "--pipeline.model.num-downscales": 0,
    "--pipeline.model.few-views": "off",
    "--pipeline.model.shrinkage": 0,
}
SMALL = {**PLAIN, "--pipeline.datamanager.camera-res-scale-factor": 0.125}
"""Options of the cases on real captures."""


def cases() -> dict[str, tuple[str, str, dict[str, Any], tuple[int, ...]]]:
    """Name -> method, data set ("tiny": of ten procedural views), options and seeds."""
    found = {f"tiny/{method}": (method, "tiny", PLAIN, (42, 43, 44)) for method in METHODS}
    for scene in ("fox", "kitchen"):
        found |= {f"{scene}/{method}": (method, scene, SMALL, (42, 43)) for method in ("nrfgs", "nrfgs-sh")}
    return found


@cache
def recorded() -> dict[str, dict[str, Any]]:
    """Case -> "psnr" of its trainings by seed, and "after_one_step", which learns nothing."""
    return json.loads(FILE.read_text(encoding="utf-8"))["records"]


def bound(case: str) -> float:
    """PSNR that a training of the case must exceed: four deviations below the least of those recorded.

    The deviation is over seeds, the largest of the cases on the same data set.
    """
    group = [one for name, one in recorded().items() if name.split("/")[0] == case.split("/")[0]]
    return min(recorded()[case]["psnr"]) - 4 * max(stdev(one["psnr"]) for one in group)


def gain_bound(scene: str) -> float:
    """Decibels by which the field must be above harmonics on a capture: four deviations below the least recorded."""
    field, harmonics = (recorded()[f"{scene}/{method}"]["psnr"] for method in ("nrfgs", "nrfgs-sh"))
    gains = [ours - theirs for ours, theirs in zip(field, harmonics, strict=True)]
    return min(gains) - 4 * stdev(gains)


def psnr(method: str, data: Path, out: Path, steps: int, options: dict[str, Any], seed: int) -> float:
    """PSNR of a training's test views."""
    from short_trainings import command_line, trained

    from nrfgs_lab.training_run import evaluate

    config = trained(command_line(method, data, out, steps, options, {"--machine.seed": seed}))
    return evaluate(config, out / "eval.json")["psnr"]


def main(scenes: Path, work: Path) -> None:
    """Run all cases and write the file."""
    from nrfgs_lab.results import write
    from nrfgs_lab.scenes import SceneConfig, write_scene

    tiny = write_scene(SceneConfig(views=10, width=48, height=36, points=300, samples=1), work / "tiny")
    records = {}
    for name, (method, scene, options, seeds) in cases().items():
        data = tiny if scene == "tiny" else scenes / scene
        out = work / name.replace("/", "-")
        reached = [psnr(method, data, out, STEPS, options, seed) for seed in seeds]
        first = psnr(method, data, out, 1, options, seeds[0])
        records[name] = {"steps": STEPS, "after_one_step": first, "psnr": reached}
        print(name, records[name], flush=True)
        write(FILE, records)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
