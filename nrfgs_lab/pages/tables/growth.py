# SPDX-License-Identifier: Apache-2.0
"""The tables of growth that several views confirm, in docs/bench.md."""

from collections import defaultdict
from statistics import fmean, median
from typing import Any

from nrfgs_lab.pages.tables import grid, records, signed

HEADS = {"nrfgs": "the field", "nrfgs-sh": "harmonics"}
ON_BONSAI = {
    "splatfacto": "`splatfacto`",
    "splatfacto, gradient 1.6e-3": "`splatfacto`, `densify-grad-thresh` doubled",
    "splatfacto, gradient 2.4e-3": "the same, tripled",
    "consistent": "`consistent`",
    "consistent, wrong 0.1": "`consistent`, `wrong` 0.1",
    "consistent, wrong 0.1, 0.5 pixels": "the same, `grow-pixels` 0.5",
}
"""Trials, and what they are called."""


def _trials(method: str, trial: str) -> dict[str, dict[Any, dict[str, Any]]]:
    """Records on held-out training views: scene -> first held-out view -> record."""
    found: dict[str, dict[Any, dict[str, Any]]] = defaultdict(dict)
    for one in records("growth").values():
        if (one["method"], one["trial"]) == (method, trial) and one["offset"] != "test":
            found[one["scene"]][one["offset"]] = one
    return found


def bonsai() -> str:
    """What bonsai needs, by the rule that splats grow by."""
    body = []
    for trial, label in ON_BONSAI.items():
        one = _trials("nrfgs", trial)["bonsai"][4]
        body.append([label, f"{one['splats'] / 1000:.0f}k", f"{one['psnr']:.2f}", f"{one['ssim']:.4f}"])
    return grid(["`bonsai`, held-out views", "splats", "PSNR", "SSIM"], body)


def captures() -> str:
    """What the rule gains over splatfacto's on each capture."""
    body = []
    for method, head in HEADS.items():
        base, trials = _trials(method, "splatfacto"), _trials(method, "consistent")
        for scene in sorted(trials):
            pairs = [(one, base[scene][offset]) for offset, one in trials[scene].items() if offset in base[scene]]
            if not pairs:
                continue
            views = [(new, old) for one, other in pairs for new, old in zip(*_by_name(one, other), strict=True)]
            gains = [new[1] - old[1] for new, old in views]
            body.append(
                [
                    head,
                    f"`{scene}`",
                    str(len(gains)),
                    signed(fmean(gains), 2),
                    signed(median(gains), 2),
                    signed(1000 * fmean(new[2] - old[2] for new, old in views), 1),
                    f"{fmean(one['splats'] / other['splats'] for one, other in pairs):.2f}",
                ]
            )
    return grid(["", "", "views", "dB, mean", "median", "SSIM x 1000", "splats, ratio"], body)


def _by_name(*found: dict[str, Any]) -> list[list[list]]:
    """The values of each record's views, in one order."""
    return [sorted(one["per_image"]) for one in found]
