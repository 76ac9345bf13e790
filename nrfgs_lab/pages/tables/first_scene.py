# SPDX-License-Identifier: Apache-2.0
"""The numbers of docs/first-scene.md."""

from nrfgs_lab.pages.tables import records

FORMS = {
    "eval psnr": "{:.2f}",
    "eval ssim": "{:.3f}",
    "eval splats": "{:,}",
    "export psnr_file": "{:.2f}",
    "export loss_db": "{:.2f}",
}


def number(part: str, key: str) -> str:
    """A number of the walk."""
    return FORMS[f"{part} {key}"].format(records("newcomer")["newcomer"][part][key])


def minutes() -> str:
    """What the walk took, with the start-up of each command."""
    return f"{records('newcomer')['newcomer']['seconds'] / 60:.1f}"
