# SPDX-License-Identifier: Apache-2.0
"""What it takes to write a checkpoint to the disk and to read one whose every byte is checked.

python -m nrfgs_lab.timing.checkpoint_io --out results/checkpoint_io.json
"""

import json
import os
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from time import perf_counter

import torch
import tyro

from nrfgs_ns.files import write_whole
from nrfgs_ns.training.checkpoint_files import check_seal, seal, write
from nrfgs_ns.training.run import machine


@dataclass
class CheckpointIo:
    """Time checkpoints of random numbers."""

    out: Path
    """JSON file for the record"""
    megabytes: int = 500
    """of each checkpoint"""
    repeats: int = 5
    """how many"""

    def main(self) -> None:
        torch.manual_seed(0)
        rows = self.megabytes * 1_000_000 // 4 // 64
        content = {"step": 1, "pipeline": {"splats": torch.randn(rows, 64), "_extra_state": {}}, "optimizers": {}}
        with tempfile.TemporaryDirectory(dir=".") as folder:
            runs = [timed(Path(folder) / "models", content) for _ in range(self.repeats)]
        record = {name: round(median(run[name] for run in runs), 3) for name in runs[0]}
        command = f"python -m nrfgs_lab.timing.checkpoint_io --out {self.out.as_posix()}"
        whole = {"command": command, "machine": machine(), "megabytes": self.megabytes, "seconds": record}
        write_whole(self.out, json.dumps(whole, indent=1) + "\n")
        print(json.dumps(whole, indent=1))


def timed(folder: Path, content: dict) -> dict[str, float]:
    """Seconds of each part."""
    marks = [perf_counter()]
    seal(content["pipeline"], 1)
    marks.append(perf_counter())
    path = write(folder, 1, content)
    marks.append(perf_counter())
    handle = os.open(path, os.O_RDONLY)
    os.fsync(handle)  # nothing is left to write
    os.close(handle)
    marks.append(perf_counter())
    with zipfile.ZipFile(path) as archive:
        archive.testzip()
    marks.append(perf_counter())
    state = torch.load(path, weights_only=True)
    marks.append(perf_counter())
    check_seal(state["pipeline"], 1)
    marks.append(perf_counter())
    names = ("checksum", "write and fsync", "fsync again", "check the CRCs", "torch.load", "check the checksum")
    return {name: end - begin for name, begin, end in zip(names, marks, marks[1:], strict=False)}


if __name__ == "__main__":
    tyro.cli(CheckpointIo).main()
