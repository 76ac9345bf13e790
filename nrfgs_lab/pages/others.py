# SPDX-License-Identifier: Apache-2.0
"""Blocks of docs/exposure.md, docs/fewer-splats.md and docs/stability.md."""

import re
from statistics import fmean, median
from typing import Any

from nrfgs_lab.pages.runs import grid, records, signed

FEW = {
    "keep 0.5, three rounds": "`keep 0.5`, three rounds",
    "4e-4, keep 0.5": "`densify_grad_thresh` halved, `keep 0.5`",
    "4e-4, keep 0.25": "halved, `keep 0.25`",
}
"""Trial -> label."""


def growth_on_captures() -> str:
    """Gains of trials over splatfacto's rules on captures of few views: median dB, mean SSIM x 1000, splats."""
    scenes, trials = ("castle", "kitchen", "fern", "fox", "goldcape", "caliterra"), records("growth")

    def gain(new: dict[str, Any] | None, old: dict[str, Any] | None) -> str:
        if new is None or old is None:
            return ""
        views = list(zip(sorted(new["per_image"]), sorted(old["per_image"]), strict=True))
        psnr, ssim = median(one[1] - other[1] for one, other in views), fmean(one[2] - other[2] for one, other in views)
        return f"{signed(psnr, 2)}/{signed(1000 * ssim, 1)}/{new['splats'] / old['splats']:.2f}"

    body = []
    for method, head in {"nrfgs": "field", "nrfgs-sh": "harmonics"}.items():
        for trial, label in FEW.items():
            pairs = [[trials.get(f"{method}/{name}/{scene}-4") for name in (trial, "splatfacto")] for scene in scenes]
            cells = [gain(*pair) for pair in pairs]
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


EXPOSURES = {
    "bonsai, varied": ("bonsai", "varied", "varied"),
    "bonsai, varied, EXIF tells": ("bonsai", "varied", "told"),
    "bonsai as it is": ("bonsai", "as-is", "as-is"),
    **{
        scene: (scene, "as-is", "as-is")
        for scene in ("lund", "fern", "fox", "castle", "caliterra", "goldcape", "kitchen")
    },
}
"""Row -> capture, and its photographs without and with learning."""


def exposure() -> str:
    """PSNR of test views without and with learnt exposure, mean over seeds."""
    body = []
    for label, (scene, off, on) in EXPOSURES.items():
        pair = [_exposure_tests(scene, case) for case in (f"{off}-off", f"{on}-on")]
        label += f", {len(pair[1])} seeds" if len(pair[1]) > 1 else ""
        means = [[fmean(test[metric] for test in tests) for metric in ("psnr", "cc_psnr")] for tests in pair]
        body.append([label, *("{:.2f}/{:.2f}".format(*values) for values in means)])
    return grid(["PSNR/cc PSNR", "off", "on"], body)


def _exposure_tests(scene: str, case: str) -> list[dict[str, float]]:
    """Metrics of test views, a mapping for each seed."""
    return [
        record["measured"]["test"]
        for name, record in records("exposure").items()
        if name.rpartition("-")[0] == f"{scene}-{case}" and record["measured"]
    ]


def exposure_rule() -> str:
    """Random exposure of captures, and what a training decides."""
    captures = {name[5:]: one for name, one in records("exposure").items() if name.startswith("rule/")}
    off = [one["random"][0] for one in captures.values() if not one["learnt"]]
    on = [f"{scene} has {one['random'][0]:.2f}" for scene, one in captures.items() if one["learnt"]]
    return f"{len(off)} captures have {min(off):.2f} to {max(off):.2f} stops: off; {', '.join(on)}: on"


BLOCKS = {
    "exposure.worth": exposure,
    "exposure.rule": exposure_rule,
    "growth.captures": growth_on_captures,
    "stability.hard": hard,
    "stability.attack": attack,
}
