# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/expressiveness.md."""

from nrfgs_lab.express.report import PAPER, ROWS, SETUPS, change_cells, number
from nrfgs_lab.pages.tables import grid, records

TOLD = {
    "synthetic": ("192 directions", "samples mix 8 factors", "each sample is one grey lobe"),
    "measured, pixels": ("a quarter of the passes", "192 directions"),
    "measured, image": ("four times the passes", "without the glossiest quarter of the materials"),
}
"""Set-up -> variations that docs/expressiveness.md speaks of."""


def models() -> str:
    """Training and held-out directions of every model, in each set-up."""
    table = records("express")["summary"]["table"]
    found = {(row["setup"], row["model"]): row for row in table}
    body = []
    for model, label in ROWS.items():
        cells = [label]
        for setup in SETUPS:
            row = found.get((setup, model))
            cells.append(f"{number(row, 'train_psnr')} / {_short(row, 'held_out_psnr')}" if row else "-")
        body.append(cells)
    for model, place in (("sh", 0), ("nrf", 1)):
        figures = (f"{PAPER[setup][place]} / -" for setup in SETUPS)
        body.append([f"*the paper's {'SH' if model == 'sh' else 'NRF'}*", *figures])
    return grid(["training / held-out directions", *SETUPS.values()], body)


def _short(row: dict, key: str) -> str:
    return number(row, key).split(" ± ")[0]


def variations() -> str:
    """What moves harmonics and field, of the variations that the page speaks of."""
    lines = change_cells(records("express")["summary"])
    body = [line for setup, texts in TOLD.items() for line in lines if line[0] == setup and line[1] in texts]
    head = [
        "set-up",
        "what differs",
        "SH, least squares",
        "best linear code",
        "NRF",
        "four times the passes",
        "held-out",
    ]
    return grid(head, body)
