# SPDX-License-Identifier: Apache-2.0
"""What a nerfstudio command does before it does anything: whose imports take how long.

    python -m nrfgs_lab.timing.start_up --out results/start_up.json

Times are Python's own (`-X importtime`), each module's without the modules that it imports, added up by package: the
median of several processes, the files in the system's cache. Processor time, so that other programs count little.
"""

import json
import re
import resource
import subprocess
import sys
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import tyro

from nrfgs_ns.files import write_whole
from nrfgs_ns.training.run import machine

IMPORT = "import nerfstudio.scripts.train"
"""What `ns-train` does first; ns-eval and ns-viewer import as much."""
LINE = re.compile(r"import time:\s+(\d+) \|\s+\d+ \|\s*(\S+)")
CALLERS = "nerfstudio.configs.method_configs"
"""Beside its configurations, this module asks 26 times who called it."""


@dataclass
class StartUp:
    """Measure the start of ns-train."""

    out: Path
    """JSON file for the record"""
    processes: int = 5
    """how many starts"""

    def main(self) -> None:
        subprocess.run([sys.executable, "-c", IMPORT], check=True, stderr=subprocess.DEVNULL)  # fills the cache
        runs = [measured() for _ in range(self.processes)]
        record = {name: round(median(run.get(name, 0.0) for run in runs), 3) for name in sorted(set().union(*runs))}
        command = f"python -m nrfgs_lab.timing.start_up --out {self.out.as_posix()}"
        content = {"command": command, "machine": machine(), "processes": self.processes, "seconds": record}
        write_whole(self.out, json.dumps(content, indent=1) + "\n")
        print(json.dumps(content, indent=1))


def measured() -> dict[str, float]:
    """One start: seconds by package, and "whole", its processor time."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-X", "importtime", "-c", IMPORT]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stderr
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    found: dict[str, float] = defaultdict(float)
    for line in said.splitlines():
        match = LINE.match(line)
        if match:
            name = match[2]
            package = name if name == CALLERS else name.partition(".")[0]
            found[package if package in KEPT else "other packages"] += int(match[1]) / 1e6
    whole = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {**found, "whole": whole}


KEPT = ("torch", "torchvision", "nerfstudio", CALLERS, "nrfgs_ns")


if __name__ == "__main__":
    tyro.cli(StartUp).main()
