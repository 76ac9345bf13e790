# SPDX-License-Identifier: Apache-2.0
"""The contracts of pyproject.toml hold: layers without circles, no laboratory in the product; host.py's names exist."""

from importlib.metadata import version
from inspect import getsource
from pathlib import Path
from pkgutil import resolve_name
from runpy import run_module

import pytest

from nrfgs_ns import host

ROOT = Path(__file__).resolve().parents[1]


def test_every_contract_is_kept(capsys, monkeypatch):
    cli = pytest.importorskip("importlinter.cli", reason="import-linter, of the extra `dev`, is not installed")
    monkeypatch.setattr("logging.config.dictConfig", lambda _: None)  # it would silence all loggers, for later tests
    assert cli.lint_imports(config_filename=str(ROOT / "pyproject.toml"), no_cache=True) == 0, capsys.readouterr().out


@pytest.mark.parametrize("place", host.PRIVATE)
def test_no_private_name_is_lost(place):
    owner = resolve_name(place)
    lost = [name for name in host.PRIVATE[place].split() if not hasattr(owner, name)]
    assert [name for name in lost if f"self.{name}" not in getsource(owner)] == []


def test_the_versions_are_known_and_another_gsplat_is_refused(monkeypatch):
    assert version("nerfstudio") == host.NERFSTUDIO, "read the names of host.py in this version, then say so there"
    assert version("viser") == host.VISER
    assert version("gsplat").split("+")[0] == ".".join(map(str, host.gsplat_version())) in host.GSPLAT
    monkeypatch.setattr(host, "gsplat_version", lambda: (1, 6, 0))
    with pytest.raises(ImportError, match="gsplat 1.6.0 is not known here; use 1.4.0 or 1.5.3"):
        run_module("nrfgs_ns.rasterizer.gsplat_cuda")
