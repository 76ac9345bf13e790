# SPDX-License-Identifier: Apache-2.0
"""The text of a page, without a browser; test_web_browser.py opens pages."""

import base64
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest

from nrfgs_ns.appearance.nrf import NrfConfig
from nrfgs_ns.export.web.command import weight_vectors
from nrfgs_ns.export.web.page import READER, VIEWER, page

REPOSITORY = Path(__file__).parents[2]
ABOUT = {"photographs": [{"name": "</script><script>alert(1)</script>.png"}], "start": 0}


class Elements(HTMLParser):
    """Start tags with their attributes, and the text in each script by its id."""

    def __init__(self, text: str):
        super().__init__()
        self.tags: list[tuple[str, dict]] = []
        self.scripts: dict[str | None, str] = {}
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data):
        tag, attributes = self.tags[-1] if self.tags else ("", {})
        if tag == "script":
            self.scripts.setdefault(attributes.get("id"), data)


def test_a_page_needs_nothing_but_itself():
    scene = bytes(range(256)) * 10
    text = page(ABOUT, b"a picture", scene, "Tea & <cakes>", 'Me "and" you')
    elements = Elements(text)
    assert base64.b64decode(elements.scripts["packed"]) == scene
    assert json.loads(elements.scripts["about"]) == ABOUT
    assert "<h1>Tea &amp; &lt;cakes&gt;</h1>" in text and "Me &quot;and&quot; you" in text
    for _, attributes in elements.tags:
        for name in ("src", "href"):
            assert (attributes.get(name) or "data:").startswith("data:")
    policy = next(dict(attributes)["content"] for _, attributes in elements.tags if "http-equiv" in attributes)
    assert "default-src 'none'" in policy and "connect-src 'none'" in policy
    assert "{{" not in text.replace(elements.scripts["packed"], "")


def test_a_page_in_a_folder_names_its_scene():
    text = page(ABOUT, b"", "scene.nrf", "Tea")
    assert Elements(text).scripts["packed"] == "scene.nrf" and "connect-src 'self'" in text


def test_the_style_and_the_scripts_are_installed_with_the_package():
    listed = re.search(r'^"nrfgs_ns.export.web" = (\[.*\])', (REPOSITORY / "pyproject.toml").read_text(), re.M)
    patterns = json.loads(listed.group(1))
    folder = REPOSITORY / "nrfgs_ns" / "export" / "web"
    installed = {path.name for pattern in patterns for path in folder.glob(pattern)}
    assert {*READER, *VIEWER, "page.html", "page.css"} <= installed
    assert sum((folder / name).stat().st_size for name in installed) < 100_000


@pytest.mark.parametrize(
    "options, vectors",
    [
        ({}, 16 * (10 + 4) + 1 + 16 * (13 + 4) + 1),
        ({"hidden_width": 30, "num_bands": 2, "use_distance": False}, 8 * (9 + 4) + 1 + 8 * (6 + 4) + 1),
        ({"split_bands": False}, 32 * (22 + 4) + 1),
        ({"num_bands": 1}, 16 * (10 + 4) + 1),
    ],
)
def test_how_many_weights_a_view_needs(options, vectors):
    assert weight_vectors(NrfConfig(**options).setup()) == vectors
