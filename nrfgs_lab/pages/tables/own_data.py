# SPDX-License-Identifier: Apache-2.0
"""The table and the numbers of docs/own-data.md."""

from nrfgs_lab.pages.tables import grid, records

SCENES = {"castle": "castle", "caliterra": "caliterra", "lund": "lund (29 steps straight ahead)", "fox": "fox"}


def prepared() -> str:
    """What `nrfgs prepare` made of captures, and what matching every pair takes."""
    study = records("prepare")
    body = []
    for scene, label in SCENES.items():
        for name, record in (
            (label, study.get(scene) or study["matching"][scene]),
            (f"{label}, every pair", study["matching"].get(f"{scene}, every pair")),
        ):
            if record is None:
                continue
            stages = record.get("seconds_and_cpu_seconds")
            seconds = f"{sum(own for _, own in stages.values()):.0f}" if stages else "-"
            registered = f"{record['registered']} of {record['photographs']}"
            pairs = f"{record['pairs']:,}" if "pairs" in record else "every one"
            error = f"{record['mean_reprojection_error_px']:.2f} px"
            body.append([name, registered, pairs, f"{record['points']:,}", error, seconds])
    return grid(["", "registered", "pairs", "points", "mean reprojection error", "CPU seconds"], body)


def loading() -> str:
    """The most that a process had for itself while it read photographs."""
    ways = {"memory": "in memory", "files, made": "with files", "nerfstudio, float32": "with nerfstudio's default"}
    peaks = {name: records("loading")["ways"][name]["peak_bytes"] / 1e9 for name in ways}
    return ", ".join(f"{peaks[name]:.2f} GB {words}" for name, words in ways.items())
