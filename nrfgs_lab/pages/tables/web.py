# SPDX-License-Identifier: Apache-2.0
"""The table of docs/web.md."""

from nrfgs_lab.pages.tables import grid, records


def pages() -> str:
    """Sizes, exactness and times of two pages: the demo's without a GPU, bonsai's with one."""
    study = records("web")
    exports = study["export"], study["bonsai-export"]
    browsers, gpus = (study["chromium"], study["firefox"]), (study["bonsai-gpu-gl-egl"], study["bonsai-gpu-vulkan"])

    def size(number: int) -> str:
        return f"{number / 1000:,.0f} KB" if number < 1e6 else f"{number / 1e6:.1f} MB"

    def range_of(numbers: list[float]) -> str:
        return f"{min(numbers):.1f} to {max(numbers):.1f}"

    def load(records) -> str:
        return ", ".join(f"{one['seconds_to_load']:.1f} s" for one in records)

    pictures = ", ".join(f"{one['seconds_per_picture']:.2f} s" for one in browsers)
    frames = ", ".join(f"{1 / one['seconds_per_picture']:.0f}" for one in gpus)
    exact = ", ".join(range_of(one["psnr"]) for one in browsers)
    width, height = gpus[0]["size"]
    rows = [
        ["the page, and the scene in it", *(f"{size(one['bytes'])}, {size(one['scene_bytes'])}" for one in exports)],
        ["3DGS's PLY of as many splats", *(size(one["ply_bytes"]) for one in exports)],
        ["what the scene loses on test views", *(f"{one['loss_db']:.3f} dB" for one in exports)],
        ["page against our renderer", f"{exact} dB", f"{range_of(study['bonsai-chromium']['psnr'])} dB"],
        ["from the address to a whole picture", load(browsers), load(gpus)],
        ["pictures", f"800 x 500: {pictures} each", f"{width} x {height}: {frames} a second"],
    ]
    names = "demo, two busy cores: Chromium, Firefox", "`bonsai`, H200: OpenGL, Vulkan"
    heads = (f"{name}; {one['splats']:,} splats" for name, one in zip(names, exports, strict=True))
    return grid(["", *heads], rows)
