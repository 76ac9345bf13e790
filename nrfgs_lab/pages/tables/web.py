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


def bonsai(what: str) -> str:
    """Splats, or megabytes, of bonsai's file."""
    one = records("compact")["full-bonsai"]
    return {
        "splats": f"{one['splats']:,}",
        "file": f"{one['bytes'] / 1e6:.1f}",
        "ply": f"{one['ply_bytes'] / 1e6:.1f}",
    }[what]
