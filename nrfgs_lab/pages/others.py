# SPDX-License-Identifier: Apache-2.0
"""Blocks of docs/exposure.md and docs/troubleshooting.md."""

import re

from nrfgs_lab.pages.runs import mean, records, signed


def attack() -> str:
    """Outcomes of inputs that are broken or made to mislead."""
    *_, total = records("attack")["after"]["table"].strip().splitlines()
    tried, *outcomes = map(int, re.findall(r"\d+", total))
    words = "refused in one clear sentence", "still data sets and used", "tracebacks", "wrong in silence", "hung"
    return f"{tried} inputs: {', '.join(f'{n} {word}' for n, word in zip(outcomes, words, strict=True))}"


def exposure_gain(scene: str, off: str, on: str) -> str:
    """Gain in PSNR of test views, and colour-corrected, by learnt exposure, mean over seeds."""
    tests: dict[str, list[dict[str, float]]] = {f"{scene}-{off}": [], f"{scene}-{on}": []}
    for name, record in records("exposure").items():
        if (case := name.rpartition("-")[0]) in tests and record["measured"]:
            tests[case].append(record["measured"]["test"])
    theirs, ours = tests.values()
    psnr, corrected = (signed(mean(ours, metric) - mean(theirs, metric), 2) for metric in ("psnr", "cc_psnr"))
    return f"{psnr} dB, {corrected} colour-corrected"


def exposure_rule() -> str:
    """Random exposure of captures, and what a training decides."""
    captures = {name[5:]: one for name, one in records("exposure").items() if name.startswith("rule/")}
    off = [one["random"][0] for one in captures.values() if not one["learnt"]]
    on = [f"{scene} has {one['random'][0]:.2f}" for scene, one in captures.items() if one["learnt"]]
    return f"{len(off)} captures have {min(off):.2f} to {max(off):.2f} stops: off; {', '.join(on)}: on"


BLOCKS = {"exposure.gain": exposure_gain, "exposure.rule": exposure_rule, "troubleshooting.attack": attack}
