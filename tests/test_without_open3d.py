# SPDX-License-Identifier: Apache-2.0
"""The suite runs as on a machine where open3d does not import."""

import subprocess
import sys

import pytest
import without_open3d


def test_open3d_is_hidden_here_and_in_processes_that_tests_start():
    with pytest.raises(ImportError, match="hidden from the tests"):
        import open3d  # noqa: F401
    run = subprocess.run([sys.executable, "-c", "import open3d"], capture_output=True, text=True)
    assert run.returncode == 1 and "hidden from the tests" in run.stderr


def test_what_was_shown_is_hidden_again(monkeypatch, tmp_path):
    """With a package in open3d's place, since the true one does not import everywhere."""
    (tmp_path / "open3d.py").write_text("")
    behind = sys.path.index(without_open3d.HIDDEN) + 1
    monkeypatch.setattr(sys, "path", [*sys.path[:behind], str(tmp_path), *sys.path[behind:]])
    monkeypatch.setattr(without_open3d, "shown", {})
    with without_open3d.open3d_shown():
        import open3d

        assert open3d.__file__ == str(tmp_path / "open3d.py")
    with pytest.raises(ImportError, match="hidden from the tests"):
        import open3d
