# SPDX-License-Identifier: Apache-2.0
"""What a record says of the version it was made with."""

from pathlib import Path

from nrfgs_ns.training.run import digest_of, machine, source_digest


def package(folder: Path, files: dict[str, bytes]) -> Path:
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    return folder


def test_the_digest_is_of_names_and_contents(tmp_path):
    files = {"a.py": b"x = 1\n", "part/b.py": b""}
    digest = digest_of(package(tmp_path / "one", files))
    assert len(digest) == 12 and int(digest, 16) >= 0
    assert digest_of(package(tmp_path / "same", {**files, "part/c.txt": b"notes", "d.pyc": b"\xff"})) == digest
    assert digest_of(package(tmp_path / "windows", {**files, "a.py": b"x = 1\r\n"})) == digest
    others = (
        {**files, "a.py": b"x = 2\n"},
        {**files, "c.py": b""},
        {"a.py": b"", "part/b.py": b"x = 1\n"},
        {"a.py": b"x = 1\n", "other/b.py": b""},
    )
    assert digest not in [digest_of(package(tmp_path / str(i), other)) for i, other in enumerate(others)]


def test_a_record_names_the_source_it_was_made_with():
    import nrfgs_ns

    assert machine()["source"] == source_digest() == digest_of(Path(nrfgs_ns.__file__).parent)
