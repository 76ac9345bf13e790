# SPDX-License-Identifier: Apache-2.0
import threading
import time

from nrfgs_lab.lock import only_one


def test_a_lock_is_held_by_one(tmp_path):
    """A lock belongs to an open file: another one waits, in this process as in any other."""
    events = []

    def first() -> None:
        with only_one(tmp_path / "lock", "waiting"):
            events.append("first in")
            time.sleep(0.5)
            events.append("first out")

    thread = threading.Thread(target=first)
    thread.start()
    while not events:
        time.sleep(0.01)
    with only_one(tmp_path / "lock", "waiting"):
        events.append("second in")
    thread.join()
    assert events == ["first in", "first out", "second in"]
