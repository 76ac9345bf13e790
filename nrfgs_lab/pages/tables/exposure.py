# SPDX-License-Identifier: Apache-2.0
"""Blocks of docs/exposure.md."""

from statistics import fmean

from nrfgs_lab.pages.tables.runs import grid, records

CAPTURES = "lund", "fern", "fox", "castle", "caliterra", "goldcape", "kitchen"
ROWS = {
    "bonsai, varied": ("bonsai", "varied", "varied"),
    "bonsai, varied, EXIF tells": ("bonsai", "varied", "told"),
    "bonsai as it is": ("bonsai", "as-is", "as-is"),
    **{scene: (scene, "as-is", "as-is") for scene in CAPTURES},
}
"""Row -> capture, and its photographs without and with learning."""


def worth() -> str:
    """PSNR of test views without and with learnt exposure, mean over seeds."""
    body = []
    for label, (scene, off, on) in ROWS.items():
        pair = [_tests(scene, case) for case in (f"{off}-off", f"{on}-on")]
        label += f", {len(pair[1])} seeds" if len(pair[1]) > 1 else ""
        means = [[fmean(test[metric] for test in tests) for metric in ("psnr", "cc_psnr")] for tests in pair]
        body.append([label, *("{:.2f}/{:.2f}".format(*values) for values in means)])
    return grid(["PSNR/cc PSNR", "off", "on"], body)


def _tests(scene: str, case: str) -> list[dict[str, float]]:
    """Metrics of test views, a mapping for each seed."""
    return [
        record["measured"]["test"]
        for name, record in records("exposure").items()
        if name.rpartition("-")[0] == f"{scene}-{case}" and record["measured"]
    ]


def rule() -> str:
    """Random exposure of captures, and what a training decides."""
    captures = records("exposure-rule")
    off = [one["random"][0] for one in captures.values() if not one["learnt"]]
    on = [f"{scene} has {one['random'][0]:.2f}" for scene, one in captures.items() if one["learnt"]]
    return f"{len(off)} captures have {min(off):.2f} to {max(off):.2f} stops: off; {', '.join(on)}: on"


BLOCKS = {"exposure.worth": worth, "exposure.rule": rule}
