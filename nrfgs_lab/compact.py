# SPDX-License-Identifier: Apache-2.0
"""What a scene costs in a file, and what the file loses: results/compact.json.

    python -m nrfgs_lab.compact trade SCENES/bonsai OUT         # the same for goldcape and fox; a GPU
    python -m nrfgs_lab.compact trade HELD_OUT/fox/dev0.json OUT --others --settings WORTH=0.5            # a setting
    python -m nrfgs_lab.compact trade HELD_OUT/fox/dev0.json OUT --others ply --rates --settings MOVED=0  # and of a PLY
    python -m nrfgs_lab.compact speed FILE.nrf OUT/speed.json   # encoding, and decoding in Python and in Chromium
    python -m nrfgs_lab.results pack OUT results/compact.json
    python -m nrfgs_lab.pages.tables.files             # the figure

`trade` trains the capture, and writes it as compact files trained at each of --rates, and as --others: a PLY file, one
without a fine-tune, and what splat-transform makes of the PLY, where it is installed. Records of OUT that are there
already are not made again. All PSNR is that of the test views, of files that are read back. They are left in --work.
Settings are chosen on training views that are held out (`nrfgs_lab.held_out make`).
"""

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any, Literal

import numpy as np
import torch
import tyro

from nrfgs_lab.pages.browser import chromium
from nrfgs_ns.compact import finetune
from nrfgs_ns.compact.decode import decode
from nrfgs_ns.compact.encode import encode
from nrfgs_ns.compact.format import write_container
from nrfgs_ns.errors import InputError
from nrfgs_ns.export.options import CompactOptions, PlyOptions
from nrfgs_ns.files import write_whole
from nrfgs_ns.model import harmonics_tune
from nrfgs_ns.training.run import machine, train

RATES = (1e-4, 3e-4, 5e-4, 1e-3, 2e-3)
TOOL = "splat-transform"


@dataclass
class Trade:
    """Bytes against dB of one capture."""

    data: Annotated[Path, tyro.conf.Positional]
    """the capture"""
    out: Annotated[Path, tyro.conf.Positional]
    """folder for the records"""
    work: Path = Path("outputs/compact")
    """folder for the training and the files"""
    rates: tuple[float, ...] = RATES
    """of the fine-tunes"""
    steps: int = 4000
    """of each fine-tune"""
    others: tuple[Literal["ply", "plain", "spz", "sog"], ...] = ("ply", "plain", "spz", "sog")
    """also write what is not trained for the file: a PLY, a compact file, and splat-transform's"""
    settings: tuple[str, ...] = ()
    """NAME=VALUE, in JSON: other values of constants of the fine-tunes, nrfgs_ns/compact/finetune.py and
    nrfgs_ns/model/harmonics_tune.py"""

    def main(self) -> None:
        from nrfgs_ns.export.compact import export_compact
        from nrfgs_ns.export.ply import export_ply

        files = self.work / "files"
        files.mkdir(parents=True, exist_ok=True)
        name = (f"{self.data.name}" if self.data.is_dir() else f"held-out-{self.data.parent.name}") + "-{}"
        name = name.format
        for setting in self.settings:
            key, value = setting.split("=")
            module = next((one for one in (finetune, harmonics_tune) if hasattr(one, key)), None)
            if module is None:
                raise InputError(f"--settings {setting}: the fine-tunes have no {key}.")
            setattr(module, key, json.loads(value))
        config = Path(self.record(name("model"), self.trained)["train"]["config_path"])

        def tuned(rate: float) -> Any:
            options = CompactOptions(finetune=self.steps, rate=rate)
            return lambda report: export_compact(config, files / f"{report.stem}.nrf", options, True, report)

        def named(what: str) -> str:
            return name("-".join([what, *self.settings]))

        for rate in self.rates:
            self.record(named(f"rate-{rate:g}"), tuned(rate))
        ply = files / f"{named('ply')}.ply"
        if "ply" in self.others:
            self.record(named("ply"), lambda report: export_ply(config, ply, PlyOptions(), True, report))
        suffixes = [suffix for suffix in ("spz", "sog") if suffix in self.others and shutil.which(TOOL)]
        with ThreadPoolExecutor() as pool:  # minutes on a CPU
            there = [(self.out / f"{name(suffix)}.json").exists() for suffix in suffixes]
            todo = [suffix for suffix, done in zip(suffixes, there, strict=True) if not done]
            running = {suffix: pool.submit(converted, ply, suffix) for suffix in todo}
            plain = files / f"{name('version-2')}.nrf"
            if "plain" in self.others:
                options = CompactOptions()
                self.record(name("version-2"), lambda report: export_compact(config, plain, options, True, report))
            for suffix, made in running.items():
                self.record(
                    name(suffix), lambda _, made=made: {**made.result(), **measured(config, ply, made.result())}
                )

    def record(self, name: str, make: Callable[[Path], dict[str, Any] | None]) -> dict[str, Any]:
        """The record of a name: what `make` returns, or writes to the path that it is given."""
        path = self.out / f"{name}.json"
        if not path.exists() and (made := make(path)) is not None:
            write_whole(path, json.dumps(made, indent=1) + "\n")
        return json.loads(path.read_text(encoding="utf-8"))

    def trained(self, _: Path) -> dict[str, Any]:
        args = ["nrfgs", "--data", str(self.data), "--output-dir", str(self.work), "--machine.seed", "42"]
        args += ["--vis", "tensorboard", "--steps-per-eval-all-images", "1000000"]
        return {"machine": machine(), "train": asdict(train([*args, "nrfgs-data"]))}


def converted(ply: Path, suffix: str) -> dict[str, Any]:
    """What splat-transform makes of a PLY file, and back."""
    small = ply.with_suffix(f".{suffix}")
    begin = perf_counter()
    options = ["-w", "-g", "cpu", "-i", "10"]  # steps that find SOG's palette
    subprocess.run([TOOL, *options, ply, small], check=True, stdout=sys.stderr)
    seconds = {"encode": perf_counter() - begin}
    subprocess.run([TOOL, "-w", small, ply.with_suffix(f".{suffix}.ply")], check=True, stdout=sys.stderr)
    said = subprocess.run([TOOL, "--version"], check=True, capture_output=True, text=True)
    version = (said.stdout + said.stderr).strip()
    return {
        "file": small.name,
        "version": version,
        "options": options,
        "bytes": small.stat().st_size,
        "seconds": seconds,
    }


def measured(config: Path, ply: Path, made: dict[str, Any]) -> dict[str, Any]:
    """The record of what splat-transform made of a PLY file; its pictures are those of the PLY that it made back."""
    from nrfgs_ns.export.frames import Y_DOWN
    from nrfgs_ns.export.ply import read_splats, render_splats
    from nrfgs_ns.trained.loading import load_model, measure_loss

    pipeline = load_model(config, "test")
    model, splats = pipeline.model, Y_DOWN.inverse.moved(read_splats(ply.with_name(made["file"] + ".ply")))
    splats = type(splats)(*(value.to(model.device) for value in splats))
    how = model.background_color, model.config.rasterize_mode, model.scene_unit
    loss = measure_loss(pipeline, lambda camera: {"file": render_splats(splats, camera, *how)})
    return {**made, "written": len(splats.means), **loss}


@dataclass
class Speed:
    """Seconds to write and to read a compact file on this machine, the least of some times."""

    file: Annotated[Path, tyro.conf.Positional]
    """a compact file of version 2"""
    record: Annotated[Path, tyro.conf.Positional]
    """JSON to write"""
    repeats: int = 5
    """how many times"""

    def main(self) -> None:
        from nrfgs_ns.appearance.field import Field
        from nrfgs_ns.appearance.reduce import build
        from nrfgs_ns.compact.tables import Precision

        found, again = decode(self.file), self.file.with_suffix(".again")
        field = Field(build(found.config, found.weights, found.header["head"]["scene_unit"]), found.splats)
        steps = {name: np.array(grid["step"]) for name, grid in found.header["grids"].items()}

        def written() -> None:
            write_container(again, *encode(field, Precision(), found.header["render"], steps))

        def least(what: Callable[[], Any]) -> float:
            seconds = []
            for _ in range(self.repeats):
                begin = perf_counter()
                what()
                seconds.append(perf_counter() - begin)
            return min(seconds)

        content = {
            "machine": machine(),
            "threads": torch.get_num_threads(),
            "splats": len(found.splats["means"]),
            "bytes": self.file.stat().st_size,
            "seconds": {
                "encode": least(written),
                "decode": least(lambda: decode(self.file)),
                "chromium": in_chromium(self.file, self.repeats),
            },
        }
        again.unlink()
        write_whole(self.record, json.dumps(content, indent=1) + "\n")
        print(json.dumps(content, indent=1))


def in_chromium(file: Path, repeats: int) -> float:
    """Seconds in which a page's reader unpacks a file, the least of some times."""
    from base64 import b64encode
    from importlib.resources import files

    code = (files("nrfgs_ns.export.web") / "compact.js").read_text(encoding="utf-8")
    with chromium() as browser:
        page = browser.new_page()
        page.add_script_tag(content=code)
        page.evaluate(
            "text => { window.bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)); }",
            b64encode(file.read_bytes()).decode(),
        )
        once = "() => { const t = performance.now(); readScene(bytes, () => {}); return performance.now() - t; }"
        return min(page.evaluate(once) for _ in range(repeats)) / 1000


if __name__ == "__main__":
    try:
        tyro.extras.subcommand_cli_from_dict({"trade": Trade, "speed": Speed}).main()
    except InputError as error:
        sys.exit(str(error))
