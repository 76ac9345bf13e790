# SPDX-License-Identifier: Apache-2.0
"""What the user sees of an exception that is meant for him, whatever command raised it."""

import os
import subprocess
import sys

import pytest

RAISE = "from nrfgs_ns.errors import InputError\nraise InputError('x.json is missing. Make one.')"


@pytest.mark.parametrize("debug", ["0", "1"])
def test_it_is_the_last_line_and_the_status_1(debug):
    environment = {**os.environ, "NRFGS_DEBUG": debug}
    run = subprocess.run([sys.executable, "-c", RAISE], capture_output=True, text=True, env=environment)
    assert run.returncode == 1
    assert run.stderr.splitlines()[-1].endswith("x.json is missing. Make one.")
    assert ("Traceback" in run.stderr) == (debug == "1")
    if debug == "0":
        assert run.stderr == "x.json is missing. Make one.\n"
