# SPDX-License-Identifier: Apache-2.0
"""`nrfgs express`: how much directional detail a splat can hold, without geometry or rasterization.

`targets.py` makes colours over directions, `models.py` holds what is fitted to them, `fit.py` fits, `plan.py` says
which model of which size is fitted to what, `command.py` runs the plan and writes records, `report.py` makes the table
from them and `figures.py` the pictures.
"""
