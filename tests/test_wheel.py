# SPDX-License-Identifier: Apache-2.0
"""The wheel has the files that it needs and declares what it imports; requirements.lock and CITATION.cff agree."""

import ast
import itertools
import re
import shutil
import subprocess
import sys
import zipfile
from email import message_from_bytes
from email.message import Message
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from nrfgs_ns import __version__

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("nrfgs_ns", "nrfgs_prepare", "nrfgs_lab")
BUILT_FROM = ("pyproject.toml", "README.md", "LICENSE", *PACKAGES)
LOCKED = ("", "dev", "heic", "lab", "browser", "docs")
HOSTS = {"nerfbaselines", "mkdocs"}
"""Packages that import ours, which then import them."""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> zipfile.ZipFile:
    """Built without network, from a copy."""
    folder = tmp_path_factory.mktemp("wheel")
    for name in BUILT_FROM:
        (shutil.copytree if (ROOT / name).is_dir() else shutil.copyfile)(ROOT / name, folder / name)
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", "dist", "."]
    run = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300)
    assert run.returncode == 0, run.stderr
    assert "Deprecat" not in run.stderr
    return zipfile.ZipFile(next((folder / "dist").glob("*.whl")))


@pytest.fixture(scope="module")
def about(wheel) -> Message:
    """The wheel's metadata."""
    return message_from_bytes(wheel.read(next(name for name in wheel.namelist() if name.endswith("/METADATA"))))


def declared(about: Message, *extras: str) -> dict[str, Requirement]:
    """Requirements with some extras, "" for those without, on Linux x86-64."""
    machine = {"sys_platform": "linux", "platform_machine": "x86_64"}
    return {
        canonicalize_name(requirement.name): requirement
        for requirement in map(Requirement, about.get_all("Requires-Dist"))
        if any(not requirement.marker or requirement.marker.evaluate({**machine, "extra": extra}) for extra in extras)
        and requirement.name != about["Name"]
    }


def test_every_file_of_the_packages_is_in_it_and_entry_points_name_some(wheel):
    files = itertools.chain.from_iterable((ROOT / package).rglob("*") for package in PACKAGES)
    needed = {path.relative_to(ROOT).as_posix() for path in files if path.is_file() and path.suffix != ".pyc"}
    assert {name for name in wheel.namelist() if ".dist-info/" not in name} == needed
    assert any(name.endswith("/LICENSE") for name in wheel.namelist())
    text = wheel.read(next(name for name in wheel.namelist() if name.endswith("/entry_points.txt"))).decode()
    targets = [line.split(" = ")[1] for line in text.splitlines() if " = " in line]
    for module, _, name in (target.partition(":") for target in targets):
        path = module.replace(".", "/")
        source = next(wheel.read(f) for f in (f"{path}.py", f"{path}/__init__.py") if f in wheel.namelist())
        assert not name or re.search(rf"^(class |def )?{name}\b", source.decode(), re.MULTILINE), (module, name)


def imported(package: str) -> set[str]:
    """Top-level names of other packages that a package imports anywhere."""
    names = set()
    for path in (ROOT / package).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                names.add(node.module.split(".")[0])
    return names - set(sys.stdlib_module_names) - set(PACKAGES) - HOSTS


@pytest.mark.parametrize(("package", "extras"), [
    ("nrfgs_ns", ["kernels", "heic"]), ("nrfgs_prepare", []), ("nrfgs_lab", ["lab", "flip", "browser"]),
])  # fmt: skip
def test_what_is_imported_is_declared(about, package, extras):
    known, requirements = packages_distributions(), declared(about, "", *extras)
    for name in imported(package):
        brought_by = {canonicalize_name(found) for found in known.get(name, [name])}
        assert brought_by & requirements.keys(), f"{package} imports {name}"


def test_the_lock_has_versions_that_are_asked_for(about):
    lines = (ROOT / "requirements.lock").read_text().splitlines()
    locked = [Requirement(line) for line in lines if line and not line.startswith("#")]
    for name, requirement in declared(about, *LOCKED).items():
        pins = [next(iter(pin.specifier)).version for pin in locked if canonicalize_name(pin.name) == name]
        assert pins and all(requirement.specifier.contains(pin) for pin in pins), name


def test_metadata_citation_and_changelog_are_of_this_version(about):
    assert about["Version"] == __version__ and about["Author"] and about["License-Expression"] == "Apache-2.0"
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))["version"] == __version__
    assert re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)[1] == __version__
