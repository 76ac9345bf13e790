# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/many-gpus.md."""

from nrfgs_lab.pages.tables import grid, records


def load() -> str:
    """Speed and memory of one and two devices."""
    runs = records("many-gpus")["load"]["runs"]
    peak = [max(run["peak_memory_bytes"]) / 2**30 for run in runs]
    rows = [
        [
            str(run["devices"]),
            f"{run['images_per_second']:.1f}",
            f"{run['images_per_second'] / runs[0]['images_per_second']:.2f}",
            f"{run['step_ms']:.1f} ms",
            f"{memory:.2f} GiB",
            f"{memory / peak[0]:.2f}",
        ]
        for run, memory in zip(runs, peak, strict=True)
    ]
    return grid(["GPUs", "images a second", "of one GPU's", "step", "peak memory of a GPU", "of one GPU's"], rows)


def quality() -> str:
    """The same number of images on one and two devices."""
    rows = [
        [str(run["devices"]), f"{run['psnr']:.2f}", f"{run['ssim']:.4f}", f"{run['l1']:.5f}", f"{run['splats']:,}"]
        for run in records("many-gpus")["quality"]["runs"]
    ]
    return grid(["GPUs", "PSNR", "SSIM", "L1", "splats"], rows)
