# SPDX-License-Identifier: Apache-2.0
"""The table of docs/web.md."""

from nrfgs_lab.pages.tables import grid, records


def page() -> str:
    """Sizes, exactness and times of a page."""
    study = records("web")
    export, browsers = study["export"], (study["chromium"], study["firefox"])

    def kilobytes(size: int) -> str:
        return f"{size / 1000:,.0f} KB"

    exact = (f"{min(one['psnr']):.1f} to {max(one['psnr']):.1f}" for one in browsers)
    load = (f"{one['seconds_to_load']:.1f} s" for one in browsers)
    picture = (f"{one['seconds_per_picture']:.2f} s" for one in browsers)
    other = study["splat-transform-html"]
    rows = [
        ["the page, and the scene in it", f"{kilobytes(export['bytes'])}, {kilobytes(export['scene_bytes'])}"],
        ["3DGS's PLY of as many splats", kilobytes(export["ply_bytes"])],
        [f"splat-transform's ({other['version']}) HTML of our PLY, which shows harmonics", kilobytes(other["bytes"])],
        ["what the scene in the page loses on the test views", f"{export['loss_db']:.3f} dB"],
        ["page against our renderer, three places; Chromium, Firefox", f"{', '.join(exact)} dB"],
        ["from the address to the first whole picture", ", ".join(load)],
        ["a picture of 800 x 500, **without a GPU**, on two busy cores", ", ".join(picture)],
    ]
    return grid([f"{export['splats']:,} splats", ""], rows)


def bonsai() -> str:
    """The page of bonsai, on a GPU."""
    study = records("web")
    export = study["bonsai-export"]
    gpus = study["bonsai-gpu-gl-egl"], study["bonsai-gpu-vulkan"]

    def megabytes(size: int) -> str:
        return f"{size / 1e6:.1f} MB"

    width, height = gpus[0]["size"]
    frames = (f"{1 / one['seconds_per_picture']:.0f}" for one in gpus)
    load = (f"{one['seconds_to_load']:.1f} s" for one in gpus)
    exact = study["bonsai-chromium"]["psnr"]
    rows = [
        ["the page, and the scene in it", f"{megabytes(export['bytes'])}, {megabytes(export['scene_bytes'])}"],
        ["3DGS's PLY of as many splats", megabytes(export["ply_bytes"])],
        ["what the scene in the page loses on the test views", f"{export['loss_db']:.3f} dB"],
        ["page against our renderer, three places; SwiftShader", f"{min(exact):.1f} to {max(exact):.1f} dB"],
        [f"pictures a second, {width} x {height}, H200; OpenGL, Vulkan", ", ".join(frames)],
        ["from the address to the first whole picture", ", ".join(load)],
    ]
    return grid([f"`bonsai`, {export['splats']:,} splats", ""], rows)
