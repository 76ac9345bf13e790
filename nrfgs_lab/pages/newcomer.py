# SPDX-License-Identifier: Apache-2.0
"""The way from photographs to a splat file, walked with the commands that docs/own-data.md shows.

    python -m nrfgs_lab.pages.newcomer PHOTOS --work outputs/newcomer

Photographs -> `nrfgs prepare` -> `ns-train nrfgs`, watched in a browser -> `ns-viewer` -> `ns-eval` -> `nrfgs export
ply`. Small sizes, on a CPU. Writes docs/images/first-scene-*.jpg (pages of the viewer, renderings only) and
results/newcomer.json: each command, how long it took, and what it found. Interrupted, it goes on with the
step that it was at; another --work begins anew. Needs a Chromium and
`pip install -e '.[browser]'`.
"""

import argparse
import json
import shlex
import subprocess
import sys
import time
from pathlib import Path

from nrfgs_lab.pages.browser import PATIENCE, TRAIN, VIEWER, Page, Served, chromium
from nrfgs_lab.results import write
from nrfgs_ns.training.run import machine

ROOT = Path(__file__).resolve().parents[2]
IMAGES = ROOT / "docs" / "images"
RESULTS = ROOT / "results" / "newcomer.json"
BIN = Path(sys.executable).parent
STEPS, WATCHED = 800, 200
"""Training steps, and that after which the page is looked at."""
SMALL = {"prepare": ["--feature-size", 960, "--features", 2048], "data": ["nrfgs-data", "--downscale-factor", 4]}
"""What makes it quick on a CPU; a machine with a GPU needs none of it."""
TRAINING = ["--max-num-iterations", STEPS, "--pipeline.model.num-downscales", 0]
WINDOW = (1180, 680)
DRAWN = 5
"""Seconds after which the page shows what it was asked for; while it trains, the picture never rests."""


class Diary:
    """What was done, and what came of it.

    Args:
        photos, work: their places, which are written as PHOTOS and the folder's name.
    """

    def __init__(self, photos: Path, work: Path):
        self.names = {str(photos): "PHOTOS", f"{work}/": ""}
        self.file = work / "diary.json"
        self.steps: list[dict] = json.loads(self.file.read_text()) if self.file.is_file() else []

    def has(self, name: str) -> bool:
        """Whether a step has been done, in this run or in an earlier one that was interrupted."""
        return any(step["step"] == name for step in self.steps)

    def write(self, name: str, command: list, seconds: float, **found) -> None:
        """Add one command."""
        words = shlex.join(map(str, command))
        for place, shown in self.names.items():
            words = words.replace(place, shown)
        self.steps.append({"step": name, "command": words, "seconds": round(seconds, 1), **found})
        self.file.write_text(json.dumps(self.steps, indent=1))
        print(f"{name}: {seconds:.0f} s\n  $ {words}\n  {found}", flush=True)


def run(diary: Diary, name: str, command: list, log: Path) -> None:
    """Run one command to its end.

    Raises:
        subprocess.CalledProcessError: it failed; its log says why.
    """
    if diary.has(name):
        return
    start = time.time()
    with log.open("w") as out:
        words = [BIN / command[0], *command[1:]]
        subprocess.run(list(map(str, words)), stdout=out, stderr=subprocess.STDOUT, check=True, cwd=log.parent)
    diary.write(name, command, time.time() - start)


def train(diary: Diary, browser, scene: Path, work: Path) -> Path:
    """`ns-train nrfgs` with its viewer, looked at while it goes on and left when it is done; its config.yml."""
    if diary.has("train"):
        return config_of(work)
    words = ["nrfgs", "--data", scene, "--output-dir", work / "outputs", *TRAINING]
    start = time.time()
    with Served(TRAIN, work / "train.log", *words, tail=SMALL["data"]) as training:
        page = Page(browser, training.port, *WINDOW)
        wait(lambda: page.step() >= WATCHED, training)
        page.hide_cameras()
        time.sleep(DRAWN)
        page.save(IMAGES / "first-scene-training.jpg")
        page.page.close()  # drawing takes time from the training
        wait(lambda: list(work.rglob(f"step-{STEPS - 1:09d}.ckpt")), training)
    diary.write("train", ["ns-train", *words, *SMALL["data"]], time.time() - start, steps=STEPS)
    return config_of(work)


def config_of(work: Path) -> Path:
    """The config.yml of the last training."""
    return max(work.glob("outputs/*/nrfgs/*/config.yml"))


def wait(condition, served: Served, patience: float = 6 * PATIENCE) -> None:
    """Until the condition holds.

    Raises:
        AssertionError: the command has ended before, or it took too long.
    """
    deadline = time.time() + patience
    while not condition():
        if served.process.poll() is not None or time.time() > deadline:
            raise AssertionError(f"{served.log} says why:\n{served.log.read_text()[-3000:]}")
        time.sleep(0.5)


def look(diary: Diary, browser, config: Path, work: Path) -> None:
    """`ns-viewer`: the picture."""
    if diary.has("look"):
        return
    words = ["--load-config", config]
    start = time.time()
    with Served(VIEWER, work / "viewer.log", *words) as viewer:
        page = Page(browser, viewer.port, *WINDOW)
        page.hide_cameras()
        page.set_resolution(800)
        page.settled()
        page.save(IMAGES / "first-scene-viewer.jpg")
        page.page.close()
    diary.write("look", ["ns-viewer", *words], time.time() - start)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("photos", type=Path, help="folder of photographs")
    parser.add_argument("--work", type=Path, default=Path("outputs/newcomer"), help="folder for all that is made")
    options = parser.parse_args()
    photos, work = options.photos.resolve(), options.work.resolve()
    work.mkdir(parents=True, exist_ok=True)
    scene, diary = work / "scene", Diary(photos, work)
    run(diary, "prepare", ["nrfgs", "prepare", photos, scene, *SMALL["prepare"]], work / "prepare.log")
    with chromium() as browser:
        config = train(diary, browser, scene, work)
        look(diary, browser, config, work)
    run(diary, "eval", ["ns-eval", "--load-config", config, "--output-path", work / "eval.json"], work / "eval.log")
    export = ["nrfgs", "export", "ply", "--load-config", config, "--output", work / "splats.ply"]
    run(diary, "export", [*export, "--report", work / "export.json"], work / "export.log")

    found = {name: json.loads((work / file).read_text()) for name, file in FOUND.items()}
    evaluation = found["eval"]["results"]
    record = {
        "machine": machine(),
        "seconds": round(sum(step["seconds"] for step in diary.steps), 1),
        "commands": diary.steps,
        "prepare": found["prepare"],
        "eval": {name: value for name, value in evaluation.items() if value == value},  # NaN is no number
        "export": found["export"],
    }
    text = json.dumps(record, indent=1).replace(str(photos), "PHOTOS").replace(f"{work}/", "")
    write(RESULTS, {"newcomer": json.loads(text)})
    print(f"{record['seconds']:.0f} s in all")


FOUND = {"prepare": "scene/prepare.json", "eval": "eval.json", "export": "export.json"}
"""Where the commands say what they have found."""


if __name__ == "__main__":
    main()
