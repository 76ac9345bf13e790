# SPDX-License-Identifier: Apache-2.0
"""The numbers of docs/troubleshooting.md."""

from nrfgs_lab.pages.tables import records


def start_up() -> str:
    """Seconds that importing takes."""
    return f"{records('start_up')['seconds']:.1f} s"
