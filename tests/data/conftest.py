# SPDX-License-Identifier: Apache-2.0
import pytest
from small_capture import Capture


@pytest.fixture
def capture(tmp_path) -> Capture:
    return Capture(tmp_path / "capture", images=10)


@pytest.fixture
def printed(capsys):
    """A function: what was printed since it was last called, in one line."""
    return lambda: " ".join(capsys.readouterr().out.split())
