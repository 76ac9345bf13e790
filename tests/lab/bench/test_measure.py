# SPDX-License-Identifier: Apache-2.0
"""One real run of a benchmark, in this process: interrupted while training and before its evaluation, then measured."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras

from nrfgs_lab.bench import run as bench_run
from nrfgs_lab.bench.measure import at_size, flip, over_views
from nrfgs_lab.bench.spec import Job, cells_of, command, identity, make_spec

pytestmark = pytest.mark.usefixtures("no_cuda")


class Killed(BaseException):
    """Stands for a signal."""


def test_an_interrupted_run_ends_with_a_whole_record(tiny_scene, tmp_path, monkeypatch):
    content = {"runs": {"NRF": "nrfgs"}, "scenes": ["tiny"], "strategies": ["mcmc@310,warmup_length=1"], "steps": 8}
    options = "--pipeline.model.few-views off"
    content |= {"checkpoint_every": 2, "train_views": 3, "options": options}
    spec = make_spec(content, "test")
    (cell,) = cells_of(spec)
    parser = ["nrfgs-data", "--data", str(tiny_scene)]
    args = command(spec, cell, parser, tmp_path / "work")
    work = str(tmp_path / "work")
    job = Job(args, {"run": "NRF"}, identity(spec, cell, parser), 8, str(tmp_path / "record.json"), work, 3, 1)

    train, evaluate = bench_run.train, bench_run.evaluate

    def killed_at_5(args, on_step, on_save, earlier):
        def step(number: int) -> None:
            if number == 5:
                raise Killed

        return train(args, step, on_save, earlier)

    def killed(*_):
        raise Killed

    monkeypatch.setattr(bench_run, "train", killed_at_5)
    with pytest.raises(Killed):
        bench_run.run(job)
    assert bench_run.last_checkpoint(tmp_path / "work").name == "step-000000004.ckpt"
    monkeypatch.setattr(bench_run, "train", train)
    monkeypatch.setattr(bench_run, "evaluate", killed)
    with pytest.raises(Killed):
        bench_run.run(job)
    assert not Path(job.record).exists()
    monkeypatch.setattr(bench_run, "train", killed)  # what is trained is not trained again
    monkeypatch.setattr(bench_run, "evaluate", evaluate)
    bench_run.run(job)

    record = json.loads(Path(job.record).read_text())
    measured, trained = record["measured"], record["train"]
    assert (
        record["identity"] == job.identity
        and record["cell"] == {"run": "NRF"}
        and str(tmp_path) not in json.dumps(record)
    )
    assert trained["parts"] == 2 and trained["steps"] == 8 and trained["seconds"] > 0
    assert [step for step, _ in trained["splats"]] == [0, 7]
    assert [step for step, _ in trained["saved"]] == [2, 4, 6, 7]
    # One and the same code took both; the renderings are the same to rounding.
    for metric in ("psnr", "ssim", "l1"):
        assert measured["test"][metric] == pytest.approx(record["eval"][metric], rel=1e-5)
    assert measured["test"]["lpips"] is None
    assert [image["image"] for image in measured["train"]["per_image"]] == [
        "view_001.png",
        "view_003.png",
        "view_006.png",
    ]
    mean = sum(image["psnr"] for image in measured["train"]["per_image"]) / 3
    assert measured["train"]["psnr"] == pytest.approx(mean)
    assert measured["parameter_bytes"] == record["eval"]["parameter_bytes"] == 4 * (measured["splats"] * 46 + 6664)
    assert measured["diffuse"] == 0
    assert measured["fps"] > 0 and measured["checkpoint_bytes"] > measured["parameter_bytes"]
    assert len(list((tmp_path / "work" / "pictures").glob("eval_img_*.png"))) == 2


class Grey:
    """A model that renders grey."""

    device = torch.device("cpu")

    def get_outputs_for_camera(self, camera):
        return {"rgb": torch.full((16, 16, 3), 0.5), "background": torch.zeros(3)}

    def get_gt_img(self, image):
        return image

    def composite_with_background(self, image, background):
        return image


def test_flip_is_asked_for_inside_the_mask_and_left_out_of_the_mean_where_it_is_none():
    asked = []

    def flip(pred, truth, mask):
        asked.append((pred.shape, float(truth.mean()), mask if mask is None else int(mask.sum())))
        return None if mask is not None and not mask.any() else 0.25 * len(asked)

    def view(name, value, mask=None):
        batch = {"image": torch.full((16, 16, 3), value)} | ({} if mask is None else {"mask": mask})
        return name, (None, batch)

    part = torch.zeros(16, 16, 1)
    part[:4] = 1.0
    views = [view("a", 0.5), view("b", 0.0, part), view("c", 1.0, torch.zeros(16, 16, 1))]
    measured = over_views(Grey(), views, flip)
    assert asked == [((16, 16, 3), 0.5, None), ((16, 16, 3), 0.0, 64), ((16, 16, 3), 1.0, 0)]
    assert [one["flip"] for one in measured["per_image"]] == [0.25, 0.5, None] and measured["flip"] == 0.375
    without = over_views(Grey(), views)
    assert without["flip"] is None and "flip" not in without["per_image"][0]


def test_at_size_keeps_the_pose_and_the_vertical_angle():
    """The middle of the upper edge, and the image's centre, look where they looked."""
    pose = torch.tensor([[0.0, 0.0, 1.0, 3.0], [1.0, 0.0, 0.0, 2.0], [0.0, 1.0, 0.0, 1.0]])
    camera = Cameras(pose[None], fx=300.0, fy=320.0, cx=200.0, cy=100.0, width=400, height=200)
    wide = at_size(camera, 1920, 1080)
    assert (wide.width.item(), wide.height.item()) == (1920, 1080)
    for before, after in (((100, 200), (540, 960)), ((0, 200), (0, 960))):
        rays = [one.generate_rays(0, coords=torch.tensor(at).float()) for one, at in ((camera, before), (wide, after))]
        torch.testing.assert_close(rays[0].directions, rays[1].directions)
        torch.testing.assert_close(rays[0].origins, rays[1].origins)


def test_equal_is_zero_different_is_more_and_outside_a_mask_nothing_counts():
    pytest.importorskip("flip_evaluator")
    truth = np.random.default_rng(0).random((40, 50, 3))
    worse = np.clip(truth + 0.2, 0, 1)
    assert flip(truth, truth) == 0.0
    assert 0 < flip(np.clip(truth + 0.05, 0, 1), truth) < flip(worse, truth) <= 1
    left = np.zeros((40, 50), dtype=bool)
    left[:, :25] = True
    half = np.where(left[..., None], truth, worse)
    assert flip(half, truth, left) == 0.0 < flip(half, truth, ~left)
    assert flip(half, truth, np.zeros_like(left)) is None
