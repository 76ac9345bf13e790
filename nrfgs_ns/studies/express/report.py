# SPDX-License-Identifier: Apache-2.0
"""From records to the table."""

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
MEASURES = ("train_psnr", "held_out_psnr", "train_psnr_clamped", "held_out_psnr_clamped", "seconds")


def summarise(records: list[dict[str, Any]]) -> dict[str, Any]:
    """Main table (mean and sample deviation over seeds), chosen rates, variations and sweep, without the records."""
    rows: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for record in records:
        if record["settings"]["group"] == "main":
            rows[record["settings"]["setup"], record["settings"]["label"]].append(record)
    table = []
    for setup in SETUPS:
        for label in ROWS:
            group = rows.get((setup, label), [])
            if not group:
                continue
            row: dict[str, Any] = {"setup": setup, "model": label, "seeds": len(group)}
            row |= {key: group[0].get(key) for key in ("parameters", "numbers_per_sample", "shared", "samples")}
            row["rates"] = rates(group[0])
            for key in MEASURES:
                values = [record[key] for record in group if key in record]
                if values:
                    row[key] = {"mean": mean(values), "deviation": stdev(values) if len(values) > 1 else None}
            table.append(row)
    others = [
        {
            "name": record["name"],
            "rates": rates(record),
            **{key: record[key] for key in ("parameters", *MEASURES) if key in record},
        }
        for record in records
        if record["settings"]["group"] in ("vary", "sweep")
    ]
    return {
        "paper": {setup: dict(zip(("sh", "nrf"), PAPER[setup], strict=True)) for setup in PAPER},
        "table": table,
    } | {
        "others": others,
        "machine": records[-1]["machine"] if records else None,
    }


def rates(record: dict[str, Any]) -> list[float] | None:
    """Learning rates of samples and shared weights, if the record's fit had any."""
    fit = record["settings"]["fit"]
    return None if fit is None else [fit["sample_lr"], fit["shared_lr"]]


def number(row: dict[str, Any], key: str) -> str:
    """Mean +- deviation in dB."""
    if key not in row:
        return "-"
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
            number(row, "train_psnr"),
            number(row, "held_out_psnr"),
            paper(row["setup"], row["model"]),
        ]
        for row in summary["table"]
    ]


HEADINGS = ["set-up", "model", "parameters", "training directions", "held-out directions", "paper"]


def markdown(summary: dict[str, Any]) -> str:
    """The table for the documentation."""
    lines = [HEADINGS, ["---"] * len(HEADINGS), *cells(summary)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def table(summary: dict[str, Any]) -> Table:
    """The table for the terminal."""
    result = Table(title="PSNR in dB")
    for heading in HEADINGS:
        result.add_column(heading, justify="left" if heading in ("set-up", "model") else "right")
    for line in cells(summary):
        result.add_row(*line)
    return result
