# SPDX-License-Identifier: Apache-2.0
"""`nrfgs prepare PHOTOS OUT`: the stages in order, their dependencies, and the verdict.

`prepare.json` in OUT has the verdict's numbers and the key of each stage that was begun: a digest of the input's bytes,
the stage's options and the previous key. A finished stage with the same key is skipped, an unfinished one continues;
files of another key are removed. Running a stage forgets the later ones.
"""

import hashlib
import itertools
import json
import shlex
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.progress import Progress

from nrfgs_ns.errors import InputError, refusing, require
from nrfgs_ns.files import write_whole
from nrfgs_prepare import pairs, structure
from nrfgs_prepare import photos as files
from nrfgs_prepare.pairs import Advance
from nrfgs_prepare.structure import CameraModel

STAGES = ("import", "features", "match", "map", "write")
GOOD_SHARE = 0.9
"""Share of the photographs that a good reconstruction places."""
GOOD_ERROR = 1.5
"""Mean reprojection error of a good reconstruction, pixels."""
SHORTEST = 0.3
"""Focal length over the longer side, of a lens of 118 degrees; below it the cameras are probably wrong."""


@dataclass
class Prepare:
    """Turn photographs, or a video, into a posed scene that ns-train reads."""

    photos: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PHOTOS")]
    """folder of photographs, or a video"""
    out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")]
    """folder for the scene; interrupted work in it continues"""
    matching: Literal["auto", "exhaustive"] = "auto"
    """pairs to match. auto: those likely to show the same thing, by largest features, EXIF positions and order.
    exhaustive: all"""
    camera_model: CameraModel = "SIMPLE_RADIAL"
    """lens to fit; images are undistorted to a pinhole. OPENCV: for strong distortion and many photographs"""
    features: int = 4096
    """largest number of features in a photograph, 10 or more; more give more points and take longer"""
    frames: int = 150
    """frames to take from a video, 10 or more; at most all that it has"""

    def main(self) -> None:
        work = self.out / "work"
        again = f"If the disk has room, delete {work} and run this again."
        access = "Name files and folders of yours, on a disk with room."
        with refusing(f"{work}: COLMAP stops with an error", again, RuntimeError):
            with refusing(f"{self.out} cannot be finished", access, OSError):
                Run(self).all()


class Run:
    """One call of the command: its paths, and the state of the stages."""

    def __init__(self, options: Prepare, screen: Console | None = None):
        for name, value in (("--features", options.features), ("--frames", options.frames)):
            require(value >= 10, name, value, "at least 10")
        self.options, self.screen = options, screen or Console()
        self.inputs = files.find_inputs(options.photos)
        self.is_video = options.photos.is_file()
        structure.colmap()  # reports a missing package before any work
        self.out, self.work = options.out, options.out / "work"
        names = "photos", "features/database.db", "model"
        self.stored, self.database, self.model = map(self.work.joinpath, names)
        self.file = file = self.out / "prepare.json"
        self.source = str(options.photos.resolve())
        if self.out.exists() and not file.is_file() and (self.out.is_file() or any(self.out.iterdir())):
            raise InputError(f"{self.out} exists and was not made by `nrfgs prepare`. Name a new or an empty folder.")
        with refusing(f"{file} is damaged", f"Delete {self.out} and begin again.", ValueError, TypeError):
            self.state: dict[str, Any] = dict(json.loads(file.read_text())) if file.is_file() else {}
        self.key = self.digest = files.digest(self.inputs)
        if self.state.get("digest", self.digest) != self.digest and (other := self.state.get("source")) != self.source:
            fix = "Name another folder, or delete this one."
            raise InputError(f"{self.out} has the scene of other photographs, {other}. {fix}")

    def all(self) -> None:
        """Run every stage, and print the verdict."""
        self.import_input()
        self.find_features()
        self.match()
        self.map()
        self.write()
        self.verdict()

    @property
    def names(self) -> list[str]:
        """Names of the stored photographs, sorted."""
        return sorted(path.name for path in self.stored.iterdir())

    def import_input(self) -> None:
        if self.is_video:
            frames = self.options.frames
            read = partial(files.import_video, self.inputs[0], self.stored, frames)
            self.stage("import", "read the video", self.stored, frames, read, frames=frames)
            return
        if others := files.left_out(self.options.photos, self.inputs):
            self.screen.print(others, markup=False, soft_wrap=True)
        count = len(self.inputs)
        if count < files.FEW:
            warning = f"Warning: {count} photographs are few. Take 30 or more that overlap for a better scene."
            self.screen.print(warning, style="bold yellow", soft_wrap=True)
        read = partial(files.import_photos, self.inputs, self.stored)
        self.stage("import", "read the photographs", self.stored, count, read)

    def find_features(self) -> None:
        names, options = self.names, self.options
        cameras = files.same_cameras(self.stored, names)
        chosen = {"camera_model": options.camera_model, "features": options.features}
        find = partial(structure.extract_features, self.database, self.stored, cameras, **chosen)
        self.stage("features", "find features", self.database.parent, len(names), find, cameras=cameras, **chosen)

    def match(self) -> None:
        names, matching = self.names, self.options.matching

        def match(advance: Advance) -> None:
            if matching == "exhaustive":
                chosen = list(itertools.combinations(range(len(names)), 2))
            else:
                descriptors = structure.largest_features(self.database, names, pairs.LARGEST)
                positions = pairs.metres(structure.positions(self.database, names))
                in_a_row = self.is_video or pairs.numbered_in_a_row(names)
                chosen = pairs.likely_pairs(pairs.shared_features(descriptors, advance), positions, in_a_row)
            self.state["pairs"] = len(chosen)

            def matched(count: int) -> None:
                advance(count * len(names) / len(chosen))  # as long as the choice, on the bar

            if structure.match_features(self.database, names, chosen, self.work, matched) == 0:
                raise InputError(
                    f"{self.options.photos}: no two of the {len(names)} photographs show the same thing. Take them "
                    "closer to each other, with texture in view, and sharp; or try --features 8192."
                )

        self.stage("match", "match the photographs", None, 2 * len(names), match, matching=matching)

    def map(self) -> None:
        def find(advance: Advance) -> None:
            names = self.names
            place = self.database, self.stored, self.model
            enough = GOOD_SHARE * len(names)
            say = partial(self.screen.print, soft_wrap=True)
            models, mapping = structure.find_cameras(*place, names, enough, advance, say)
            if models == 0:
                raise InputError(
                    f"{self.options.photos}: photographs match, but too little to tell where they were taken. Take "
                    "more, and move the camera sideways instead of turning it; with few try --features 8192."
                )
            self.state |= {"models": models, "mapping": mapping}

        self.stage("map", "find the cameras", self.model, len(self.names), find)

    def write(self) -> None:
        from nrfgs_prepare.scene import write_scene  # imports torch

        write = partial(write_scene, self.model, self.stored, self.work / "undistorted", self.out)
        self.stage("write", "write the scene", self.out / "transforms.json", len(self.names), write)

    def stage(
        self, slot: str, name: str, made: Path | None, total: int, work: Callable[[Advance], None], **depends_on: Any
    ) -> None:
        """Run a stage with a progress bar up to `total`, unless it is finished; the file or folder that it makes is
        removed first if it is of another input or other options."""
        self.key = hashlib.sha256(json.dumps([self.key, slot, depends_on], sort_keys=True).encode()).hexdigest()
        before = self.state.get(slot, {})
        if before == {"key": self.key, "done": True} and (made is None or made.exists()):
            return
        if made is not None and before.get("key") != self.key:
            shutil.rmtree(made) if made.is_dir() else made.unlink(missing_ok=True)
        self._remember(slot, done=False)
        clocks = time.monotonic, time.process_time
        begun = [clock() for clock in clocks]
        with Progress(console=self.screen) as progress:
            task = progress.add_task(name, total=total)
            work(lambda steps: progress.advance(task, steps))
            progress.update(task, completed=total)
        spent = [round(clock() - start, 1) for clock, start in zip(clocks, begun, strict=True)]
        self.state.setdefault("seconds_and_cpu_seconds", {})[slot] = spent
        self._remember(slot, done=True)

    def _remember(self, slot: str, done: bool) -> None:
        for later in STAGES[STAGES.index(slot) + 1 :]:
            self.state.pop(later, None)
        self._save({slot: {"key": self.key, "done": done}})

    def _save(self, more: dict[str, Any]) -> None:
        self.state |= more
        write_whole(self.file, json.dumps(self.state, indent=1) + "\n")

    def verdict(self) -> None:
        """Print results and the next step, and write the numbers to OUT/prepare.json."""
        model = structure.colmap().Reconstruction(self.model)
        total = len(self.names)
        registered = model.num_reg_images()
        numbers = {
            "source": self.source,
            "digest": self.digest,
            "photographs": total,
            "registered": registered,
            "points": model.num_points3D(),
            "mean_reprojection_error_px": (error := model.compute_mean_reprojection_error()),
            "mean_track_length": model.compute_mean_track_length(),
            "options": {name: value for name, value in asdict(self.options).items() if name not in ("photos", "out")},
        }
        self._save(numbers)
        cameras = [model.cameras[model.images[number].camera_id] for number in model.reg_image_ids()]
        shortest = min(camera.mean_focal_length() / max(camera.width, camera.height) for camera in cameras)
        found = f"{registered} of {total} photographs have a camera, {numbers['points']:,} points"
        command = shlex.join(["ns-train", "nrfgs", "--data", str(self.out)])
        for line in (
            f"{found}, mean reprojection error {error:.2f} px.",
            *(f"- {advice}" for advice in self._advice(registered, total, error, shortest)),
            f"Train with: {command}",
        ):
            self.screen.print(line, markup=False, highlight=False, soft_wrap=True)

    def _advice(self, registered: int, total: int, error: float, shortest: float) -> Iterator[str]:
        """Faults of a reconstruction and their fixes."""
        placed = {path.name for path in (self.out / "images").iterdir()}
        if left := [name for name in self.names if name not in placed]:
            yield f"Without a camera: {', '.join(left[:5])}{' ...' if len(left) > 5 else ''}. They are left out."
        if registered < GOOD_SHARE * total:
            if self.state["models"] > 1:
                yield f"They fall into {self.state['models']} groups; the largest is used. Take some in between."
            if self.options.matching != "exhaustive" and total > pairs.ALIKE + 1:
                yield "Try --matching exhaustive: slower, but it finds every overlap."
            yield "Try --features 8192, or take more photographs, sharp and with more overlap."
        if error > GOOD_ERROR:
            yield "The error is large: try --camera-model OPENCV."
        if shortest < SHORTEST:
            found = f"A focal length is {shortest:.2f} of the longer side, shorter than that of most lenses"
            yield f"{found}: the cameras are probably wrong. Keep the photographs' EXIF, or take more, from the sides."
