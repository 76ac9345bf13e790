# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/expressiveness.md."""

from nrfgs_lab.express.report import PAPER, ROWS, SETUPS, change_cells, number
from nrfgs_lab.pages.tables import grid, records

UNTOLD = "sh", "nrf-bounded", "gsnb-small"
"""Variants that the page leaves to the records."""


def models() -> str:
    """Training and held-out directions of the models, in each set-up."""
    table = records("express")["summary"]["table"]
    found = {(row["setup"], row["model"]): row for row in table}
    body = []
    for model, label in ROWS.items():
        if model in UNTOLD:
            continue
        cells = [label]
        for setup in SETUPS:
            row = found.get((setup, model))
            cells.append(f"{_tight(row, 'train_psnr')} / {_short(row, 'held_out_psnr')}" if row else "-")
        body.append(cells)
    for model, place in (("sh", 0), ("nrf", 1)):
        figures = (str(PAPER[setup][place]) for setup in SETUPS)
        body.append([f"*the paper's {'SH' if model == 'sh' else 'NRF'}*", *figures])
    return grid(["training/held-out directions", *SETUPS.values()], body)


def _tight(row: dict, key: str) -> str:
    return number(row, key).replace(" ", "")


def _short(row: dict, key: str) -> str:
    return number(row, key).split(" ± ")[0]


def variation(text: str) -> str:
    """PSNR of the field on training directions, in a variation of the study."""
    lines = change_cells(records("express")["summary"])
    (found,) = (line[4] for line in lines if line[1] == text)
    return found
