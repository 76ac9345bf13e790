# SPDX-License-Identifier: Apache-2.0
import threading

from nrfgs_lab.lock import only_one


def test_a_lock_is_held_by_one(tmp_path, monkeypatch):
    """A lock belongs to an open file: another one waits, in this process as in any other."""
    events, waits, inside = [], threading.Event(), threading.Event()
    monkeypatch.setattr("nrfgs_lab.lock.print", lambda *_, **__: waits.set(), raising=False)

    def first() -> None:
        with only_one(tmp_path / "lock", "waiting"):
            inside.set()
            assert waits.wait(300), "the second one did not wait"
            events.append("first out")

    thread = threading.Thread(target=first)
    thread.start()
    assert inside.wait(300)
    with only_one(tmp_path / "lock", "waiting"):
        events.append("second in")
    thread.join()
    assert waits.is_set() and events == ["first out", "second in"]
