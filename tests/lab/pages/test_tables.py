# SPDX-License-Identifier: Apache-2.0
"""The numbers of the pages are those of the records, and links lead somewhere."""

import re
from pathlib import Path

import pytest

from nrfgs_lab.pages import tables
from nrfgs_lab.pages.few_views import runs_of
from nrfgs_lab.pages.methods import gain, half
from nrfgs_lab.pages.runs import VIEWS
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


def test_verdicts_in_words_are_those_of_the_records():
    """How many captures docs/comparison.md and README.md say that methods are ahead on."""

    def ahead(runs, ours: str, theirs: str, metric: str = "psnr", scenes=tuple(VIEWS)) -> int:
        return sum(round(gain(runs(scene, ours), runs(scene, theirs), metric), 3) > 0 for scene in scenes)

    def equal(budget: int):
        return lambda scene, run: half(scene, run, f"mcmc@{budget}")

    few = [scene for scene in VIEWS if scene != "bonsai"]
    every = len(VIEWS)
    larger, smaller = equal(150_000), equal(75_000)
    assert ahead(half, "NRF-GS", "3DGS", scenes=few) == ahead(half, "VDGS", "NRF-GS", scenes=few) == 5
    assert ahead(larger, "NRF-GS", "3DGS", scenes=few) == 3 and ahead(smaller, "NRF-GS", "3DGS", scenes=few) == 2
    assert ahead(half, "ours", "3DGS") == every and ahead(half, "ours", "3DGS", "ssim") == every - 1
    assert ahead(larger, "ours", "3DGS") == 5 and ahead(larger, "ours", "3DGS", scenes=few) == 4
    assert ahead(smaller, "ours", "3DGS") == ahead(smaller, "ours", "3DGS", scenes=["bonsai", "goldcape"]) == 2
    assert ahead(smaller, "ours", "3DGS", scenes=few) == 1
    assert sum(gain(larger(scene, "3DGS"), half(scene, "ours"), "psnr") > 0 for scene in VIEWS) == 3
    assert ahead(runs_of, "nrfgs", "splatfacto") == ahead(runs_of, "nrfgs", "splatfacto", "ssim") == every
    field, harmonics = "nrfgs, 150,000 splats", "harmonics, 150,000 splats"
    assert ahead(runs_of, field, harmonics) == 4
    by_mcmc = ["goldcape", "caliterra", "fox", "castle"]
    for head in field, harmonics:
        assert ahead(runs_of, head, "nrfgs", scenes=by_mcmc) == 4 and ahead(runs_of, head, "nrfgs") == 4


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


def test_a_number_that_is_not_the_record_s_is_noticed():
    text = next(text for text in PAGES.values() if BLOCK.search(text))
    first = BLOCK.search(text)
    changed = text[: first.start(3)] + re.sub(r"\d", "7", first[3]) + text[first.end(3) :]
    assert changed != text and written(changed) == text


def test_every_block_is_on_a_page():
    used = {match[1] + (match[2] or "") for text in PAGES.values() for match in BLOCK.finditer(text)}
    assert set(declared()) <= used
    assert set(BLOCKS) <= {name.partition("(")[0] for name in used}


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


def test_every_picture_is_shown():
    shown = {Path(link).name for text in PAGES.values() for link in LINK.findall(text)}
    assert {path.name for path in (ROOT / "docs" / "images").iterdir()} <= shown
