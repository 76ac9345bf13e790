# SPDX-License-Identifier: Apache-2.0
"""`nrfgs tradeoff`: what each knob of a training buys, and what it costs.

`plan.py` turns knobs into a benchmark, `nrfgs bench` runs it, `analysis.py` compares every setting with the default and
finds the Pareto front, `report.py` writes it down.
"""
