# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/exposure.md."""

from statistics import fmean
from typing import Any

from nrfgs_lab.pages.tables.runs import grid, records

CAPTURES = "lund", "fern", "fox", "castle", "caliterra", "goldcape", "kitchen"
ROWS = (
    ("bonsai, varied", "bonsai", "varied", "varied"),
    ("bonsai, varied, EXIF tells", "bonsai", "varied", "told"),
    ("bonsai as it is", "bonsai", "as-is", "as-is"),
    *((scene, scene, "as-is", "as-is") for scene in CAPTURES),
)
SHARE = "--pipeline.model.robust-loss "


def of(scene: str, case: str, options: str = "", part: str = "") -> list[dict[str, Any]]:
    """The records of all seeds."""
    return [
        record
        for name, record in records("exposure").items()
        if name.rpartition("/")[0] == part
        and "settings" not in record
        and (record["study"]["scene"], record["case"], record["study"]["options"]) == (scene, case, options)
        and record["measured"] is not None
    ]


def mean(found: list[dict[str, Any]], metric: str) -> str:
    """Of the test views, over the seeds."""
    return f"{fmean(record['measured']['test'][metric] for record in found):.2f}" if found else "-"


def worth() -> str:
    """With and without the part."""
    body = []
    for name, scene, off, on in ROWS:
        pair = of(scene, f"{off}-off"), of(scene, f"{on}-on")
        if all(pair):
            seeds = len(pair[1])
            name += f", {seeds} seeds" if seeds > 1 else ""
            body.append([name, *(f"{mean(found, 'psnr')}/{mean(found, 'cc_psnr')}" for found in pair)])
    return grid(["PSNR/cc PSNR", "off", "on"], body)


def gap(one: str, other: str, metric: str) -> str:
    """By how many dB one case of bonsai is above another."""
    values = [fmean(r["measured"]["test"][metric] for r in of("bonsai", case)) for case in (one, other)]
    return f"{values[0] - values[1]:.1f}"


def recovered(case: str) -> str:
    """How near the exposures that were learnt are to those that were put on."""
    (record,) = of("bonsai", f"{case}-on")
    learnt = record["photographs"]
    return (
        f"correlation {learnt['correlation']:.3f}, error {learnt['rms_error_stops']:.2f} of "
        f"{learnt['rms_truth_stops']:.2f} stops, white balance {learnt['white_balance_rms_error_stops']:.2f}"
    )


def rule() -> str:
    """What photographs say before a training."""
    found = {scene: one["random"][0] for scene, one in records("exposure-rule").items()}
    off = [stops for scene, stops in found.items() if not records("exposure-rule")[scene]["learnt"]]
    on = [f"{scene} has {stops:.2f}" for scene, stops in found.items() if records("exposure-rule")[scene]["learnt"]]
    return f"{len(off)} captures have {min(off):.2f} to {max(off):.2f} stops: off; {', '.join(on)}: on"


def trimming(part: str) -> str:
    """What the robust loss changes: PSNR of fox's held-out training views."""
    said = []
    for study in ("occluded", "as-is"):
        off, on = (mean(of("fox", f"{study}-off", SHARE + share, part=part), "psnr") for share in ("0", "0.1"))
        said.append(f"{off} to {on}")
    return f"{said[0]} dB; without them {said[1]}"


BLOCKS = {f"exposure.{block.__name__}": block for block in (worth, gap, recovered, rule, trimming)}
