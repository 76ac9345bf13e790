# SPDX-License-Identifier: Apache-2.0
"""What the package leans on is there, and is read in the versions that `host.py` names."""

from importlib.metadata import version

from nrfgs_ns import host


def test_no_private_name_is_lost():
    assert host.missing() == []


def test_the_versions_are_known():
    assert version("nerfstudio") == host.NERFSTUDIO, "read the names of host.py in this version, then say so there"
    assert version("gsplat").split("+")[0] in host.GSPLAT
    assert host.gsplat_version() == tuple(map(int, version("gsplat").split("+")[0].split(".")))


def test_a_lost_name_is_said(monkeypatch):
    monkeypatch.setattr(
        host, "PRIVATE", {"gsplat.strategy.ops": ("_gone",), "gsplat.strategy:DefaultStrategy": ("_x",)}
    )
    assert host.missing() == ["gsplat.strategy.ops._gone", "gsplat.strategy:DefaultStrategy._x"]
