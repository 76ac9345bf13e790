# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/expressiveness.md."""

from typing import Any

from nrfgs_lab.pages.tables import grid, records

ROWS = {
    "sh-lsq": "SH degree 3, least squares",
    "nrf": "NRF (one network)",
    "nrf-2-bands": "NRF, 2 bands instead of 4",
    "nrf-split": "NRF as the head (split, within 0.2)",
    "sg": "spherical Gaussians, 6 lobes",
    "gsnb": "GSNB, 48 coefficients",
    "vdgs-like": "VDGS-like factors on SH degree 2",
    "linear": "best linear code of 35 numbers",
}
SETUPS = {"synthetic": "synthetic", "pixels": "measured, pixels", "image": "measured, image"}


def models() -> str:
    """Training and held-out directions of the models, in each set-up."""
    summary = records("express")["summary"]
    rows = {(row["setup"], row["model"]): row for row in summary["table"]}
    body = []
    for model, label in ROWS.items():
        cells = [
            f"{_number(row, 'train_psnr')} / {_number(row, 'held_out_psnr').split('±')[0]}"
            if (row := rows.get((setup, model)))
            else "-"
            for setup in SETUPS
        ]
        body.append([label, *cells])
    for model in ("sh", "nrf"):
        body.append([f"*the paper's {model.upper()}*", *(str(summary["paper"][setup][model]) for setup in SETUPS)])
    return grid(["training/held-out directions", *SETUPS.values()], body)


def _number(row: dict[str, Any], key: str) -> str:
    """Mean and deviation over seeds."""
    if key not in row:
        return "-"
    deviation = row[key]["deviation"]
    return f"{row[key]['mean']:.2f}" + ("" if deviation is None else f"±{deviation:.2f}")


VARIATIONS = {"samples mix 8 factors": "factors-8", "each sample is one grey lobe": "grey-lobe"}


def variation(text: str) -> str:
    """PSNR of the field on training directions, in a variation of the study."""
    name = f"synthetic-vary-nrf-{VARIATIONS[text]}"
    (row,) = (row for row in records("express")["summary"]["variations"] if row["name"] == name)
    return _number(row, "train_psnr")
