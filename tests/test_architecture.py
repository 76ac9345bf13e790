# SPDX-License-Identifier: Apache-2.0
"""The contracts of pyproject.toml hold: layers without circles, no laboratory in the product, no nerfstudio below."""

from pathlib import Path

from importlinter.cli import lint_imports

ROOT = Path(__file__).resolve().parents[1]


def test_every_contract_is_kept(capsys):
    code = lint_imports(config_filename=str(ROOT / "pyproject.toml"), no_cache=True)
    assert code == 0, capsys.readouterr().out
