# SPDX-License-Identifier: Apache-2.0
"""Blocks of docs/exposure.md and docs/stability.md."""

import re
from statistics import fmean

from nrfgs_lab.pages.runs import grid, records


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
    "stability.hard": hard,
    "stability.attack": attack,
}
