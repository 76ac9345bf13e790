# SPDX-License-Identifier: Apache-2.0
"""`nrfgs eval` and `nrfgs view`: as `ns-eval` and `ns-viewer`, also for a training or file from somebody else; and the
training that a command line names, found before torch is imported."""

import json
from dataclasses import dataclass
from glob import escape
from pathlib import Path
from time import sleep
from types import SimpleNamespace

import tyro

from nrfgs_ns.errors import InputError
from nrfgs_ns.files import check_writable, write_whole

OUTPUTS = Path("outputs")
"""Where ns-train writes by default"""


@dataclass
class NamesTraining:
    """Options that name a trained model."""

    model: tyro.conf.Positional[Path | None] = None
    """config.yml of a training, or a folder, of whose trainings the newest with a checkpoint counts. None: outputs"""
    load_config: Path | None = None
    """the same, as ns-eval and ns-viewer call it"""

    def config(self) -> Path:
        """The named config.yml (`config_of`); InputError if two are named."""
        if self.model is not None and self.load_config is not None:
            raise InputError(f"{self.model} and --load-config {self.load_config} both name a training. Give one.")
        return config_of(self.model if self.load_config is None else self.load_config)


def config_of(path: Path | None) -> Path:
    """The file at a path, or the newest config.yml in a folder (None: outputs) or up to three levels below it, of those
    with checkpoints if there are any, which is printed; InputError without one."""
    if path is not None and path.is_file():
        return path
    folder = OUTPUTS if path is None else path
    if not folder.is_dir():
        missing = "there is no folder outputs here" if path is None else f"{path}: no such file or folder"
        raise InputError(f"{missing}. Name the config.yml of a training, or its folder.")
    configs = [config for depth in range(4) for config in folder.glob("*/" * depth + "config.yml")]
    if not configs:
        raise InputError(f"{folder}: no config.yml in this folder or below. Name the folder of a training.")

    def order(config: Path) -> tuple[bool, bool, float]:
        # One of a compact file (`export.compact.write_config`) is newer than that of the training it was made from.
        is_compact = config.match("*.nerfstudio/*/compact/config.yml")
        return any(config.parent.glob("*/step-*.ckpt")), not is_compact, config.stat().st_mtime

    newest = max(configs, key=order)
    print(f"Training: {newest}", flush=True)
    return newest


@dataclass
class Eval(NamesTraining):
    """Evaluate a trained model on its test views. Its config.yml is read as options only and runs no code."""

    output_path: Path = Path("output.json")
    """the file for the numbers, as ns-eval writes it"""
    render_output_path: Path | None = None
    """folder for the pictures, truth and rendering side by side"""

    def main(self) -> None:
        path = self.config()
        check_writable(self.output_path, "--output-path")
        if self.output_path.resolve() == path.resolve():
            raise InputError(f"--output-path {path} would replace the training's file. Give it a name of its own.")
        if (pictures := self.render_output_path) is not None:
            check_writable(pictures / "eval.png", "--render-output-path")
        from nrfgs_ns.threads import draws_small, few_threads
        from nrfgs_ns.trained.loading import load_training

        trained = load_training(path, "test")
        with few_threads(draws_small(trained.pipeline)):
            results = trained.pipeline.get_average_eval_image_metrics(output_path=pictures, get_std=True)
        numbers = {name: getattr(trained.config, name) for name in ("experiment_name", "method_name")}
        numbers |= {"checkpoint": str(trained.checkpoint), "results": results}
        write_whole(self.output_path, json.dumps(numbers, indent=2) + "\n")
        print(f"Saved results to: {self.output_path}")


@dataclass
class View(NamesTraining):
    """Look at a trained model in a browser: a training, or a file of `nrfgs export compact`. No code in it is run."""

    host: str = "127.0.0.1"
    """address to listen on. 127.0.0.1: this machine only; from another use ssh -L 7007:localhost:7007 HOST. 0.0.0.0:
    everybody who reaches this machine can look"""
    port: int | None = None
    """port to listen on. None: 7007, or the next that is free"""

    def main(self) -> None:
        path = self.config()
        from nrfgs_ns.compact.format import MAGIC
        from nrfgs_ns.threads import SMALL, draws_small, few_threads
        from nrfgs_ns.viewer.server import LocalViewerConfig

        config = LocalViewerConfig(websocket_host=self.host, websocket_port=self.port)
        if path.read_bytes().startswith(MAGIC):
            with few_threads(view_file(path, config).pipeline.model.num_points < SMALL):
                while True:
                    sleep(1)
        from nerfstudio.scripts.viewer.run_viewer import _start_viewer

        from nrfgs_ns.trained.loading import load_training

        trained = load_training(path, "test")
        # Nerfstudio looks here for the config.yml that its command for ns-render names; it writes nothing.
        config.relative_log_filename = str(path.absolute().parent / "viewer.log")
        trained.config.vis = "viewer"
        trained.config.viewer = config
        with few_threads(draws_small(trained.pipeline)):
            _start_viewer(trained.config, trained.pipeline, trained.step)


def view_file(path: Path, config):
    """Nerfstudio's viewer for a compact file alone: no photographs, no training."""
    from nerfstudio.utils.rich_utils import CONSOLE
    from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO, Viewer

    from nrfgs_ns.trained.loading import load_file
    from nrfgs_ns.viewer.panel import ViewerPanel

    model = load_file(path)
    model.viewer_panel = ViewerPanel(model)
    pipeline = SimpleNamespace(model=model, datamanager=SimpleNamespace(includes_time=False))
    beside = next(path.absolute().parent.glob(f"{escape(path.name)}.nerfstudio/*/compact"), path.parent)
    viewer = Viewer(config, beside / "viewer.log", datapath=path.parent, pipeline=pipeline)
    viewer.camera_handles, viewer.original_c2w = {}, {}
    viewer.hide_images.visible = False
    viewer.make_stats_markdown = lambda _, resolution: f"Resolution: {resolution}"  # a file knows no step
    viewer.stats_markdown.content = viewer.make_stats_markdown(None, "0x0px")

    means = model.means.detach()
    middle = means.median(dim=0).values
    stand = middle + (means - middle).norm(dim=-1).median() * means.new_tensor((2.0, -2.0, 1.0))  # z is up
    position, target = ((VISER_NERFSTUDIO_SCALE_RATIO * point).cpu().numpy() for point in (stand, middle))

    def welcome(client) -> None:
        with client.atomic():
            client.camera.position, client.camera.look_at = position, target

    viewer.viser_server.on_client_connect(welcome)
    for line in viewer.viewer_info:
        CONSOLE.print(line, markup=False, soft_wrap=True)
    return viewer
