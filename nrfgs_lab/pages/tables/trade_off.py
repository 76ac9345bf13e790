# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/trade-off.md."""

from nrfgs_lab.bench.table import Row
from nrfgs_lab.pages.tables import BY_NAME, bench_rows, grid, mean_of, records

SCENES = {"bonsai": 255, "goldcape": 74, "fox": 43, "kitchen": 21}
"""Captures and their training views."""
PRESETS = {
    "nerfstudio_splatfacto": "splatfacto (nerfstudio's own)",
    "nerfstudio_splatfacto-big": "splatfacto-big (nerfstudio's own)",
    "harmonics_nrfgs-sh": "`nrfgs-sh`",
    "preset_nrfgs-fast": "`nrfgs-fast`",
    "default": "`nrfgs`, 30,000 steps",
    "best": "`nrfgs-best`, without its mean",
}


def _rows() -> dict[tuple[str, str], Row]:
    rows = {(scene, run): row for (scene, _, run), row in bench_rows("presets").items()}
    for scene in SCENES:
        place = scene, "original", "NRF-GS"
        if place in bench_rows("comparison"):
            records_of = bench_rows("comparison")[place].records
            rows[scene, "best"] = Row(scene, "best", "original", {42: records_of[42]}).fill()
    return rows


def presets() -> str:
    """PSNR, SSIM, splats and seconds of the presets on four captures."""
    rows = _rows()
    body = []
    for run, label in PRESETS.items():
        cells = []
        for scene in SCENES:
            row = rows.get((scene, run))
            if row is None:
                cells.append("-")
                continue
            seconds = row.mean(BY_NAME["time s"])
            time = "" if seconds is None else f", {seconds:.0f} s"
            splats = f"{mean_of(row, 'splats') / 1000:.0f}k"
            cells.append(f"{mean_of(row, 'PSNR'):.2f}/{mean_of(row, 'SSIM'):.3f}, {splats}{time}")
        body.append([label, *cells])
    return grid(["PSNR/SSIM, splats, time", *(f"{scene}, {views} views" for scene, views in SCENES.items())], body)


def fast() -> str:
    """The least and the largest gain of `nrfgs-fast` over splatfacto."""
    rows = _rows()
    gains = [
        mean_of(rows[scene, "preset_nrfgs-fast"], "PSNR") - mean_of(rows[scene, "nerfstudio_splatfacto"], "PSNR")
        for scene in SCENES
    ]
    return f"{min(gains):.1f} to {max(gains):.1f}"


def fast_time() -> str:
    """The least and the largest share of splatfacto's time that `nrfgs-fast` takes."""
    rows = _rows()
    shares = [
        mean_of(rows[scene, "preset_nrfgs-fast"], "time s") / mean_of(rows[scene, "nerfstudio_splatfacto"], "time s")
        for scene in SCENES
    ]
    return f"{min(shares):.2f} to {max(shares):.2f}"


def gain(run: str, base: str, scene: str = "bonsai") -> str:
    """Decibels by which a preset is above another one."""
    rows = _rows()
    return f"{mean_of(rows[scene, run], 'PSNR') - mean_of(rows[scene, base], 'PSNR'):.1f}"


def averaging() -> str:
    """PSNR of the mean over the last steps, by their number."""
    study = records("averaging")
    runs = {
        "bonsai": "bonsai, `nrfgs`",
        "bonsai-sh": "bonsai, `nrfgs-sh`",
        "bonsai-fast": "bonsai, 10,000 steps",
        "goldcape": "goldcape, `nrfgs`",
    }
    found = {run: {one["window"]: one["psnr"] for one in study[run]["windows"]} for run in runs}
    windows = [0, 50, 200, 800, 1600]
    body = [
        ["the last step alone" if window == 0 else f"{window:,}", *(f"{found[run][window]:.2f}" for run in runs)]
        for window in windows
    ]
    return grid(["last steps", *runs.values()], body)


def averaged(run: str) -> str:
    """What the mean over the last 200 steps gains."""
    found = {one["window"]: one["psnr"] for one in records("averaging")[run]["windows"]}
    return f"{found[200] - found[0]:.2f}"
