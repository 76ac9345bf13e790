# SPDX-License-Identifier: Apache-2.0
"""The numbers of the pages are those of the records, and links lead somewhere."""

import re
from pathlib import Path

import pytest

from nrfgs_lab.pages import site, tables
from nrfgs_lab.pages.figures import FIGURES
from nrfgs_lab.pages.tables import BLOCK, BLOCKS, ROOT, SHEET, declared, pages, written

PAGES = {str(page.relative_to(ROOT)): page.read_text(encoding="utf-8") for page in pages()}
LINK = re.compile(r"\]\(([^)\s]+)\)")


@pytest.mark.parametrize("name", PAGES)
def test_numbers_are_those_of_the_records(name):
    assert PAGES[name] == written(PAGES[name]), "write them again: python -m nrfgs_lab.pages.tables --write"


@pytest.mark.parametrize("name", [name for name, text in PAGES.items() if BLOCK.search(text)])
def test_decibels_in_prose_stand_in_a_block_of_the_page(name):
    inside = " ".join(content for *_, content in BLOCK.findall(PAGES[name]))
    prose = re.sub(r"```.*?```|`[^`\n]*`", "", BLOCK.sub("", PAGES[name]), flags=re.DOTALL)
    loose = set(re.findall(r"(?<![\d.])(\d+(?:\.\d+)?) dB", prose))
    assert not loose - set(re.findall(r"\d+(?:\.\d+)?", inside))


def anchors(text: str) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    titles = re.findall(r"^#+ (.*)$", re.sub(r"```.*?```", "", text, flags=re.DOTALL), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.strip().lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("name", PAGES)
def test_links_lead_to_files_and_headings_that_are_there(name):
    page = ROOT / name
    for link in LINK.findall(re.sub(r"```.*?```", "", PAGES[name], flags=re.DOTALL)):
        path, _, anchor = link.partition("#")
        if "://" in link:
            continue
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), link
        assert target.is_relative_to(ROOT), f"{link} leads out of the repository"
        if anchor:
            assert anchor in anchors(target.read_text(encoding="utf-8")), link


def test_the_site_has_every_page_and_no_link_out_of_it():
    nav = re.findall(r"[\w-]+\.md", (ROOT / "mkdocs.yml").read_text().partition("nav:")[2])
    assert sorted(nav) == sorted(["index.md", *(path.name for path in (ROOT / "docs").glob("*.md"))])
    for text in PAGES.values():
        assert not re.search(r"\]\(\.\./", site.on_page_markdown(text))


def test_a_number_that_is_not_the_record_s_is_noticed():
    text = next(text for text in PAGES.values() if BLOCK.search(text))
    first = BLOCK.search(text)
    changed = text[: first.start(3)] + re.sub(r"\d", "7", first[3]) + text[first.end(3) :]
    assert changed != text and written(changed) == text


def test_every_block_and_picture_is_on_a_page():
    used = {match[1] + (match[2] or "") for text in PAGES.values() for match in BLOCK.finditer(text)}
    assert set(declared()) <= used
    assert set(BLOCKS) <= {name.partition("(")[0] for name in used}
    shown = {Path(link).name for text in PAGES.values() for link in LINK.findall(text)}
    assert {path.name for path in (ROOT / "docs" / "images").iterdir()} <= shown


def test_every_record_is_shown_or_used():
    """By a block, by a page that names the file, or by a test."""
    sources = [SHEET, *Path(tables.__file__).parent.glob("*.py"), *(ROOT / "tests").rglob("*.py")]
    text = "\n".join([*PAGES.values(), *(path.read_text(encoding="utf-8") for path in sources)])
    stems = {path.stem for path in (ROOT / "results").glob("*.json")}
    used = set(re.findall(r"""["']([\w-]+)["']|results/([\w-]+)\.json|[{ ]([\w-]+)\|""", text))
    assert stems <= {stem for names in used for stem in names}


@pytest.mark.parametrize("name", PAGES)
def test_files_that_a_page_names_are_there(name):
    paths = re.findall(
        r"(?<![\w/])(?:nrfgs_ns|nrfgs_lab|tests|results|docs)/[\w/.-]*\.(?:py|md|json|yaml)\b", PAGES[name]
    )
    modules = re.findall(r"python -m (nrfgs_(?:ns|lab)[\w.]*)", PAGES[name])
    paths = [path for path in paths if "NAME" not in path]
    paths += [module.replace(".", "/") for module in modules]
    assert [path for path in paths if not any((ROOT / f"{path}{end}").exists() for end in ("", ".py"))] == []


@pytest.mark.parametrize("name", FIGURES)
def test_a_figure_is_that_of_the_records(name):
    assert FIGURES[name]() == (ROOT / "docs" / "images" / name).read_text(encoding="utf-8")
