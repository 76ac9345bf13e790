# SPDX-License-Identifier: Apache-2.0
"""The private names of nerfstudio, gsplat and viser that this package relies on, and their versions.

`tests/test_architecture.py` looks up every name in the installed versions. Only `rasterizer/gsplat_cuda.py`
distinguishes gsplat's versions, by `gsplat_version`: nerfstudio 1.1.5 pins 1.4.0, and 1.5.3 works beneath it
(docs/troubleshooting.md). Nothing here imports any of them.
"""

from importlib.metadata import version

from packaging.version import Version

NERFSTUDIO = "1.1.5"
"""The version of nerfstudio in which the names below were read."""
GSPLAT = ("1.4.0", "1.5.3")
"""The same for gsplat."""
VISER = "0.2.7"
"""The same for viser; `viewer/server.py` refuses others."""

PRIVATE = {
    # Extended between its own steps; checkpoints are written and read differently.
    "nerfstudio.engine.trainer:Trainer": "_after_train _load_checkpoint _start_step _train_complete_viewer "
    "_update_viewer_state",
    # Replaced by faster ones (start.py).
    "nerfstudio.configs.external_methods": "inspect",
    "nerfstudio.utils.misc": "torch_compile",
    # Seeds like ns-train.
    "nerfstudio.scripts.train": "_set_random_seed",
    # `nrfgs view` is ns-viewer with a config.yml that runs no code.
    "nerfstudio.scripts.viewer.run_viewer": "_start_viewer",
    # Data sets are parsed anew, and masks read, with checks.
    "nerfstudio.data.dataparsers.base_dataparser:DataParser": "_generate_dataparser_outputs",
    "nerfstudio.data.datasets.base_dataset:InputDataset": "_dataparser_outputs",
    # Images are cached where there is room for them, and undistorted one by one.
    "nerfstudio.data.datamanagers.full_images_datamanager": "_undistort_image",
    "nerfstudio.data.datamanagers.full_images_datamanager:FullImageDatamanager": "_load_images",
    # Splatfacto's own, which the model calls or replaces.
    "nerfstudio.models.splatfacto:SplatfactoModel": "_downscale_if_required _get_background_color "
    "_get_downscale_factor",
    # A control is set up by the viewer and triggers a new picture.
    "nerfstudio.viewer.viewer_elements:ViewerControl": "_setup",
    "nerfstudio.viewer.viewer:Viewer": "_trigger_rerender",
    # Requests and messages are checked, icons read from an archive that stays open, and pictures written without
    # imports (viewer/).
    "viser": "_client_autobuild _gui_api _gui_handles _icons _messages _scene_api",
    "viser._scene_api": "iio",
    "viser.infra": "_infra",
    "viser.infra:WebsockServer": "_background_worker _http_server_root",
    "viser:ViserServer": "_share_tunnel _websock_server",
    # Growth by gradients: which splats are split or duplicated. Statistics and resets are this package's own: their
    # layout differs between 1.4 and 1.5, and 1.5.3 never resets opacities (`0 & step` binds before `==`).
    "gsplat.strategy:DefaultStrategy": "_grow_gs",
    # Rows of the table with their optimisers' moments.
    "gsplat.strategy.ops": "_update_param_with_optimizer",
}
"""Module, or module:class -> the private names in it; attributes of its instances, too."""


def gsplat_version() -> tuple[int, ...]:
    """Of the installed gsplat, as (1, 4, 0)."""
    return Version(version("gsplat")).release
