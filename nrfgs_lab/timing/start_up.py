# SPDX-License-Identifier: Apache-2.0
"""What a nerfstudio command does before it does anything: whose imports take how long.

    python -m nrfgs_lab.timing.start_up --out results/start_up.json

Shares are Python's own (`-X importtime`): each module's time without the modules that it imports, added up by package.
Seconds are processor time, so that other programs count little. Medians of several processes, the files in the system's
cache.
"""

import json
import re
import resource
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import tyro

from nrfgs_ns.files import write_whole
from nrfgs_ns.training.run import machine

IMPORT = "import nerfstudio.scripts.train"
"""What `ns-train` does first; ns-eval and ns-viewer import as much."""
SLOW = f"import nrfgs_ns.start as start; start.with_data_parsers = start.with_methods = lambda: None; {IMPORT}"
"""The same, without what this package does about it (`nrfgs_ns.start`)."""
LINE = re.compile(r"import time:\s+(\d+) \|\s+\d+ \|\s*(\S+)")


@dataclass
class StartUp:
    """Measure the start of ns-train."""

    out: Path
    """JSON file for the record"""
    processes: int = 5
    """how many starts"""

    def main(self) -> None:
        subprocess.run([sys.executable, "-c", IMPORT], check=True, stderr=subprocess.DEVNULL)  # fills the cache
        shares = [shares_of_a_start() for _ in range(self.processes)]
        content = {
            "command": f"python -m nrfgs_lab.timing.start_up --out {self.out.as_posix()}",
            "machine": machine(),
            "processes": self.processes,
            "seconds": round(median(seconds(IMPORT) for _ in range(self.processes)), 2),
            "seconds_without_our_start": round(median(seconds(SLOW) for _ in range(self.processes)), 2),
            "shares": {name: round(median(share[name] for share in shares), 4) for name in PACKAGES},
        }
        write_whole(self.out, json.dumps(content, indent=1) + "\n")
        print(json.dumps(content, indent=1))


def seconds(code: str) -> float:
    """Processor time of a process that runs this."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-c", code], check=True, stderr=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def shares_of_a_start() -> dict[str, float]:
    """Each package's share of the time that imports take."""
    command = [sys.executable, "-X", "importtime", "-c", IMPORT]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stderr
    found = dict.fromkeys(PACKAGES, 0.0)
    for match in map(LINE.match, said.splitlines()):
        if match:
            package = match[2].partition(".")[0]
            found[package if package in found else OTHERS] += int(match[1])
    return {name: time / sum(found.values()) for name, time in found.items()}


OTHERS = "other packages"
PACKAGES = ("torch", "torchvision", "nerfstudio", "nrfgs_ns", OTHERS)


if __name__ == "__main__":
    tyro.cli(StartUp).main()
