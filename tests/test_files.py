# SPDX-License-Identifier: Apache-2.0
"""A file is whole or not there, whoever else writes it; a lock is held by one."""

import threading
import time

import pytest

from nrfgs_ns.files import only_one, whole, write_whole


def test_writers_do_not_meet(tmp_path):
    """Four writers and a reader: nobody fails, and what is read is what one of them wrote."""
    file, faults, done = tmp_path / "table.md", [], threading.Event()
    texts = [letter * 200_000 for letter in "abcd"]
    write_whole(file, texts[0])

    def write(text: str) -> None:
        try:
            for _ in range(30):
                write_whole(file, text)
        except OSError as error:
            faults.append(error)

    def read() -> None:
        while not done.is_set():
            if file.read_text() not in texts:
                faults.append("torn")

    reader = threading.Thread(target=read)
    writers = [threading.Thread(target=write, args=(text,)) for text in texts]
    for thread in (reader, *writers):
        thread.start()
    for thread in writers:
        thread.join()
    done.set()
    reader.join()
    assert faults == [] and [path.name for path in tmp_path.iterdir()] == ["table.md"]


def test_a_write_that_fails_leaves_the_older_file(tmp_path):
    file = tmp_path / "sheet.png"
    write_whole(file, "old")
    with pytest.raises(OSError, match="disk full"), whole(file) as aside:
        aside.write_text("ne")
        raise OSError("disk full")
    assert file.read_text() == "old" and len(list(tmp_path.iterdir())) == 1


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
