# SPDX-License-Identifier: Apache-2.0
"""The top of the package: `nrfgs`, listed and refused without importing torch; messages, and files written whole."""

import errno
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest.mock import Mock

import pytest

from nrfgs_ns import cli
from nrfgs_ns.cli import commands, summary
from nrfgs_ns.errors import InputError
from nrfgs_ns.files import check_writable, whole, write_whole
from nrfgs_ns.trained.command import NamesTraining, config_of

RUN = """
import sys
from nrfgs_ns.cli import entrypoint
sys.argv = ["nrfgs", *sys.argv[1:]]
try:
    entrypoint()
finally:
    heavy = {"torch", "nerfstudio", "gsplat", "cv2", "pycolmap"} & set(sys.modules)
    assert not heavy, heavy
"""


def nrfgs(*words: str, folder: Path) -> subprocess.CompletedProcess:
    """Run a command in a folder; it fails where the command imports torch."""
    run = subprocess.run([sys.executable, "-c", RUN, *words], cwd=folder, capture_output=True, text=True, timeout=300)
    assert "AssertionError" not in run.stderr, run.stderr
    return run


def test_the_list_has_every_command_and_its_first_sentence(tmp_path):
    run = nrfgs("--help", folder=tmp_path)
    assert run.returncode == 0
    for name, entry in commands().items():
        assert name in run.stdout and summary(entry) and summary(entry) in run.stdout


@pytest.mark.parametrize("words, says", [
    (["exprot"], "no command 'exprot'. Did you mean `nrfgs export`?"), (["eval"], "no folder outputs here"),
    (["xyz"], "There are bench, demo, doctor, eval"), (["view", "."], "no config.yml in this folder or below"),
    (["prepare", "nowhere", "out"], "no such folder or video"),
    (["export", "ply", "--load-config", "nowhere", "--output", "x.ply"], "nowhere: no such file or folder"),
    (["export", "web", "nowhere", "--output", "x.html"], "nowhere: no such file or folder"),
])  # fmt: skip
def test_mistakes_are_told_before_torch_is_imported(words, says, tmp_path):
    run = nrfgs(*words, folder=tmp_path)
    assert run.returncode != 0 and says in " ".join(run.stderr.split()) and not list(tmp_path.iterdir())


def test_a_training_is_named_in_any_form(tmp_path, monkeypatch, capsys):
    runs = [tmp_path / "outputs" / "scene" / method / "then" for method in ("nrfgs", "nrfgs-sh")]
    for age, run in enumerate(runs):
        run.mkdir(parents=True)
        (run / "config.yml").write_text("")
        os.utime(run / "config.yml", (1e9 - age, 1e9 - age))
    newest, older = (run / "config.yml" for run in runs)
    monkeypatch.chdir(tmp_path)
    assert config_of(newest) == newest and capsys.readouterr().out == ""
    for path, config in ((runs[1], older), (older.parents[1], older), (tmp_path / "outputs", newest), (None, newest)):
        assert config_of(path).resolve() == config
    assert f"Training: {newest.relative_to(tmp_path)}" in capsys.readouterr().out
    write_whole(runs[1] / "nerfstudio_models" / "step-000000009.ckpt", "")
    assert config_of(None).resolve() == older, "a training that failed has no checkpoint"
    compact = tmp_path / "outputs" / "scene.nrf.nerfstudio" / "nrfgs" / "compact" / "config.yml"
    for file in (compact, compact.parent / "nerfstudio_models" / "step-000000009.ckpt"):
        write_whole(file, "")
    assert config_of(None).resolve() == older, "a compact file is no training"
    assert config_of(compact.parents[2]).resolve() == compact
    assert NamesTraining(load_config=older).config() == NamesTraining(older).config() == older
    with pytest.raises(InputError, match="Give one"):
        NamesTraining(older, load_config=older).config()


# Messages for the user, and files written whole.
@pytest.mark.parametrize("debug", ["0", "1"])
@pytest.mark.parametrize("words, said", [
    (["-c", "from nrfgs_ns.errors import InputError; raise InputError('x.json is missing.')"], "x.json is missing."),
    (["-m", "nrfgs_ns.cli", "exprot"], "Did you mean `nrfgs export`?"),
])  # fmt: skip
def test_it_is_the_last_line_and_the_status_1(words, said, debug):
    environment = {**os.environ, "NRFGS_DEBUG": debug}
    run = subprocess.run([sys.executable, *words], capture_output=True, text=True, env=environment, timeout=300)
    lines = run.stderr.splitlines()
    assert run.returncode == 1 and lines[-1].endswith(said)
    assert ("Traceback" in run.stderr) == (debug == "1") == (len(lines) > 1)


@pytest.mark.parametrize("code, said", [
    ("print('word ' * 10_000)", ""), ("raise BrokenPipeError('of a socket')", "BrokenPipeError: of a socket"),
])  # fmt: skip
def test_output_that_nobody_reads_on_ends_a_command_quietly(code, said):
    reader, writer = os.pipe()
    os.close(reader)
    words = [sys.executable, "-c", f"from nrfgs_ns.errors import mind_the_reader; mind_the_reader(); {code}"]
    run = subprocess.run(words, stdout=-1 if said else writer, stderr=-1, text=True, timeout=300)
    os.close(writer)
    assert run.returncode == 1 and (said in run.stderr if said else run.stderr == "")


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


def test_a_full_disk_is_told_without_a_traceback(monkeypatch):
    full = Mock(main=Mock(side_effect=OSError(errno.ENOSPC, "No space left on device", "page.html")))
    monkeypatch.setattr(cli, "chosen", lambda _: full)
    with pytest.raises(SystemExit, match="No space left on device: .*page.html.* Make room"):
        cli.entrypoint()


def test_what_cannot_be_written_is_told_beforehand(tmp_path):
    (tmp_path / "file").write_text("old")
    check_writable(tmp_path / "file", "--output")
    check_writable(tmp_path / "new" / "ü" / "file", "--output")
    assert (tmp_path / "file").read_text() == "old" and len(list(tmp_path.iterdir())) == 1, "nothing is made"
    for path in (tmp_path, Path("/dev/null")):
        with pytest.raises(InputError, match=f"--report {path} is a folder or a device"):
            check_writable(path, "--report")
    for path in (tmp_path / "file" / "x", tmp_path / ("x" * 250), tmp_path / ("x" * 300) / "x"):
        with pytest.raises(InputError, match="--output .* cannot be written .*Name a file"):
            check_writable(path, "--output")
