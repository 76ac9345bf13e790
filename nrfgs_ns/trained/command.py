# SPDX-License-Identifier: Apache-2.0
"""`nrfgs eval` and `nrfgs view`: as `ns-eval` and `ns-viewer`, also for a training or file from somebody else."""

import json
from dataclasses import dataclass
from pathlib import Path
from time import sleep
from types import SimpleNamespace

from nrfgs_ns.compact.format import MAGIC
from nrfgs_ns.files import check_writable, write_whole
from nrfgs_ns.trained.find import NamesTraining


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
        if (pictures := self.render_output_path) is not None:
            check_writable(pictures / "eval.png", "--render-output-path")
        from nrfgs_ns.threads import few_threads
        from nrfgs_ns.trained.loading import load_training

        with few_threads() as threads:
            trained = load_training(path, "test")
            threads.suit_to(trained.pipeline)
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
        compact = path.read_bytes().startswith(MAGIC)
        from nrfgs_ns.threads import few_threads
        from nrfgs_ns.viewer.server import LocalViewerConfig

        config = LocalViewerConfig(websocket_host=self.host, websocket_port=self.port)
        with few_threads() as threads:
            if compact:
                threads.suit(view_file(path, config).pipeline.model.num_points)
                while True:
                    sleep(1)
            from nerfstudio.scripts.viewer.run_viewer import _start_viewer

            from nrfgs_ns.trained.loading import load_training

            trained = load_training(path, "test")
            threads.suit_to(trained.pipeline)
            # Nerfstudio looks here for the config.yml that its command for ns-render names; it writes nothing.
            config.relative_log_filename = str(path.absolute().parent / "viewer.log")
            trained.config.vis = "viewer"
            trained.config.viewer = config
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
    viewer = Viewer(config, path.parent / "viewer.log", datapath=path.parent, pipeline=pipeline)
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
