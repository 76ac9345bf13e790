# SPDX-License-Identifier: Apache-2.0
"""Checkpoint files: whole or not there, and never another model in silence."""

import contextlib
import os
import random
import signal
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from short_trainings import config_with

from nrfgs_ns.errors import InputError
from nrfgs_ns.method_config import nrfgs
from nrfgs_ns.training.checkpoint_files import DiskFull, find, read, read_latest, write
from nrfgs_ns.training.identity import check_data_set, check_options, data_set_of, options_of


def content(step: int, size: int = 500) -> dict:
    torch.manual_seed(step)
    pipeline = {"_model.means": torch.randn(size, 3), "_extra_state": {"head": "nrf", "list": [1, 2.5]}}
    return {"step": step, "pipeline": pipeline, "optimizers": {"means": {"lr": 0.1, "m": torch.randn(size, 3)}}}


def test_the_last_two_stay_and_strange_files_are_let_be(tmp_path):
    (tmp_path / "models").mkdir()
    for name in ("notes.txt", "best.ckpt", "step-1.ckpt.bak", "step-x.ckpt"):
        (tmp_path / "models" / name).write_text("mine")
    for step in (3, 5, 8, 1_000_000_000):
        write(tmp_path / "models", step, content(step))
        write(tmp_path / "all", step, content(step), only_latest=False)
    assert list(find(tmp_path / "models")) == [1_000_000_000, 8] and len(find(tmp_path / "all")) == 4
    assert len(list((tmp_path / "models").iterdir())) == 6


def test_no_flipped_bit_is_loaded_as_another_model(tmp_path):
    """Each is refused, or was in bytes that mean nothing: padding, dates."""
    path = write(tmp_path, 4, content(4, size=40))
    whole, draw, refused = path.read_bytes(), random.Random(0), 0
    for _ in range(100):
        place = draw.randrange(8 * len(whole))
        flipped = bytearray(whole)
        flipped[place // 8] ^= 1 << place % 8
        path.write_bytes(flipped)
        try:
            state = read(path)
        except InputError:
            refused += 1
        else:
            for part in ("pipeline", "optimizers"):
                assert str(state[part]) == str(content(4, size=40)[part])
    assert refused > 50
    for length in (0, 1, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match="is damaged"):
            read(path)


def test_a_damaged_newest_falls_back_to_the_one_before(tmp_path, capsys):
    write(tmp_path, 1, content(1))
    newest = write(tmp_path, 2, content(2))
    newest.write_bytes(newest.read_bytes()[:-500])
    assert read_latest(tmp_path)[1]["step"] == 1
    assert "step-000000002.ckpt is damaged" in capsys.readouterr().out
    with pytest.raises(InputError, match="step-000000002.ckpt is damaged"):
        read_latest(tmp_path, step=2)
    (tmp_path / "step-000000001.ckpt").write_text("no")
    with pytest.raises(InputError, match=r"step-000000002.ckpt is damaged.*step-000000001.ckpt is damaged"):
        read_latest(tmp_path)


def test_code_in_a_checkpoint_is_not_run_and_what_is_not_there_is_refused(tmp_path):
    class Attack:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "owned"),)

    torch.save({"step": 1, "pipeline": Attack(), "optimizers": {}}, tmp_path / "step-000000001.ckpt")
    with pytest.raises(InputError, match="is damaged"):
        read(tmp_path / "step-000000001.ckpt")
    assert not (tmp_path / "owned").exists()
    write(tmp_path, 1, content(1))
    with pytest.raises(InputError, match="no checkpoint of step 5, only of 1"):
        read_latest(tmp_path, step=5)


@pytest.mark.skipif(sys.platform == "win32", reason="limits of POSIX")
def test_a_limit_on_file_sizes_is_named_with_what_was_kept(tmp_path):
    import resource

    folder, before = tmp_path / "models", resource.getrlimit(resource.RLIMIT_FSIZE)
    write(folder, 1, content(1))
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, before[1]))
        with pytest.raises(DiskFull, match=r"step 2 cannot be written: .*step-000000001.ckpt\. .*ulimit -f"):
            write(folder, 2, content(2, size=10_000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(find(folder)) == [1] and [path.name for path in tmp_path.iterdir()] == ["models"]


def write_until_killed(folder: Path, count: int) -> None:
    """Write checkpoints, and be killed before a file operation, or halfway through writing the content."""
    save = torch.save

    def tick() -> None:
        nonlocal count
        count -= 1
        if count == 0:
            os.kill(os.getpid(), signal.SIGKILL)

    def dying(call):
        return lambda *args: (tick(), call(*args))[1]

    def dying_save(content, path) -> None:
        save(content, path)
        os.truncate(path, os.path.getsize(path) // 2)
        tick()
        save(content, path)

    for name in ("open", "fsync", "close", "replace", "unlink"):
        setattr(os, name, dying(getattr(os, name)))
    torch.save = dying_save
    for step in range(1, 100):
        write(folder, step, content(step))


@pytest.mark.skipif(sys.platform == "win32", reason="forks")
def test_a_writer_that_is_killed_at_any_operation_leaves_whole_files(tmp_path):
    """SIGKILL at each of the first file operations of `write`, which then goes on in the same folder."""
    for count in range(1, 30):
        folder = tmp_path / str(count) / "models"
        child = os.fork()
        if child == 0:
            try:
                signal.signal(signal.SIGALRM, signal.SIG_DFL)
                signal.alarm(60)  # ends a child that hangs
                write_until_killed(folder, count)
            finally:
                os._exit(0)
        assert os.waitpid(child, 0)[1] == signal.SIGKILL
        kept = find(folder)
        for step, path in kept.items():
            assert str(read(path)) == str(content(step))
        write(folder, 50, content(50))
        assert [path.name for path in folder.parent.iterdir()] == ["models"]
    assert 2 <= len(kept) <= 3, "two, and a third while the oldest is being removed"


LENS = {"fx": 90.0, "fy": 80.0, "cx": 50.0, "cy": 30.0, "width": 100, "height": 60}


def scene(names=("a.png", "b.png", "c.png"), shift: float = 0.0, **lens: float) -> dict:
    poses = torch.eye(4)[None, :3].repeat(len(names), 1, 1)
    poses[:, 0, 3] = torch.arange(len(names))
    poses[1, 1, 3] += shift
    lenses = {name: torch.full((len(names), 1), value) for name, value in (LENS | lens).items()}
    cameras = SimpleNamespace(camera_to_worlds=poses, **lenses)
    return data_set_of(SimpleNamespace(image_filenames=names, cameras=cameras))


@pytest.mark.parametrize(("here", "going_on", "afterwards"), [
    (scene(("a.png", "x.png", "c.png")), r"other images \(b.png, x.png\)", None),
    (scene(("a.png", "b.png")), r"other images \(c.png\)", None),
    (scene(("a.png", "c.png", "b.png")), "in another order", r"other poses \(c.png, b.png elsewhere\)"),
    (scene(("a.png", "b.png", "new.png"), shift=0.1), r"other images \(c", r"other poses \(b.png elsewhere\)"),
    (scene(shift=0.1), r"other poses \(b.png elsewhere\)", r"other poses \(b.png elsewhere\)"),
    (scene(fy=81.0), "other intrinsics .* .fy of a.png was 80 and is 81.", None),
    (scene(cx=52.0), "other intrinsics .* .cx of a.png was 50 and is 52.", None),
    (scene(width=200), "other intrinsics .* .width of a.png was 100 and is 200.", None),
])  # fmt: skip
def test_another_scene_is_refused(here, going_on, afterwards):
    check_data_set(scene(), scene(shift=1e-4, fx=90.8, cx=50.9), "elsewhere", to_train=True)
    older = {name: value for name, value in scene().items() if name != "lenses"}
    check_data_set(older, scene(width=200), "elsewhere", to_train=True)
    with pytest.raises(InputError, match=going_on):
        check_data_set(scene(), here, "data/fox", to_train=True)
    with pytest.raises(InputError, match=afterwards) if afterwards else contextlib.nullcontext():
        check_data_set(scene(), here, "data/fox", to_train=False)


@pytest.mark.parametrize("name, value, may_change", [
    ("pipeline.model.appearance.num_bands", 2, False), ("pipeline.model.rasterize_mode", "antialiased", False),
    ("pipeline.datamanager.dataparser.scale_factor", 2.0, False), ("max_num_iterations", 600, True),
    ("pipeline.datamanager.camera_res_scale_factor", 0.5, False), ("optimizers.means.optimizer.lr", 1e-5, True),
    ("pipeline.model.densification.refine_every", 50, True), ("pipeline.datamanager.cache_images", "cpu", True),
    ("pipeline.model.appearance.implementation", "torch", True),
    ("pipeline.datamanager.dataparser.data", "elsewhere", True),
])  # fmt: skip
def test_an_option_that_changes_the_meaning_is_refused(name, value, may_change):
    says = pytest.raises(InputError, match="--" + name.replace("_", "-") + " was .* and is ")
    with contextlib.nullcontext() if may_change else says:
        check_options(options_of(nrfgs.config), options_of(config_with(name, value)))
