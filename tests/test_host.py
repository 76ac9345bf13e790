# SPDX-License-Identifier: Apache-2.0
"""What the package leans on is there, and is read in the versions that `host.py` names."""

from importlib import import_module
from importlib.metadata import version

import pytest

from nrfgs_ns import host


@pytest.mark.parametrize("place", host.PRIVATE)
def test_no_private_name_is_lost(place):
    module, _, owner = place.partition(":")
    holder = getattr(import_module(module), owner) if owner else import_module(module)
    assert [name for name in host.PRIVATE[place] if not hasattr(holder, name)] == []


def test_the_versions_are_known():
    assert version("nerfstudio") == host.NERFSTUDIO, "read the names of host.py in this version, then say so there"
    assert version("gsplat").split("+")[0] in host.GSPLAT
    assert host.gsplat_version() == tuple(map(int, version("gsplat").split("+")[0].split(".")))
