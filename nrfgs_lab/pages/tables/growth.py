# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/fewer-splats.md: which splats may go once growth has ended, and what that costs or gains."""

from statistics import fmean, median
from typing import Any

from nrfgs_lab.pages.tables import grid, records, signed

ON_BONSAI = {
    "splatfacto": "`splatfacto`",
    "splatfacto, gradient 1.6e-3": "`densify-grad-thresh` doubled",
    "consistent": "growth that several views confirm (FastGS's rule)",
    "keep 0.5, at once": "`keep 0.5`, in one round",
    "keep 0.5": "`keep 0.5`",
    "keep 0.35, three rounds": "`keep 0.35`, in three rounds",
    "4e-4": "`densify-grad-thresh` halved",
    "4e-4, keep 0.2": "halved, `keep 0.2`",
}
"""Trials, and what they are called."""
FULL = {"splatfacto": "`nrfgs`", "4e-4, keep 0.2": "`densify-grad-thresh` halved, `keep 0.2`"}
MEASURES = {"psnr": 2, "ssim": 4, "train_s": 0}
"""Numbers of a record, and their places."""
FEW = {
    "keep 0.5, three rounds": "`keep 0.5`, three rounds",
    "4e-4, keep 0.5": "`densify-grad-thresh` halved, `keep 0.5`",
    "4e-4, keep 0.25": "halved, `keep 0.25`",
}
SCENES = "castle", "kitchen", "fern", "fox", "goldcape", "caliterra"
HEADS = {"nrfgs": "field", "nrfgs-sh": "harmonics"}


def _trial(method: str, trial: str, scene: str) -> dict[str, Any] | None:
    return records("growth").get(f"{method}/{trial}/{scene}-4")


def bonsai() -> str:
    """Splats, PSNR and SSIM on bonsai, of the field and of harmonics."""
    body = []
    for trial, label in ON_BONSAI.items():
        cells = []
        for method in HEADS:
            one = _trial(method, trial, "bonsai")
            cells += [""] * 2 if one is None else [_thousands([one]), f"{one['psnr']:.2f}/{one['ssim']:.4f}"]
        body.append([label, *cells])
    return grid(["`bonsai`, held-out views", "splats", "field", "splats", "harmonics"], body)


def full() -> str:
    """Bonsai's test views, at full size."""
    body = []
    for trial, label in FULL.items():
        seeds = _on_test_views(trial)
        cells = [_thousands(seeds), *(f"{fmean(one[name] for one in seeds):.{n}f}" for name, n in MEASURES.items())]
        body.append([label, str(len(seeds)), *cells])
    return grid(["`bonsai`, test views", "seeds", "splats", "PSNR", "SSIM", "seconds of training"], body)


def cost() -> str:
    """What thinning costs there, in dB."""
    old, new = (fmean(one["psnr"] for one in _on_test_views(trial)) for trial in FULL)
    return f"{old - new:.2f}"


def captures() -> str:
    """What trials gain over splatfacto's rules on captures of few views: median dB and mean SSIM."""
    body = []
    for method, head in HEADS.items():
        for trial, label in FEW.items():
            cells = [_gain(_trial(method, trial, scene), _trial(method, "splatfacto", scene)) for scene in SCENES]
            if any(cells):
                body.append([f"{head}: {label}", *cells])
    return grid(["", *(f"`{scene}`" for scene in SCENES)], body)


def _on_test_views(trial: str) -> list[dict[str, Any]]:
    """Records of all seeds."""
    return [one for one in records("growth").values() if (one["trial"], one["offset"]) == (trial, "test")]


def _thousands(found: list[dict[str, Any]]) -> str:
    return f"{fmean(one['splats'] for one in found) / 1000:.0f}k"


def _gain(new: dict[str, Any] | None, old: dict[str, Any] | None) -> str:
    if new is None or old is None:
        return ""
    views = list(zip(sorted(new["per_image"]), sorted(old["per_image"]), strict=True))
    gain = median(one[1] - other[1] for one, other in views)
    ssim = 1000 * fmean(one[2] - other[2] for one, other in views)
    return f"{signed(gain, 2)}/{signed(ssim, 1)}/{new['splats'] / old['splats']:.2f}"
