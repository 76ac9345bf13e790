# SPDX-License-Identifier: Apache-2.0
"""What this package leans on in nerfstudio and gsplat beyond their documented interfaces, and in which versions.

`tests/test_host.py` looks every name up in the installed versions: a newer host that has lost one fails there, by name.
What behaves differently between gsplat's versions is told apart by `gsplat_version` in `rasterizer/gsplat_cuda.py`
alone: 1.4.0 is what nerfstudio 1.1.5 pins, 1.5.3 works beneath it (docs/troubleshooting.md).

Nothing here imports nerfstudio or gsplat.
"""

from functools import cache
from importlib.metadata import version

NERFSTUDIO = "1.1.5"
"""The version of nerfstudio that the names below were read in."""
GSPLAT = ("1.4.0", "1.5.3")
"""Those of gsplat."""

PRIVATE = {
    # The trainer is extended between its own steps, and writes and reads checkpoints in its own way.
    "nerfstudio.engine.trainer:Trainer": (
        "_after_train",
        "_load_checkpoint",
        "_train_complete_viewer",
        "_update_viewer_state",
    ),
    # Who called it is asked slowly, and the compiler imported early (start.py).
    "nerfstudio.configs.external_methods": ("inspect",),
    "nerfstudio.utils.misc": ("torch_compile",),
    # Seeds as ns-train seeds.
    "nerfstudio.scripts.train": ("_set_random_seed",),
    # Images are kept where there is room for them; a dataset knows its files; what undistorts a photograph.
    "nerfstudio.data.datamanagers.full_images_datamanager": ("_undistort_image",),
    "nerfstudio.data.datamanagers.full_images_datamanager:FullImageDatamanager": ("_load_images",),
    # Splatfacto's own, which the model calls or replaces.
    "nerfstudio.models.splatfacto:SplatfactoModel": (
        "_apply_bilateral_grid",
        "_downscale_if_required",
        "_get_background_color",
        "_get_downscale_factor",
    ),
    # A control of the viewer is set up by, and wakes, the viewer.
    "nerfstudio.viewer.viewer_elements:ViewerControl": ("_setup",),
    "nerfstudio.viewer.viewer:Viewer": ("_trigger_rerender",),
    # Growth by gradients: which splats are split, duplicated or pruned. Statistics and resets are this package's own:
    # their layout differs between 1.4 and 1.5, and 1.5.3 never resets opacities (`0 & step` binds before `==`).
    "gsplat.strategy:DefaultStrategy": ("_grow_gs", "_prune_gs"),
    # Rows of the table with their optimisers' moments.
    "gsplat.strategy.ops": ("_update_param_with_optimizer",),
}
"""Module, or module:class -> the private names in it."""


@cache
def gsplat_version() -> tuple[int, ...]:
    """Of the installed gsplat, as (1, 4, 0)."""
    return tuple(int(part) for part in version("gsplat").split("+")[0].split(".")[:3])
