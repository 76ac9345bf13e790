# SPDX-License-Identifier: Apache-2.0
"""The numbers of docs/own-data.md."""

from nrfgs_lab.pages.tables import records

SCENES = "castle", "caliterra", "lund"


def walk(part: str) -> str:
    """What the steps from photographs to a file found, or the minutes that they took, start-up included."""
    record = records("newcomer")["newcomer"]
    if part == "minutes":
        return f"{record['seconds'] / 60:.1f}"
    found = record[part]
    if part == "prepare":
        return (
            f"{found['registered']} of {found['photographs']} photographs placed, {found['points']:,} points, "
            f"mean reprojection error {found['mean_reprojection_error_px']:.2f} pixels"
        )
    if part == "eval":
        return f"PSNR {found['psnr']:.2f} dB, SSIM {found['ssim']:.3f}, {found['splats']:,} splats"
    return f"{found['psnr_file']:.2f} dB, {found['loss_db']:.2f} dB less than the model"


def prepared() -> str:
    """What `nrfgs prepare` made of captures, and the seconds of two cores' own time."""
    study = records("prepare")
    found = {scene: study.get(scene) or study["matching"][scene] for scene in SCENES}
    parts = []
    for scene, one in found.items():
        seconds = sum(own for _, own in one["seconds_and_cpu_seconds"].values())
        placed = f"{scene} {one['registered']} of {one['photographs']}"
        parts.append(f"{placed}{'' if parts else ' photographs'} in {seconds:.0f} s")
    errors = [one["mean_reprojection_error_px"] for one in found.values()]
    return f"{', '.join(parts)}; mean reprojection errors of {min(errors):.2f} to {max(errors):.2f} pixels"


def loading() -> str:
    """The most that a process had for itself while it read photographs."""
    ways = {"memory": "in memory", "files, made": "with files", "nerfstudio, float32": "with nerfstudio's default"}
    peaks = {name: records("loading")["ways"][name]["peak_bytes"] / 1e9 for name in ways}
    return ", ".join(f"{peaks[name]:.2f} GB {words}" for name, words in ways.items())
