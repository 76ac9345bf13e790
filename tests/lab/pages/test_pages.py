# SPDX-License-Identifier: Apache-2.0
"""What the pages say holds: the worked example of docs/contributing.md, the options' tables, the commands."""

import contextlib
import dataclasses
import importlib.util
import io
import json
import re
import shlex
import sys
from pathlib import Path

import pytest
import torch
import tyro
from nerfstudio.configs import method_configs
from nerfstudio.plugins.registry import discover_methods
from nerfstudio.utils import eval_utils
from short_trainings import recorded

from nrfgs_lab.pages.options import PAGE, explanation, methods, own_options, page
from nrfgs_lab.pages.tables import pages
from nrfgs_lab.training_run import evaluate, parse, train
from nrfgs_ns.appearance.nrf import NrfConfig
from nrfgs_ns.cli import commands

CONTRIBUTING = Path(__file__).resolve().parents[3] / "docs" / "contributing.md"


@pytest.fixture
def my_head(tmp_path, monkeypatch):
    """The page's module, on the path under its own name."""
    (code,) = re.findall(r"```python\n(# my_head\.py\n.*?)```", CONTRIBUTING.read_text(), re.DOTALL)
    (tmp_path / "my_head.py").write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    spec = importlib.util.spec_from_file_location("my_head", tmp_path / "my_head.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "my_head", module)
    spec.loader.exec_module(module)
    return module


def test_it_trains_under_the_name_that_the_page_gives_it(my_head, tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setenv("NERFSTUDIO_METHOD_CONFIGS", "linear=my_head:linear")
    configs, descriptions = discover_methods()
    assert descriptions["linear"] == "Colours that are linear in the view direction."
    # nerfstudio looks for methods when it is first imported; here it was imported long ago.
    monkeypatch.setitem(eval_utils.all_methods, "linear", configs["linear"])
    monkeypatch.setattr(method_configs, "AnnotatedBaseConfigUnion", tyro.extras.subcommand_type_from_defaults(configs))
    args = ["linear", "--data", str(tiny_scene), "--output-dir", str(tmp_path), "--max-num-iterations", "25"]
    args += ["--vis", "tensorboard", "--pipeline.model.densification", "splatfacto,warmup_length=5,refine_every=10"]
    args += ["--steps-per-eval-image", "1000", "--steps-per-eval-all-images", "1000"]
    record = train([*args, "--pipeline.model.num-downscales", "0"])
    state = torch.load(next(tmp_path.rglob("*.ckpt")), weights_only=True)["pipeline"]
    assert state["_model.gauss_params.slopes"].abs().max() > 0
    reached = evaluate(record.config_path, tmp_path / "eval.json")["psnr"]
    assert reached > recorded()["tiny/nrfgs-sh"]["after_one_step"]


def test_the_page_of_options_is_current_and_explains_each():
    assert PAGE.read_text(encoding="utf-8") == page(), "write it again: python -m nrfgs_lab.pages.options"
    options = [option for method in methods() for option in own_options(method.config)]
    assert len(options) > 100
    assert [option.flag for option in options if not option.text] == []
    loaded = [one.load() for one in commands().values()]
    fields = [(command, field.name) for command in loaded for field in dataclasses.fields(command)]
    assert len(fields) > 30
    assert [(command.__name__, name) for command, name in fields if not explanation(command, name)] == []
    flags = {option.flag for option in own_options(methods()[0].config)}
    fields = {field.name.replace("_", "-") for field in dataclasses.fields(NrfConfig) if field.name[0] != "_"}
    assert {f"pipeline.model.appearance.{name}" for name in fields} <= flags
    assert "time-budget" in flags and "pipeline.model.densification" in flags
    assert not any("sh-degree" in flag or "num-downscales" in flag for flag in flags)  # suppressed; splatfacto's


ROOT = Path(__file__).resolve().parents[3]
DOCS = ROOT / "docs"


def test_the_page_has_the_commands_that_were_run():
    page = (DOCS / "own-data.md").read_text(encoding="utf-8")
    shown = " ".join(re.sub(r" +#.*", "", page).replace("\\\n", " ").split())
    record = json.loads((ROOT / "results" / "prepare.json").read_text(encoding="utf-8"))["records"]["newcomer"]
    assert [step["step"] for step in record["commands"]] == ["prepare", "train", "look", "eval", "export"]
    for step in record["commands"]:
        assert re.sub(r"\d{4}-\d\d-\d\d_\d{6}", "DATE", step["command"]) in shown


def flags(config, prefix: str = "") -> set[str]:
    """Every option of a configuration and of those inside it, and what they are inside of."""
    found = set()
    for field in dataclasses.fields(config):
        name, value = prefix + field.name.replace("_", "-"), getattr(config, field.name)
        found.add(name)
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            found |= flags(value, f"{name}.")
    return found


def test_options_that_pages_name_are_there():
    known = set().union(*(flags(method.config) for method in methods()))
    shown = {
        flag for path in pages() for flag in re.findall(r"--(pipeline\.[\w.-]*\w)", path.read_text(encoding="utf-8"))
    }
    assert len(shown) > 10
    assert {flag.replace("_", "-") for flag in shown} <= known


def commands_shown() -> list[str]:
    """The commands of this package in the pages' shell lines, without comments and variables before them."""
    found = []
    for path in pages():
        for fence in re.findall(r"```bash\n(.*?)```", path.read_text(encoding="utf-8"), re.DOTALL):
            lines = re.sub(r"\s#.*", "", fence.replace("\\\n", " "))
            found += re.findall(r"(?:^|&& )(?:[A-Z_]+=\S+ )?((?:nrfgs|ns-train nrfgs\S*) [^&\n]+)", lines, re.MULTILINE)
    return sorted({" ".join(line.split()) for line in found})


def test_commands_that_pages_show_are_understood():
    shown = commands_shown()
    assert len(shown) > 40
    for line in shown:
        program, first, *rest = shlex.split(line)
        try:
            with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
                parse([first, *rest]) if program == "ns-train" else tyro.cli(commands()[first].load(), args=rest)
        except SystemExit as end:
            assert not end.code, line
