# SPDX-License-Identifier: Apache-2.0
"""Blocks of docs/fewer-splats.md and docs/stability.md."""

import re
from statistics import fmean, median
from typing import Any

from nrfgs_lab.pages.tables.runs import grid, records, signed

FEW = {
    "keep 0.5, three rounds": "`keep 0.5`, three rounds",
    "4e-4, keep 0.5": "`densify_grad_thresh` halved, `keep 0.5`",
    "4e-4, keep 0.25": "halved, `keep 0.25`",
}
"""Trial -> label."""


def _trial(method: str, trial: str, scene: str) -> dict[str, Any] | None:
    return records("growth").get(f"{method}/{trial}/{scene}-4")


def growth_on_captures() -> str:
    """Gains of trials over splatfacto's rules on captures of few views: median dB, mean SSIM x 1000, splats."""
    scenes = "castle", "kitchen", "fern", "fox", "goldcape", "caliterra"

    def gain(new: dict[str, Any] | None, old: dict[str, Any] | None) -> str:
        if new is None or old is None:
            return ""
        views = list(zip(sorted(new["per_image"]), sorted(old["per_image"]), strict=True))
        psnr, ssim = median(one[1] - other[1] for one, other in views), fmean(one[2] - other[2] for one, other in views)
        return f"{signed(psnr, 2)}/{signed(1000 * ssim, 1)}/{new['splats'] / old['splats']:.2f}"

    body = []
    for method, head in {"nrfgs": "field", "nrfgs-sh": "harmonics"}.items():
        for trial, label in FEW.items():
            cells = [gain(_trial(method, trial, scene), _trial(method, "splatfacto", scene)) for scene in scenes]
            if any(cells):
                body.append([f"{head}: {label}", *cells])
    return grid(["", *(f"`{scene}`" for scene in scenes)], body)


def hard() -> str:
    """Hard trainings with their PSNR; ValueError if one ended with a number that is not finite."""
    runs = records("stability")["trainings"]["runs"]
    if not all(one["finite"] for seeds in runs.values() for one in seeds.values()):
        raise ValueError("A training of results/stability.json is not finite to its end.")
    single = {name: next(iter(seeds.values())) for name, seeds in runs.items() if ", unit x " not in name}
    return ", ".join(f"{name} ({one['psnr']:.1f} dB)" for name, one in single.items())


def attack() -> str:
    """Outcomes of inputs that are broken or made to mislead."""
    *_, total = records("attack")["after"]["table"].strip().splitlines()
    tried, *outcomes = map(int, re.findall(r"\d+", total))
    words = "refused in one clear sentence", "still data sets and used", "tracebacks", "wrong in silence", "hung"
    return f"{tried} inputs: {', '.join(f'{n} {word}' for n, word in zip(outcomes, words, strict=True))}"


BLOCKS = {"growth.captures": growth_on_captures, "stability.hard": hard, "stability.attack": attack}
