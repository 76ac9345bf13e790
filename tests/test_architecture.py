# SPDX-License-Identifier: Apache-2.0
"""The contracts of pyproject.toml hold: layers without circles, no laboratory in the product, no nerfstudio below; and
what `host.py` leans on is there."""

from importlib import import_module
from importlib.metadata import version
from pathlib import Path

import pytest
from importlinter.cli import lint_imports

from nrfgs_ns import host

ROOT = Path(__file__).resolve().parents[1]


def test_every_contract_is_kept(capsys, monkeypatch):
    monkeypatch.setattr("logging.config.dictConfig", lambda _: None)  # it would silence all loggers, for later tests
    assert lint_imports(config_filename=str(ROOT / "pyproject.toml"), no_cache=True) == 0, capsys.readouterr().out


@pytest.mark.parametrize("place", host.PRIVATE)
def test_no_private_name_is_lost(place):
    module, _, owner = place.partition(":")
    holder = getattr(import_module(module), owner) if owner else import_module(module)
    assert [name for name in host.PRIVATE[place] if not hasattr(holder, name)] == []


def test_the_versions_are_known():
    assert version("nerfstudio") == host.NERFSTUDIO, "read the names of host.py in this version, then say so there"
    assert version("gsplat").split("+")[0] in host.GSPLAT
    assert host.gsplat_version() == tuple(map(int, version("gsplat").split("+")[0].split(".")))
