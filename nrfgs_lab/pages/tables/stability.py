# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/stability.md."""

from statistics import fmean

from nrfgs_lab.pages.tables import grid, records


def trainings() -> str:
    """Hard trainings; those in three units of length in one row."""
    rows: dict[str, dict[str, dict]] = {}
    for name, seeds in records("stability")["trainings"]["runs"].items():
        parts = name.split(", ")
        unit = parts.pop(1).removeprefix("unit x ") if len(parts) == 3 else "1"
        rows.setdefault(", ".join(parts), {})[unit] = seeds
    body = []
    for name, units in rows.items():
        means = [fmean(one["psnr"] for one in seeds.values()) for seeds in units.values()]
        runs = [one for seeds in units.values() for one in seeds.values()]
        finite = "yes" if all(one["finite"] for one in runs) else "NO"
        body.append([name, str(len(runs)), ", ".join(f"{mean:.2f}" for mean in means), finite])
    return grid(["training", "runs", "PSNR", "all finite"], body)


def attack() -> str:
    """What became of inputs that are broken or made to mislead."""
    return records("attack")["after"]["table"]
