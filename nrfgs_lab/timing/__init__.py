# SPDX-License-Identifier: Apache-2.0
"""Scripts that measure speed: `python -m nrfgs_lab.timing.NAME --help`."""
