# SPDX-License-Identifier: Apache-2.0
"""The numbers of docs/stability.md."""

import re
from statistics import fmean

from nrfgs_lab.pages.tables import grid, records

Runs = dict[str, dict]


def _trainings() -> dict[str, dict[str, Runs]]:
    """Training -> unit of length -> seed -> record."""
    rows: dict[str, dict[str, Runs]] = {}
    for name, seeds in records("stability")["trainings"]["runs"].items():
        parts = name.split(", ")
        unit = parts.pop(1).removeprefix("unit x ") if len(parts) == 3 else "1"
        rows.setdefault(", ".join(parts), {})[unit] = seeds
    return rows


def units() -> str:
    """PSNR of trainings in three units of length, the mean over seeds."""
    body = []
    for name, found in _trainings().items():
        if len(found) > 1:
            means = [fmean(one["psnr"] for one in seeds.values()) for seeds in found.values()]
            body.append([name, *(f"{mean:.2f}" for mean in means)])
    return grid(["PSNR", *next(iter(_trainings().values()))], body)


def hard() -> str:
    """The other trainings, with their PSNR.

    Raises:
        ValueError: one of them ended with a number that is not finite.
    """
    rows = _trainings()
    if not all(one["finite"] for found in rows.values() for seeds in found.values() for one in seeds.values()):
        raise ValueError("A training of results/stability.json is not finite to its end.")
    single = {name: next(iter(found["1"].values())) for name, found in rows.items() if len(found) == 1}
    return ", ".join(f"{name} ({one['psnr']:.1f} dB)" for name, one in single.items())


def attack() -> str:
    """What became of inputs that are broken or made to mislead."""
    *_, total = records("attack")["after"]["table"].strip().splitlines()
    tried, *became = map(int, re.findall(r"\d+", total))
    words = "refused in one clear sentence", "still data sets and used", "tracebacks", "wrong in silence", "hung"
    told = ", ".join(f"{count} {word}" for count, word in zip(became, words, strict=True))
    return f"{tried} inputs: {told}"
