# SPDX-License-Identifier: Apache-2.0
"""The tables of growth that several views confirm, in docs/bench.md."""

from collections import defaultdict
from statistics import fmean, median
from typing import Any

from nrfgs_lab.pages.tables import grid, records, signed

COUNTED = {"consistent": "of the photograph", "consistent, pixels as rendered": "as rendered"}
"""Trials, and which pixels they count."""
ON_BONSAI = {
    "splatfacto": "`splatfacto`",
    "splatfacto, gradient 1.6e-3": "`splatfacto`, `densify-grad-thresh` doubled",
    "splatfacto, gradient 2.4e-3": "the same, tripled",
    "consistent, wrong 0.05": "`consistent`, `wrong` 0.05",
    "consistent": "`consistent`",
    "consistent, 0.5 pixels": "`consistent`, `grow-pixels` 0.5",
}
"""Trials, and what they are called."""


def _trials(trial: str) -> dict[str, dict[Any, dict[str, Any]]]:
    """Records of the field on held-out training views: scene -> first held-out view -> record."""
    found: dict[str, dict[Any, dict[str, Any]]] = defaultdict(dict)
    for one in records("growth").values():
        if (one["method"], one["trial"]) == ("nrfgs", trial):
            found[one["scene"]][one["offset"]] = one
    return found


def bonsai() -> str:
    """What bonsai needs, by the rule that splats grow by."""
    body = []
    for trial, label in ON_BONSAI.items():
        one = _trials(trial)["bonsai"][4]
        body.append([label, f"{one['splats'] / 1000:.0f}k", f"{one['psnr']:.2f}", f"{one['ssim']:.4f}"])
    return grid(["`bonsai`, held-out views", "splats", "PSNR", "SSIM"], body)


def captures() -> str:
    """What the rule gains over splatfacto's on each capture."""
    base, body, done = _trials("splatfacto"), [], set()
    for trial, counted in COUNTED.items():
        for scene, trials in sorted(_trials(trial).items()):
            if scene in done:
                continue
            done.add(scene)
            pairs = [(one, base[scene][offset]) for offset, one in trials.items()]
            views = [both for pair in pairs for both in zip(*_by_name(*pair), strict=True)]
            gains = [new[1] - old[1] for new, old in views]
            ssim = 1000 * fmean(new[2] - old[2] for new, old in views)
            ratio = fmean(one["splats"] / other["splats"] for one, other in pairs)
            cells = [signed(fmean(gains), 2), signed(median(gains), 2), signed(ssim, 1), f"{ratio:.2f}"]
            body.append([f"`{scene}`", counted, str(len(gains)), *cells])
    return grid(["", "pixels", "held-out views", "dB, mean", "median", "SSIM x 1000", "splats, ratio"], body)


def _by_name(*found: dict[str, Any]) -> list[list[list]]:
    """The values of each record's views, in one order."""
    return [sorted(one["per_image"]) for one in found]
