# SPDX-License-Identifier: Apache-2.0
"""From records to the tables."""

import json
from collections import defaultdict
from statistics import mean, stdev
from typing import Any

from rich.table import Table

ROWS = {
    "sh-lsq": "SH degree 3, least squares",
    "sh": "SH degree 3, Adam",
    "nrf": "NRF (one network)",
    "nrf-2-bands": "NRF, 2 bands instead of 4",
    "nrf-bounded": "NRF, residual within 0.2",
    "nrf-split": "NRF as the head (split, within 0.2)",
    "sg": "spherical Gaussians, 6 lobes",
    "gsnb": "GSNB, 48 coefficients",
    "gsnb-small": "GSNB, degree 2, within the budget",
    "vdgs-like": "VDGS-like factors on SH degree 2",
    "linear": "best linear code of 35 numbers",
}
SETUPS = {"synthetic": "synthetic", "pixels": "measured, pixels", "image": "measured, image"}
PAPER = {"synthetic": (21.1, 29.0), "pixels": (27.8, 28.8), "image": (31.3, 31.9)}
"""The paper's PSNR of harmonics and field, on the directions that were trained on."""
CHANGES = {
    "": "nothing",
    "small": "an image of a quarter the edge; the same below",
    "four-times-passes": "four times the passes",
    "quarter-passes": "a quarter of the passes",
    "method-rates": "the method's learning rates, 0.0025 and 0.001",
    "zero-output": "output layer starts at zero",
    "wide-latents": "latents start with deviation 1, not 0.1",
    "whole-batch": "all samples in one batch",
    "directions-24": "24 directions",
    "directions-48": "48 directions",
    "directions-192": "192 directions",
    "scattered": "random directions",
    "decaying": "degree l has deviation 1 / (1 + l)^2",
    "degrees-4-and-5": "degrees 4 and 5 only",
    "degree-5": "degree 5 only",
    "grey": "the three channels are equal",
    "factors-8": "samples mix 8 factors",
    "factors-16": "samples mix 16 factors",
    "factors-32": "samples mix 32 factors",
    "factors-64": "samples mix 64 factors",
    "lobe": "each sample is one coloured lobe",
    "grey-lobe": "each sample is one grey lobe",
    "matter": "without the glossiest quarter of the materials",
    "one-material-0.25": "one material, glossier than a quarter",
    "one-material-0.5": "one material, glossier than a half",
    "one-material-0.75": "one material, glossier than three quarters",
}
"""What a variation changes: first how the field is fitted, then what is fitted."""
EXACT = 100.0
"""PSNR in dB from which a fit counts as exact: float32 colours of order 1 carry errors of 1e-7 or so."""
MEASURES = ("train_psnr", "held_out_psnr", "train_psnr_clamped", "held_out_psnr_clamped", "seconds")


def summarise(records: list[dict[str, Any]]) -> dict[str, Any]:
    """Mean and sample deviation over seeds of everything but the trials of rates, and what all of it took."""
    groups: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for record in records:
        groups[record["name"].rsplit("-seed", 1)[0]].append(record)
    rows: dict[str, list[dict[str, Any]]] = {"main": [], "vary": [], "sweep": []}
    for name, group in groups.items():
        settings = group[0]["settings"]
        if settings["group"] not in rows:
            continue
        row: dict[str, Any] = {"name": name, "setup": settings["setup"], "model": settings["label"]}
        row |= {"seeds": len(group), "rates": rates(group[0])}
        row |= {key: group[0].get(key) for key in ("parameters", "numbers_per_sample", "shared", "samples")}
        for key in MEASURES:
            values = [record[key] for record in group if key in record]
            if values:
                row[key] = {"mean": mean(values), "deviation": stdev(values) if len(values) > 1 else None}
        rows[settings["group"]].append(row)
    order = [(setup, label) for setup in SETUPS for label in ROWS]
    effort = {
        setup: {
            "fits": len(mine := [record for record in records if record["settings"]["setup"] == setup]),
            "seconds": sum(record.get("seconds", 0.0) for record in mine),
        }
        for setup in SETUPS
    }
    machines = {json.dumps(record["machine"], sort_keys=True) for record in records}
    return {
        "paper": {setup: dict(zip(("sh", "nrf"), PAPER[setup], strict=True)) for setup in PAPER},
        "table": sorted(rows["main"], key=lambda row: order.index((row["setup"], row["model"]))),
        "variations": rows["vary"],
        "sweep": rows["sweep"],
        "effort": effort,
        "machines": [json.loads(text) for text in sorted(machines)],
    }


def rates(record: dict[str, Any]) -> list[float] | None:
    """Learning rates of samples and shared weights, if the record's fit had any."""
    fit = record["settings"]["fit"]
    return None if fit is None else [fit["sample_lr"], fit["shared_lr"]]


def number(row: dict[str, Any], key: str) -> str:
    """Mean +- deviation in dB; above EXACT only rounding is left."""
    if key not in row:
        return "-"
    if row[key]["mean"] > EXACT:
        return "exact"
    deviation = row[key]["deviation"]
    return f"{row[key]['mean']:.2f}" + ("" if deviation is None else f" ± {deviation:.2f}")


def paper(setup: str, label: str) -> str:
    """The paper's figure for this row."""
    return {"sh": f"{PAPER[setup][0]:.1f}", "nrf": f"{PAPER[setup][1]:.1f}"}.get(label, "")


def cells(summary: dict[str, Any]) -> list[list[str]]:
    """The table as text, row by row."""
    return [
        [
            SETUPS[row["setup"]],
            ROWS[row["model"]],
            "-" if row["parameters"] is None else f"{row['parameters']:,}",
            str(row["seeds"]),
            number(row, "train_psnr"),
            number(row, "held_out_psnr"),
            paper(row["setup"], row["model"]),
        ]
        for row in summary["table"]
    ]


HEADINGS = ["set-up", "model", "parameters", "seeds", "training directions", "held-out directions", "paper"]


def change_cells(summary: dict[str, Any]) -> list[list[str]]:
    """What each variation does to harmonics, to the bound of linear codes and to the field, row by row."""
    found = {row["name"]: row for row in summary["table"] + summary["variations"]}
    lines = []
    for setup in SETUPS:
        for what, text in CHANGES.items():
            names = {label: f"{setup}-vary-{label}-{what}" for label in ("sh-lsq", "linear", "nrf", "nrf-more")}
            if not what:
                names = {label: f"{setup}-{label}" for label in ("sh-lsq", "linear", "nrf")}
                if setup != "image":  # which is varied at another size
                    names["nrf-more"] = f"{setup}-vary-nrf-four-times-passes"
            row = {label: found.get(names.get(label), {}) for label in ("sh-lsq", "linear", "nrf", "nrf-more")}
            if row["nrf"] or row["sh-lsq"]:
                numbers = [number(row[label], "train_psnr") for label in ("sh-lsq", "linear", "nrf", "nrf-more")]
                lines.append([SETUPS[setup], text, *numbers, number(row["nrf"], "held_out_psnr")])
    return lines


CHANGE_HEADINGS = [
    "set-up",
    "what differs",
    "SH, least squares",
    "best linear code of 35 numbers",
    "NRF",
    "NRF, four times the passes",
    "NRF, held-out directions",
]


def markdown(summary: dict[str, Any]) -> str:
    """The two tables for the documentation."""
    main = [HEADINGS, ["---"] * len(HEADINGS), *cells(summary)]
    changes = [CHANGE_HEADINGS, ["---"] * len(CHANGE_HEADINGS), *change_cells(summary)]
    return "\n".join("".join(f"| {' | '.join(line)} |\n" for line in lines) for lines in (main, changes))


def table(summary: dict[str, Any]) -> Table:
    """The table for the terminal."""
    result = Table(title="PSNR in dB")
    for heading in HEADINGS:
        result.add_column(heading, justify="left" if heading in ("set-up", "model") else "right")
    for line in cells(summary):
        result.add_row(*line)
    return result
