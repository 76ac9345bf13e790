# SPDX-License-Identifier: Apache-2.0
"""The page's text: a template, its style and scripts, a scene in the compact format, and what the scripts must know."""

import base64
import html
import json
import re
from importlib.resources import files
from typing import Any

READER = ("compact.js", "order.js")
"""Scripts that also run in a worker."""
VIEWER = ("field.js", "draw.js", "camera.js", "people.js", "interface.js", "app.js")

PART, NEXT = 3 * 2**18, '</script><script type="text/plain">'
"""Bytes of a scene in one element, and what is between two."""


def page(
    about: dict[str, Any], poster: bytes, scene: bytes | str, title: str, author: str = "", preview: str = ""
) -> str:
    """The HTML of a page that shows a scene.

    Args:
        about: the scripts' values (`command.surroundings`).
        poster: a JPEG for the time of loading.
        scene: a compact file's bytes, or the name of one beside the page.
        title, author: plain text.
        preview: the address of a picture that messengers and search engines may show with the page's.
    """
    beside = isinstance(scene, str)
    tags = {"og:type": "website", "og:title": title, "og:description": author, "og:image": preview}
    parts = {
        "connect": "'self'" if beside else "'none'",
        "title": html.escape(title),
        "byline": f"<p>{html.escape(author)}</p>" if author else "",
        "preview": "\n".join(f'<meta property="{n}" content="{html.escape(v)}">' for n, v in tags.items() if v),
        "poster": "data:image/jpeg;base64," + base64.b64encode(poster).decode(),
        "style": _asset("page.css"),
        "reader": "".join(map(_asset, READER)),
        "viewer": "".join(map(_asset, VIEWER)),
        # In a script element only "</" could end it.
        "about": json.dumps(about, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"),
        "packed": html.escape(scene) if beside else _in_parts(scene),
    }
    return re.sub(r"{{(\w+)}}", lambda place: parts[place[1]], _asset("page.html"))


def _in_parts(scene: bytes) -> str:
    """In base64, over several elements: a browser takes a few times the memory of one while it reads it."""
    return NEXT.join(base64.b64encode(scene[at : at + PART]).decode() for at in range(0, len(scene), PART))


def _asset(name: str) -> str:
    """A file of this folder without indentation and comments. The licence is in page.html."""
    return re.sub(r"^ *//.*\n|^ +|^\n|  //.*", "", (files(__package__) / name).read_text(encoding="utf-8"), flags=re.M)
