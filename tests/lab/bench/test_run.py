# SPDX-License-Identifier: Apache-2.0
"""One run of a benchmark: what is continued after a kill, only evaluated, or begun anew; where it runs."""

import json
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import torch

from nrfgs_lab.bench import run as bench_run
from nrfgs_lab.bench.file import make_spec
from nrfgs_lab.bench.job import Job, command, identity
from nrfgs_lab.bench.measure import over_views
from nrfgs_lab.bench.run import forget_other_arguments, last_checkpoint, record_until, train_or_continue
from nrfgs_lab.bench.spec import cells_of
from nrfgs_lab.training_run import TrainRecord
from nrfgs_ns.files import write_whole


def interrupted(folder: Path, *checkpoints: int, reached: int) -> None:
    """The work folder of a training that was killed after step `reached`."""
    models = folder / "scene" / "nrfgs" / "2000-01-01" / "nerfstudio_models"
    models.mkdir(parents=True)
    for step in checkpoints:
        (models / f"step-{step:09d}.ckpt").write_bytes(b"")
    splats, saved = [[step, 10 + step] for step in range(0, reached + 1, 10)], [[20, 2.0], [40, 4.0]]
    record = TrainRecord(["nrfgs"], "lost", steps=reached + 1, seconds=99.0, splats=splats, saved=saved)
    write_whole(folder / "train.json", json.dumps(record.__dict__))


def test_the_record_fits_the_checkpoint_that_is_there(tmp_path):
    """The kill came after the note about a checkpoint and before the checkpoint."""
    interrupted(tmp_path, 20, reached=40)
    earlier = record_until(tmp_path / "train.json", last_checkpoint(tmp_path))
    assert (earlier.steps, earlier.seconds, earlier.splats[-1]) == (21, 2.0, [20, 30])
    assert earlier.saved == [[20, 2.0]]


@pytest.mark.parametrize(
    "method, steps, checkpoints",
    [("nrfgs", 100, []), ("splatfacto", 100, [20, 40]), ("nrfgs", 100, [33]), ("nrfgs", None, [20])],
)
def test_what_cannot_be_continued_starts_anew(method, steps, checkpoints, tmp_path, monkeypatch):
    """No checkpoint; a method that cannot resume; a checkpoint without a note; steps that the method chooses."""
    train = Mock(return_value=TrainRecord([], ""))
    monkeypatch.setattr(bench_run, "train", train)
    interrupted(tmp_path, *checkpoints, reached=60)
    args = [method, "--output-dir", str(tmp_path), "--max-num-iterations", str(steps), "nrfgs-data", "--data", "x"]
    job = Job(args, {}, {"options": args[:1]}, steps, str(tmp_path / "record.json"), str(tmp_path), 0, 1)
    train_or_continue(job, tmp_path)
    (call,) = train.mock_calls
    assert call.args == (args,) and call.kwargs["earlier"] is None


def test_checkpoints_of_other_arguments_are_cleared(tmp_path):
    forget_other_arguments(tmp_path, {"options": ["a"]})
    interrupted(tmp_path, 20, reached=20)
    forget_other_arguments(tmp_path, {"options": ["a"]})
    assert last_checkpoint(tmp_path) is not None
    forget_other_arguments(tmp_path, {"options": ["b"]})
    assert last_checkpoint(tmp_path) is None and not (tmp_path / "train.json").exists()


# A real run, in this process.
class Killed(BaseException):
    """Stands for a signal."""


@pytest.mark.usefixtures("no_cuda")
def test_an_interrupted_run_ends_with_a_whole_record(tiny_scene, tmp_path, monkeypatch):
    content = {"runs": {"NRF": "nrfgs"}, "scenes": ["tiny"], "strategies": ["mcmc@310,warmup_length=1"], "steps": 8}
    content |= {"checkpoint_every": 2, "train_views": 3, "options": "--pipeline.model.few-views off"}
    spec = make_spec(content, "test")
    (cell,) = cells_of(spec)
    parser, work = ["nrfgs-data", "--data", str(tiny_scene)], tmp_path / "work"
    args, record = command(spec, cell, parser, work), tmp_path / "record.json"
    job = Job(args, {"run": "NRF"}, identity(spec, cell, parser), 8, str(record), str(work), 3, 1)
    train = bench_run.train

    killed = Mock(side_effect=Killed)

    def killed_at_5(args, on_save, earlier):
        return train(args, lambda step: killed() if step == 5 else None, on_save, earlier)

    for name, deadly in (("train", killed_at_5), ("evaluate", killed)):
        with monkeypatch.context() as patch, pytest.raises(Killed):
            patch.setattr(bench_run, name, deadly)
            bench_run.run(job)
        assert not record.exists()
        assert bench_run.last_checkpoint(work).stem == {"train": "step-000000004", "evaluate": "step-000000007"}[name]
    monkeypatch.setattr(bench_run, "train", killed)  # what is trained is not trained again
    bench_run.run(job)

    record = json.loads(record.read_text())
    measured, trained = record["measured"], record["train"]
    assert record["identity"] == job.identity and record["cell"] == {"run": "NRF"}
    assert str(tmp_path) not in json.dumps(record)
    assert trained["parts"] == 2 and trained["steps"] == 8 and trained["seconds"] > 0
    assert [step for step, _ in trained["splats"]] == [0, 7]
    assert [step for step, _ in trained["saved"]] == [2, 4, 6, 7]
    # The same code took both; the renderings are the same to rounding.
    for metric in ("psnr", "ssim", "l1"):
        assert measured["test"][metric] == pytest.approx(record["eval"][metric], rel=1e-5)
    images = measured["train"]["per_image"]
    assert [image["image"] for image in images] == [f"view_00{view}.png" for view in (1, 3, 6)]
    assert measured["train"]["psnr"] == pytest.approx(sum(image["psnr"] for image in images) / 3)
    assert measured["parameter_bytes"] == record["eval"]["parameter_bytes"] == 4 * (measured["splats"] * 46 + 6664)
    assert measured["test"]["lpips"] is None
    assert measured["fps"] > 0 and measured["checkpoint_bytes"] > measured["parameter_bytes"]
    assert len(list((work / "pictures").glob("eval_img_*.png"))) == 2


def test_metrics_count_inside_the_mask():
    grey, mask = torch.full((16, 16, 3), 0.5), torch.zeros(16, 16, 1)
    mask[:4] = 1.0
    model = SimpleNamespace(
        device=torch.device("cpu"),
        get_outputs_for_camera=lambda camera: {"rgb": grey, "background": torch.zeros(3)},
        get_gt_img=lambda image: image,
        composite_with_background=lambda image, background: image,
    )
    photograph = torch.where(mask > 0, 0.75, 0.0).expand(16, 16, 3)
    views = [("a", (None, {"image": photograph, "mask": mask})), ("b", (None, {"image": photograph}))]
    measured = over_views(model, views)
    assert [image["l1"] for image in measured["per_image"]] == pytest.approx([0.25, (0.25 + 3 * 0.5) / 4])
