# SPDX-License-Identifier: Apache-2.0
"""What the pages say holds: numbers, links, options, commands, and the worked example of docs/contributing.md."""

import contextlib
import dataclasses
import io
import re
import shlex
from pathlib import Path

import pytest
import torch
import tyro
from nerfstudio.configs import method_configs
from nerfstudio.plugins.registry import discover_methods
from nerfstudio.utils import eval_utils
from short_trainings import command_line, recorded

from nrfgs_lab.bench.file import load_spec
from nrfgs_lab.bench.spec import is_ours
from nrfgs_lab.pages import site, tables
from nrfgs_lab.pages.figures import FIGURES
from nrfgs_lab.pages.options import PAGE, explanation, methods, own_options, page
from nrfgs_lab.pages.tables import BLOCK, BLOCKS, ROOT, SHEET, declared, pages, written
from nrfgs_lab.training_run import evaluate, parse, train
from nrfgs_ns.cli import commands
from nrfgs_ns.training import config_file
from nrfgs_ns.training.identity import leaves

PAGES = {str(page.relative_to(ROOT)): page.read_text(encoding="utf-8") for page in pages()}
LINK = re.compile(r"\]\(([^)\s]+)\)")


@pytest.mark.parametrize("name", PAGES)
def test_numbers_are_those_of_the_records_and_files_that_a_page_names_are_there(name):
    assert PAGES[name] == written(PAGES[name]), "write them again: python -m nrfgs_lab.pages.tables --write"
    paths = re.findall(r"(?<![\w/])(?:nrfgs_\w+|tests|results|docs)/[\w/.-]*\.(?:py|md|json|yaml)\b", PAGES[name])
    paths = [path for path in paths if "NAME" not in path]
    paths += [name.replace(".", "/") for name in re.findall(r"python -m (nrfgs_(?:ns|lab)[\w.]*)", PAGES[name])]
    assert [path for path in paths if not any((ROOT / f"{path}{end}").exists() for end in ("", ".py"))] == []


@pytest.mark.parametrize("name", [name for name, text in PAGES.items() if BLOCK.search(text)])
def test_decibels_in_prose_stand_in_a_block_of_the_page(name):
    inside = " ".join(content for *_, content in BLOCK.findall(PAGES[name]))
    prose = re.sub(r"```.*?```|`[^`\n]*`", "", BLOCK.sub("", PAGES[name]), flags=re.DOTALL)
    assert not set(re.findall(r"(?<![\d.])(\d+(?:\.\d+)?) dB", prose)) - set(re.findall(r"\d+(?:\.\d+)?", inside))


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
    used = set(re.findall(r"""["']([\w-]+)["']|results/([\w-]+)\.json|[{ ]([\w-]+)\|""", text))
    assert {path.stem for path in (ROOT / "results").glob("*.json")} <= {stem for names in used for stem in names}


@pytest.mark.parametrize("name", FIGURES)
def test_a_figure_is_that_of_the_records(name):
    assert FIGURES[name]() == (ROOT / "docs" / "images" / name).read_text(encoding="utf-8")


def test_it_trains_under_the_name_that_the_page_gives_it(tiny_scene, tmp_path, monkeypatch):
    (code,) = re.findall(r"```python\n(# my_head\.py\n.*?)```", PAGES["docs/contributing.md"], re.DOTALL)
    (tmp_path / "my_head.py").write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("NERFSTUDIO_METHOD_CONFIGS", "linear=my_head:linear,linear-suited=my_head:suited")
    configs, descriptions = discover_methods()
    assert descriptions["linear"] == "Colours that are linear in the view direction."
    suited, ours = (
        dataclasses.replace(one.pipeline.model, appearance=None) for one in (configs["linear-suited"], configs["nrfgs"])
    )
    assert suited == ours and configs["linear-suited"].max_num_iterations == 0
    # nerfstudio looks for methods when it is first imported; here it was imported long ago.
    monkeypatch.setitem(eval_utils.all_methods, "linear", configs["linear"])
    monkeypatch.setattr(method_configs, "AnnotatedBaseConfigUnion", tyro.extras.subcommand_type_from_defaults(configs))
    refining = {"--pipeline.model.densification": "splatfacto,warmup_length=5,refine_every=10"}
    plain = {"--pipeline.model.num-downscales": 0, "--logging.local-writer.enable": None}  # a flag here
    assert is_ours("linear")
    record = train(command_line("linear", tiny_scene, tmp_path, 25, refining, plain))
    monkeypatch.setattr(config_file, "_plugins", config_file._plugins.__wrapped__)
    config_file.read_config(Path(record.config_path))
    state = torch.load(next(tmp_path.rglob("*.ckpt")), weights_only=True)["pipeline"]
    assert state["_model.gauss_params.slopes"].abs().max() > 0
    assert evaluate(record.config_path, tmp_path / "eval.json")["psnr"] > recorded()["tiny/nrfgs-sh"]["after_one_step"]


def test_the_page_of_options_is_current_and_explains_each():
    assert PAGE.read_text(encoding="utf-8") == page(), "write it again: python -m nrfgs_lab.pages.options"
    options = [option for method in methods() for option in own_options(method.config)]
    assert [option.flag for option in options if not option.text] == []
    loaded = [one.load() for one in commands().values()]
    fields = [(command, field.name) for command in loaded for field in dataclasses.fields(command)]
    assert len(fields) > 30
    assert [(command.__name__, name) for command, name in fields if not explanation(command, name)] == []


def test_options_that_pages_name_are_there():
    known = {name.replace("_", "-") for method in methods() for name, _ in leaves(method.config)}
    shown = {flag.replace("_", "-") for text in PAGES.values() for flag in re.findall(r"--(pipeline\.[\w.-]*\w)", text)}
    assert len(shown) > 10
    assert [flag for flag in shown if not any(f"{name}.".startswith(f"{flag}.") for name in known)] == []


def test_commands_that_pages_show_are_understood():
    """Those of this package, without comments and variables before them."""
    shown = set()
    for fence in re.findall(r"```bash\n(.*?)```", "\n".join(PAGES.values()), re.DOTALL):
        lines = re.sub(r"\s#.*", "", fence.replace("\\\n", " "))
        found = re.findall(r"(?:^|&& )(?:[A-Z_]+=\S+ )?((?:nrfgs|ns-train nrfgs\S*) [^&\n]+)", lines, re.MULTILINE)
        shown |= {" ".join(line.split()) for line in found}
    assert len(shown) > 40
    for line in shown:
        program, first, *rest = shlex.split(line)
        try:
            with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
                made = parse([first, *rest]) if program == "ns-train" else tyro.cli(commands()[first].load(), args=rest)
            if first == "bench" and made.spec.name != "FILE":
                assert load_spec(made.spec, made.plan)
        except SystemExit as end:
            assert not end.code, line
