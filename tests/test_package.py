# SPDX-License-Identifier: Apache-2.0
"""What is at the top of the package: messages for the user, and files written whole."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from nrfgs_ns.errors import InputError
from nrfgs_ns.files import check_writable, whole, write_whole

RAISE = "from nrfgs_ns.errors import InputError\nraise InputError('x.json is missing. Make one.')"


@pytest.mark.parametrize("debug", ["0", "1"])
def test_it_is_the_last_line_and_the_status_1(debug):
    environment = {**os.environ, "NRFGS_DEBUG": debug}
    run = subprocess.run([sys.executable, "-c", RAISE], capture_output=True, text=True, env=environment, timeout=300)
    assert run.returncode == 1
    assert run.stderr.splitlines()[-1].endswith("x.json is missing. Make one.")
    assert ("Traceback" in run.stderr) == (debug == "1")
    if debug == "0":
        assert run.stderr == "x.json is missing. Make one.\n"


def test_writers_do_not_meet(tmp_path):
    """Four writers and a reader: nobody fails, and what is read is what one of them wrote."""
    file, texts = tmp_path / "table.md", [letter * 200_000 for letter in "abcd"]
    write_whole(file, texts[0])
    with ThreadPoolExecutor() as pool:
        writers = [pool.submit(lambda text=text: [write_whole(file, text) for _ in range(30)]) for text in texts]
        while not all(writer.done() for writer in writers):
            assert file.read_text() in texts, "torn"
    assert all(writer.result() for writer in writers) and [path.name for path in tmp_path.iterdir()] == ["table.md"]


def test_a_write_that_fails_leaves_the_older_file(tmp_path):
    file = tmp_path / "sheet.png"
    write_whole(file, "old")
    with pytest.raises(OSError, match="disk full"), whole(file) as aside:
        aside.write_text("ne")
        raise OSError("disk full")
    assert file.read_text() == "old" and len(list(tmp_path.iterdir())) == 1


def test_what_cannot_be_written_is_told_beforehand(tmp_path):
    (tmp_path / "file").write_text("old")
    check_writable(tmp_path / "file", "--output")
    check_writable(tmp_path / "new" / "ü" / "file", "--output")
    assert (tmp_path / "file").read_text() == "old" and not list((tmp_path / "new" / "ü").iterdir())
    with pytest.raises(InputError, match="--report .*new is a folder"):
        check_writable(tmp_path / "new", "--report")
    for path in (tmp_path / "file" / "x", tmp_path / ("x" * 250)):
        with pytest.raises(InputError, match="--output .* cannot be written .*Name a file"):
            check_writable(path, "--output")
