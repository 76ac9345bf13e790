# SPDX-License-Identifier: Apache-2.0
"""The text of a page, without a browser; test_web_browser.py opens pages."""

import base64
import json
import re
from html.parser import HTMLParser

import pytest

from nrfgs_ns.errors import InputError
from nrfgs_ns.export.web.guide import read_notes, read_tour
from nrfgs_ns.export.web.page import page

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
    scene = bytes(range(256)) * 5000  # in two parts
    elements = Elements(text := page(ABOUT, b"a picture", scene, "Tea & <cakes>", 'Me "and" you'))
    first, second = re.findall(r'<script[^>]* type="text/plain">([^<]*)</script>', text)
    assert base64.b64decode(first + second) == scene
    assert json.loads(elements.scripts["about"]) == ABOUT
    assert "<h1>Tea &amp; &lt;cakes&gt;</h1>" in text and "Me &quot;and&quot; you" in text
    addresses = [attributes.get(name) or "data:" for _, attributes in elements.tags for name in ("src", "href")]
    assert all(address.startswith("data:") for address in addresses)
    policy = next(dict(attributes)["content"] for _, attributes in elements.tags if "http-equiv" in attributes)
    assert "default-src 'none'" in policy and "connect-src 'none'" in policy and "{{" not in text


def test_a_page_in_a_folder_names_its_scene():
    text = page(ABOUT, b"", "scene.nrf", "Tea")
    assert Elements(text).scripts["packed"] == "scene.nrf" and "connect-src 'self'" in text


def test_the_code_of_a_page_is_small():
    """What a reader downloads besides the scene and the picture; without comments and indentation, with the licence."""
    text = page({}, b"", b"", "")
    assert len(text.encode()) <= 100_000
    assert not re.search(r"^(?: |// (?!SPDX))", text, re.M) and "SPDX-License-Identifier" in text


NAMES = ["a.jpg", "b.jpg", "7.jpg"]
POSE = [1, 0, 0, 10, 0, 1, 0, 20, 0, 0, 1, 30, 0, 0, 0, 1]
FRAMES = [{"camera_to_world": POSE, "fov": 50 + k, "aspect": 1.5} for k in range(24)]
PATH = {"camera_type": "perspective", "seconds": 1.0, "is_cycle": False, "camera_path": FRAMES}
CAMERA = {"position": [1, 2, 3], "target": [0, 0, 0]}


def test_a_tour_of_photographs_or_of_a_camera_path(tmp_path):
    assert read_tour([], NAMES) is None
    assert read_tour(["2", "a.jpg", "7.jpg"], NAMES) == {"views": [1, 0, 2]}
    file = tmp_path / "path.json"
    for cycle in (False, True):
        file.write_text(json.dumps(PATH | {"is_cycle": cycle}))
        tour = read_tour([str(file)], NAMES)
        assert (tour["seconds"], tour["loop"]) == (1.0, cycle)
        assert [v["fov"] for v in tour["views"]] == ([50, 55, 60, 64, 69, 50] if cycle else [50, 55, 59, 64, 68, 73])
        assert tour["views"][0]["matrix"] == [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 10, 20, 30, 1], "column by column"
    file.write_text(json.dumps({"tour": [CAMERA, CAMERA]}))
    assert read_tour([str(file)], NAMES) == {"views": [CAMERA, CAMERA]}


@pytest.mark.parametrize("content, said", [
    (None, "notes.json"), ("[", "JSON"), ({}, "camera_path"), ({"tour": [CAMERA]}, "two views"),
    ({"tour": [CAMERA, {}]}, r"tour\[1\].position"), ({"tour": [CAMERA, CAMERA | {"target": [1, 2, 3]}]}, "equal"),
    *(({"tour": [CAMERA, CAMERA | {"position": [1, 2, bad]}]}, "position") for bad in (float("nan"), 10**400)),
    ({"tour": [CAMERA, CAMERA | {"up": [0, 1]}]}, r"tour\[1\].up"),
    ({"tour": [CAMERA, {"matrix": [2] * 16}]}, "be a rotation"), ({"tour": [CAMERA | {"matrix": POSE}] * 2}, "alone"),
    ({"tour": [CAMERA, CAMERA | {"fov": 40, "aspect": 0}]}, r"tour\[1\].aspect is 0"),
    (PATH | {"camera_type": "fisheye"}, "fisheye"),
    (PATH | {"camera_path": [FRAMES[0], FRAMES[1] | {"fov": 180}]}, "fov is 180"),
    (PATH | {"camera_path": [FRAMES[0], FRAMES[1] | {"camera_to_world": POSE[:12]}]}, "camera_to_world"),
    (PATH | {"camera_path": [FRAMES[0], {"camera_to_world": POSE}]}, "fov"),
])  # fmt: skip
def test_a_tour_that_cannot_be_used_is_refused(content, said, tmp_path):
    file = tmp_path / "notes.json"
    if content is not None:
        file.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(InputError, match=said):
        read_tour([str(file)], NAMES)
    with pytest.raises(InputError, match="notes.json"):
        read_notes(file)


@pytest.mark.parametrize("words", [["1"], ["1", "4"], ["0", "1"], ["1", "c.jpg"]])
def test_photographs_that_are_not_there_are_refused(words):
    with pytest.raises(InputError, match="--tour"):
        read_tour(words, NAMES)


@pytest.mark.parametrize("note, said", [
    ({}, "text"), ({"text": "x"}, "position"), ({"text": "x", "position": [0, 0, 0], "camera": {}}, "camera"),
])  # fmt: skip
def test_notes_that_cannot_be_used_are_refused(note, said, tmp_path):
    (tmp_path / "notes.json").write_text(json.dumps({"notes": [note]}))
    with pytest.raises(InputError, match=said):
        read_notes(tmp_path / "notes.json")
