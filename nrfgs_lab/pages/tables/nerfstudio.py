# SPDX-License-Identifier: Apache-2.0
"""The table of docs/nerfstudio/nrfgs.md."""

from nrfgs_lab.pages.tables import bench_rows, grid, mean_of

METHODS = {
    "default": ("nrfgs", "the method"),
    "harmonics_nrfgs-sh": ("nrfgs-sh", "the same model with spherical harmonics (3DGS)"),
    "nerfstudio_splatfacto": ("splatfacto", "nerfstudio's own, for comparison"),
}


def methods() -> str:
    """Memory and time of the methods on bonsai."""
    rows = {run: row for (scene, _, run), row in bench_rows("presets").items() if scene == "bonsai"}
    body = [
        [f"`{name}`", text, f"{mean_of(rows[run], 'peak MB') / 1000:.1f} GB", f"{mean_of(rows[run], 'time s'):.0f} s"]
        for run, (name, text) in METHODS.items()
    ]
    return grid(["method", "description", "memory (bonsai, 799 x 532)", "time for 30,000 steps (H200)"], body)
