# SPDX-License-Identifier: Apache-2.0
"""The entry for nerfstudio's list of external methods, in the installed nerfstudio's own loader."""

import re
import runpy
from importlib.metadata import entry_points
from pathlib import Path

import pytest
from nerfstudio.configs import external_methods
from nerfstudio.configs.method_configs import merge_methods
from nerfstudio.plugins.registry import discover_methods

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "nerfstudio"


@pytest.fixture
def entry(monkeypatch):
    """The entry, alone in the list."""
    monkeypatch.setattr(external_methods, "external_methods", [])
    runpy.run_path(str(FOLDER / "external_method.py"))
    (entry,) = external_methods.external_methods
    return entry


def test_it_lists_methods_that_the_package_registers(entry):
    listed, descriptions = external_methods.get_external_methods()
    registered, described = discover_methods()
    assert "nrfgs" in listed and listed.keys() <= registered.keys()
    assert listed.keys() <= set(entry_points(group="nerfstudio.method_configs").names)
    # As nerfstudio merges them: an installed method is not replaced by its entry, and without it the entry is shown.
    merged, _ = merge_methods(registered, described, listed, descriptions, overwrite=False)
    assert all(merged[name] is registered[name] for name in listed)
    alone, texts = merge_methods({}, {}, listed, descriptions, overwrite=False)
    assert alone == listed and all(f"ns-train {name}" in texts[name] for name in listed)


@pytest.mark.parametrize("agreed", [False, True])
def test_choosing_it_offers_to_install_this_package(entry, agreed, monkeypatch, capsys):
    commands = []
    monkeypatch.setattr(external_methods.Confirm, "ask", lambda *_, **__: agreed)
    monkeypatch.setattr(external_methods.CONSOLE, "print", lambda text: print(text))

    def install(command: str, **_):
        commands.append(command)
        return type("Done", (), {"returncode": 0})

    monkeypatch.setattr(external_methods.subprocess, "run", install)
    with pytest.raises(SystemExit) as stop:
        external_methods.ExternalMethodDummyTrainerConfig(method_name="nrfgs", method=entry)
    assert stop.value.code == 0 and "pip install nrfgs-ns" in capsys.readouterr().out
    assert [command.split(" -m ")[1] for command in commands] == ["pip install nrfgs-ns"] * agreed


def test_the_page_is_where_the_entry_says_and_has_what_nerfstudio_asks_for(entry):
    (name,) = re.findall(r"https://docs.nerf.studio/nerfology/methods/(\w+).html", entry.instructions)
    page = (FOLDER / f"{name}.md").read_text(encoding="utf-8")
    for part in ("Installation", "Running NRF-GS", "Requirements", "Method"):
        assert f"\n## {part}\n" in page
    assert f"pip install {entry.pip_package}\n" in page
    assert all(f"`{method}`" in page or f"ns-train {method} " in page for method, _ in entry.configurations)
    assert not re.findall(r"\]\((?!https://)", page), "links and pictures of another site"
