# SPDX-License-Identifier: Apache-2.0
"""`nrfgs inspect`: what each part of a trained field is worth, and what it costs.

`ablate.py` leaves parts out and measures, `report.py` says it in a table, a figure and a sentence, `command.py` is the
command.
"""
