# SPDX-License-Identifier: Apache-2.0
"""For entry points that were installed with another name of `command`: `pip install -e .` writes them anew."""

from nrfgs_ns.prepare.command import Prepare as Prepare
