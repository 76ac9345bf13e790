# SPDX-License-Identifier: Apache-2.0
"""Options of `nrfgs export web`. Imports next to nothing: `nrfgs --help` reads it."""

from dataclasses import dataclass


@dataclass
class WebOptions:
    """What a page says of itself."""

    title: str | None = None
    """heading of the page. None: the output's name"""
    author: str = ""
    """a line below the heading"""
