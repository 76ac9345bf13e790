# SPDX-License-Identifier: Apache-2.0
"""What is loaded for an export, where its splats lie, and what other programs read of it."""

import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from compact_fields import plain_splats
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.scripts.viewer import run_viewer
from scipy.spatial.transform import Rotation
from short_trainings import command_line, models_of, trained
from torch.testing import assert_close

from nrfgs_lab.ablation import Inspect
from nrfgs_ns.data.views import in_view
from nrfgs_ns.errors import InputError
from nrfgs_ns.export.command import Compact, Ply, Web
from nrfgs_ns.export.frames import NOWHERE, Y_DOWN, Similarity
from nrfgs_ns.export.ply import SPARKS_EDGE, render_splats
from nrfgs_ns.trained import loading
from nrfgs_ns.trained.command import View
from nrfgs_ns.trained.loading import load_training
from nrfgs_ns.training.checkpoint_files import find
from nrfgs_ns.training.trainer import end_earlier_logs

pytestmark = pytest.mark.usefixtures("no_cuda")


def test_a_project_is_read_from_another_folder_and_after_a_move(tiny_scene, tmp_path, monkeypatch):
    """Trained by relative paths, in two checkpoints."""
    shutil.copytree(tiny_scene, tmp_path / "project" / "data")
    monkeypatch.chdir(tmp_path / "project")
    config = trained(command_line("nrfgs", "data", "outputs", 3, {"--steps-per-save": 1}))
    end_earlier_logs()  # written by a relative path, too
    monkeypatch.chdir(tmp_path)
    assert load_training(tmp_path / "project" / config, "test").step == 2
    shutil.move(tmp_path / "project", tmp_path / "moved")
    config = tmp_path / "moved" / config
    (models_of(config) / "notes.txt").write_text("mine")
    found = load_training(config, "test")
    assert found.step == 2 and found.checkpoint.parent == models_of(config)
    assert found.pipeline.datamanager.get_datapath() == tmp_path / "moved" / "data"
    viewed = []
    monkeypatch.setattr(run_viewer, "_start_viewer", lambda config, *_: viewed.append(config))
    View(config).main()
    assert (viewed[0].get_base_dir() / viewed[0].viewer.relative_log_filename).parent == config.parent
    Compact(config, output=tmp_path / "sent" / "small.nrf").main()
    beside = tmp_path / "sent" / "small.nrf.nerfstudio" / "nrfgs" / "compact" / "config.yml"
    assert load_training(beside, "test").pipeline.datamanager.get_datapath() == tmp_path / "moved" / "data"

    newest, before = find(models_of(config)).values()
    whole = torch.load(before, weights_only=True)["pipeline"]["_model.gauss_params.means"]
    flipped = bytearray(newest.read_bytes())
    flipped[len(flipped) // 2] ^= 1
    newest.write_bytes(flipped)
    found = load_training(config, "test")
    assert found.step == 1 and torch.equal(found.pipeline.model.means, whole)

    shutil.rmtree(tmp_path / "moved" / "data")
    for lost, places in ((config, ".*/project/data, nor at .*/moved/data"), (beside, ".*/moved/data")):
        with pytest.raises(InputError, match=rf"its data set is not at {places}\. Put it there"):
            load_training(lost, "test")


@pytest.mark.parametrize("command", [Ply, Compact, Web, Inspect])
def test_views_of_which_nothing_counts_are_told_before_any_work(command, tmp_path, monkeypatch):
    data = SimpleNamespace(cached_eval=[{"mask": torch.zeros(2, 2, 1, dtype=torch.bool)}])
    found = SimpleNamespace(pipeline=SimpleNamespace(model=SimpleNamespace(num_points=1), datamanager=data))
    monkeypatch.setattr(loading, "load_training", lambda *_: found)
    with pytest.raises(InputError, match="no test image has pixels inside its mask.*--no-measure"):
        command(Path(__file__), output=tmp_path / "made.html").main()
    assert not list(tmp_path.iterdir())


def camera(similarity: Similarity) -> Cameras:
    """Five units before the middle, in a world that was moved."""
    position = 5.0 * similarity.scale * similarity.rotation[:, 2] + similarity.translation
    pose = torch.cat([similarity.rotation, position[:, None]], dim=1)
    return Cameras(pose[None].float(), fx=60.0, fy=60.0, cx=24.0, cy=18.0, width=48, height=36)[0:1]


@pytest.mark.parametrize("similarity", [
    Y_DOWN,
    *(
        Similarity(torch.from_numpy(turn), 3.0**power, torch.randn(3, dtype=torch.float64))
        for power, turn in zip((-1, 0, 1), Rotation.random(3, random_state=0).as_matrix(), strict=True)
    ),
    # Half turns, where quaternions have no scalar part.
    Similarity(torch.diag(torch.tensor([1.0, -1.0, -1.0]).double()), 1.0, torch.zeros(3).double()),
    Similarity(torch.diag(torch.tensor([-1.0, -1.0, 1.0]).double()), 1.0, torch.zeros(3).double()),
])  # fmt: skip
def test_the_picture_is_the_same(similarity):
    background, original = torch.zeros(3), plain_splats(40)
    expected = render_splats(original, camera(NOWHERE), background)
    assert expected.std() > 0.1
    moved = similarity.moved(original)
    found = render_splats(moved, camera(similarity), background, scene_unit=similarity.scale)
    # Forty splats' float32 colours and shapes, each rounded a few times at 1e-7 of numbers of up to 10.
    assert_close(found, expected, rtol=0, atol=2e-4)
    for name, value in similarity.inverse.moved(moved)._asdict().items():
        if name == "quats":  # of two opposite ones either is the rotation
            value = value * (value * original.quats).sum(-1, keepdim=True).sign()
        assert_close(value, getattr(original, name), rtol=1e-5, atol=2e-6, msg=name)


def test_on_screen_is_what_sparks_shader_keeps():
    """|x| <= 1.4 w in clip space: the middle of the picture is 0, its edges are 1."""
    edge = 24 / 60 * 5  # half of the picture's width at five units
    x = torch.tensor([0.0, 1.0, 1.39, 1.41, -1.39, -1.41]) * edge
    means = torch.stack([x, torch.zeros(6), torch.zeros(6)], dim=-1)
    means = torch.cat([means, torch.tensor([[0.0, 0.0, 6.0]])])  # the last is behind
    assert in_view(means, camera(NOWHERE), SPARKS_EDGE)[0].tolist() == [True, True, True, False, True, False, False]
