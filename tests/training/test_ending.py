# SPDX-License-Identifier: Apache-2.0
"""How trainings end before their last step, and that they go on from there to the parameters of the unbroken one."""

import math
import os
import re
import signal
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import torch
from densification_cases import Table
from nerfstudio.utils.rich_utils import CONSOLE
from short_trainings import assert_same_training, checkpoint_of, command_line, config_with, models_of, set_up, trained

from nrfgs_lab.training_run import parse
from nrfgs_ns.data.datamanager import NrfgsDatamanager
from nrfgs_ns.densification import Splatfacto
from nrfgs_ns.errors import InputError
from nrfgs_ns.training import checkpoint_files, stopping
from nrfgs_ns.training.checkpoint_files import DiskFull, find, read_latest
from nrfgs_ns.training.guard import TrainingStopped
from nrfgs_ns.training.stopping import StopRequest, heard_signals, rows_agree
from nrfgs_ns.training.trainer import NrfgsTrainer, writer

pytestmark = pytest.mark.usefixtures("no_cuda", "any_share")

STEPS = 12
RULES = Splatfacto(warmup_length=2, refine_every=4, reset_alpha_every=100, densify_grad_thresh=1e-6)
BUSY = {
    "--pipeline.model.densification": RULES,
    "--pipeline.model.num-downscales": 0,
    "--steps-per-eval-image": 5,
    "--steps-per-eval-all-images": 5,
    "--average-steps": 4,
}
"""Refinements at every 4th step, evaluations that draw random numbers, and a mean over the last steps."""


def ready(scene: Path, out: Path, *more: dict, steps: int = STEPS) -> NrfgsTrainer:
    return set_up(command_line("nrfgs", scene, out, steps, BUSY, *more))


def at_step(trainer: NrfgsTrainer, step: int, then) -> None:
    """Call `then` in the middle of a step."""
    original = trainer.pipeline.get_train_loss_dict

    def spoilt(now: int, *how):
        if now == step:
            then()
        return original(now, *how)

    trainer.pipeline.get_train_loss_dict = spoilt


@pytest.fixture(scope="module")
def finished(tiny_scene, tmp_path_factory, any_share) -> Path:
    """config.yml of the unbroken training."""
    return trained(command_line("nrfgs", tiny_scene, tmp_path_factory.mktemp("whole"), STEPS, BUSY))


@pytest.mark.parametrize(("number", "step", "status"), [(signal.SIGTERM, 5, 143), (signal.SIGINT, 9, 130)])
def test_a_training_goes_on_to_the_bit_after_a_signal(number, step, status, finished, tiny_scene, tmp_path, capsys):
    """In a step after which test images are evaluated, and in one within the window of the mean."""
    trainer = ready(tiny_scene, tmp_path / "a b")
    at_step(trainer, step, lambda: os.kill(os.getpid(), number))
    capsys.readouterr()
    with pytest.raises(SystemExit) as ended:
        trainer.train()
    assert ended.value.code == status
    folder = trainer.checkpoint_dir
    assert capsys.readouterr().out.endswith(f"Go on with the same command and --load-dir '{folder}'\n")
    assert list(find(folder)) == [step]
    mean = read_latest(folder)[1]["training"].get("parameter_mean")
    assert mean["count"] == 2 if step == 9 else mean is None  # of steps 8 and 9
    rest = trained(command_line("nrfgs", tiny_scene, tmp_path / "b", STEPS, BUSY, {"--load-dir": folder}))
    assert_same_training(checkpoint_of(finished), checkpoint_of(rest), rtol=0, atol=0)


def test_a_signal_before_the_first_step_saves_nothing_and_a_paused_training_hears_it(tiny_scene, tmp_path, capsys):
    trainer = ready(tiny_scene, tmp_path, {"--start-paused": True})
    trainer.request.hear(signal.SIGINT)
    with pytest.raises(SystemExit) as ended:
        trainer.train()
    assert ended.value.code == 130 and not find(trainer.checkpoint_dir)
    assert capsys.readouterr().out.endswith("Stopped before the first step; there is nothing to save.\n")


def test_ctrl_c_while_images_are_read_is_one_line(tiny_scene, tmp_path, capsys, monkeypatch):
    trainer = parse(command_line("nrfgs", tiny_scene, tmp_path, STEPS)).setup(local_rank=0, world_size=1)
    monkeypatch.setattr(NrfgsDatamanager, "load_all_images", Mock(side_effect=KeyboardInterrupt()))
    with pytest.raises(SystemExit) as ended:
        trainer.setup()
    assert ended.value.code == 130 and "Stopped before the first step" in capsys.readouterr().out


OUT_OF_MEMORY = torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB.")


def test_memory_that_runs_out_costs_no_step(tiny_scene, tmp_path):
    trainer = ready(tiny_scene, tmp_path)
    at_step(trainer, 6, Mock(side_effect=OUT_OF_MEMORY))
    with pytest.raises(TrainingStopped) as stopped:
        trainer.train()
    assert (stopped.value.step, stopped.value.origin, stopped.value.savable) == (6, "memory", True)
    assert "in step 6: CUDA out of memory" in str(stopped.value) and "\nStep 5 is saved." in str(stopped.value)
    assert list(find(trainer.checkpoint_dir)) == [5]


def test_memory_that_runs_out_while_splats_are_added_saves_nothing_half_done(tiny_scene, tmp_path):
    trainer = ready(tiny_scene, tmp_path, {"--steps-per-save": 3})
    model = trainer.pipeline.model

    def half_done(*_):
        model.gauss_params["means"] = torch.nn.Parameter(torch.cat([model.gauss_params["means"].detach()] * 2))
        raise OUT_OF_MEMORY

    at_step(trainer, 5, lambda: setattr(model.densification, "post_backward", half_done))
    with pytest.raises(TrainingStopped, match="added or removed.*The last checkpoint is .*step-000000003.ckpt"):
        trainer.train()
    assert list(find(trainer.checkpoint_dir)) == [3]


@pytest.mark.parametrize("disk_is_full", [False, True])
def test_another_failure_saves_too_and_is_raised(disk_is_full, tiny_scene, tmp_path, monkeypatch, capsys):
    trainer = ready(tiny_scene, tmp_path)
    if disk_is_full:
        monkeypatch.setattr(checkpoint_files, "write", Mock(side_effect=DiskFull("The disk is full.")))
    monkeypatch.setattr(CONSOLE, "_file", Mock(["write"], write=Mock(side_effect=BrokenPipeError("the log is gone"))))
    at_step(trainer, 4, lambda: CONSOLE.print("a line"))
    with pytest.raises(BrokenPipeError):
        trainer.train()
    assert list(find(trainer.checkpoint_dir)) == ([] if disk_is_full else [3])
    outcome = "The state could not be saved (The disk is full" if disk_is_full else "Step 3 is saved."
    assert f"failed in step 4. {outcome}" in capsys.readouterr().out


def test_a_signal_in_the_last_step_finds_a_training_that_is_done(finished, tiny_scene, tmp_path, monkeypatch, capsys):
    """With the mean over the last steps, and without a viewer that would wait for another signal."""
    trainer, waited = ready(tiny_scene, tmp_path), []
    monkeypatch.setattr("nerfstudio.engine.trainer.Trainer._train_complete_viewer", lambda _: waited.append(True))
    at_step(trainer, STEPS - 1, lambda: os.kill(os.getpid(), signal.SIGTERM))
    trainer.train()
    assert_same_training(checkpoint_of(finished), checkpoint_of(trainer.base_dir / "config.yml"), rtol=0, atol=0)
    assert "Go on with" not in capsys.readouterr().out and waited == []


def test_a_full_disk_is_survived_until_the_end(tiny_scene, tmp_path, monkeypatch, capsys):
    trainer = ready(tiny_scene, tmp_path, {"--steps-per-save": 3})
    original = checkpoint_files.write

    def full(folder, step, *rest):
        if step > 3:
            raise DiskFull(f"The disk of {folder} is full.")
        return original(folder, step, *rest)

    monkeypatch.setattr(checkpoint_files, "write", full)
    with pytest.raises(DiskFull):
        trainer.train()
    assert capsys.readouterr().out.count("is full. The training goes on.") == 2  # steps 6 and 9
    assert list(find(trainer.checkpoint_dir)) == [3]


def test_a_finished_training_says_so_and_how_to_extend_it(finished, tiny_scene, tmp_path):
    folder = models_of(finished)
    with pytest.raises(InputError, match="training of 12 steps: --max-num-iterations 24 --average-steps 4 makes"):
        ready(tiny_scene, tmp_path / "b", {"--load-dir": folder}, steps=STEPS - 1)
    with pytest.raises(InputError, match="Schedules of 5 steps end before step 12. Give"):
        ready(tiny_scene, tmp_path / "b", {"--load-dir": folder, "--schedule-steps": 5}, steps=STEPS + 2)
    with pytest.raises(InputError, match="num_downscales is 6; it must be so many that 2"):
        ready(tiny_scene, tmp_path / "b", {"--pipeline.model.num-downscales": 6})
    longer = ready(tiny_scene, tmp_path / "c", {"--load-dir": folder}, steps=STEPS + 2)
    assert writer.GLOBAL_BUFFER["max_iter"] == STEPS + 2
    longer.train()
    assert max(find(longer.checkpoint_dir)) == STEPS + 1


@pytest.mark.parametrize(("option", "bad"), [
    ("max_num_iterations", -1), ("pipeline.model.view_noise", math.inf), ("pipeline.model.ssim_lambda", math.nan),
    ("pipeline.model.resolution_schedule", 0), ("pipeline.model.robust_loss", 2.0), ("load_step", 5),
    ("pipeline.datamanager.camera_res_scale_factor", 0), ("logging.steps_per_log", 0),
    ("pipeline.datamanager.train_cameras_sampling_strategy", "fps"), ("schedule_steps", -5),
    ("load_checkpoint", Path("gone.ckpt")), ("load_checkpoint", Path()), ("time_budget", 0), ("time_budget", math.nan),
    ("machine.num_devices", 0), ("machine.device_type", "cuda"), ("optimizers.quats.optimizer.lr", -1.0),
    ("optimizers.means.optimizer.lr", 0.0), ("optimizers.quats.optimizer.lr", 1e30), ("mixed_precision", True),
    ("optimizers.means.scheduler.lr_final", 0.0), ("gradient_accumulation_steps", {"means": 2}),
    ("pipeline.datamanager.dataparser.mask_color", (0.0, 0.0, 1.0)),
])  # fmt: skip
def test_options_without_sense_are_refused(option, bad, tiny_scene):
    config = replace(config_with(option, bad), data=tiny_scene)
    with pytest.raises(InputError, match=re.escape(f"{option} is {bad}")):
        config.print_to_terminal()  # ns-train's first call: nothing is written before it


@pytest.mark.parametrize(("vis", "package"), [("wandb", "wandb"), ("viewer+comet", "comet_ml")])
def test_a_tracker_that_would_not_start_is_told_first(vis, package, tiny_scene, monkeypatch):
    without_key = SimpleNamespace(login=Mock(side_effect=ValueError("No API key")), get_config=lambda _: None)
    for module, finding in ((None, f"import of {package}"), (without_key, "No API key")):
        monkeypatch.setitem(sys.modules, package, module)
        with pytest.raises(InputError, match=rf"vis is {re.escape(vis)}.*{finding}.*by pip and log in"):
            replace(config_with("vis", vis), data=tiny_scene).print_to_terminal()


def test_a_scale_that_leaves_no_image_is_refused(tiny_scene, tmp_path):
    with pytest.raises(InputError, match="0.01 leaves nothing"):
        ready(tiny_scene, tmp_path, {"--pipeline.datamanager.camera-res-scale-factor": 0.01})


def test_another_scene_other_options_and_another_method_are_refused(finished, tiny_scene, tmp_path, capsys):
    from nrfgs_lab.scenes import SceneConfig, write_scene

    other = write_scene(SceneConfig(views=10, width=48, height=36, points=300, samples=1, seed=5), tmp_path / "other")
    resumed = {"--load-dir": models_of(finished)}
    with pytest.raises(InputError, match="trained on other (poses|images)"):
        ready(other, tmp_path / "b", resumed, steps=STEPS + 2)
    evaluated = parse(command_line("nrfgs", other, tmp_path, 1, BUSY)).pipeline.setup(device="cpu", test_mode="test")
    state = checkpoint_of(finished)["pipeline"]
    state["_extra_state"]["scene"]["images"][0] = evaluated.datamanager.eval_dataset.image_filenames[0].name
    evaluated.load_pipeline(state, STEPS)  # as ns-eval calls it
    said = capsys.readouterr().out
    for warning in (r"other poses .*elsewhere\).* metrics are wrong", r"test images were trained on \(view_...\.png\)"):
        assert re.search(f"Warning: .*{warning}", said), warning
    with pytest.raises(InputError, match="--pipeline.model.appearance.color-scale was 0.2 and is 0.3"):
        ready(tiny_scene, tmp_path / "c", resumed, {"--pipeline.model.appearance.color-scale": 0.3}, steps=STEPS + 2)
    own = {"step": 9, "pipeline": {"_model.gauss_params.means": torch.zeros(3, 3)}, "optimizers": {}, "schedulers": {}}
    torch.save(own, tmp_path / "step-000000009.ckpt")
    with pytest.raises(InputError, match="of another method"):
        ready(tiny_scene, tmp_path / "a", {"--load-dir": tmp_path}, steps=STEPS)


def test_trainings_of_one_name_have_a_folder_each(tiny_scene, tmp_path):
    """Those of one second, too; a training that goes on in its own folder stays there, unless from an older step: its
    checkpoints would be removed as older than those that are there."""
    config = parse(command_line("nrfgs", tiny_scene, tmp_path, 1))
    configs = [replace(config, timestamp="mine") for _ in range(3)]
    for each in configs:
        each.save_config()
        assert (each.get_base_dir() / "config.yml").is_file()
    assert [each.get_base_dir().name for each in configs] == ["mine", "mine_2", "mine_3"]
    for step, name in ((None, "mine"), (0, "mine_4")):
        on = replace(config, timestamp="mine", load_dir=configs[0].get_checkpoint_dir(), load_step=step)
        on.save_config()
        assert on.timestamp == name


def test_what_ns_train_says_before_it_begins(tiny_scene, tmp_path, monkeypatch, capsys):
    """Data may be named as nerfstudio's documentation does it: `ns-train nrfgs nrfgs-data --data FOLDER`."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="--data is missing"):
        parse(["nrfgs"]).print_to_terminal()
    with pytest.raises(InputError, match="typo: no such file or folder"):  # and no folder is made for it
        parse(["nrfgs", "--data", "typo"]).print_to_terminal()
    with pytest.raises(InputError, match="both name a checkpoint"):
        parse(["nrfgs", "--data", str(tiny_scene), "--load-dir", "a", "--load-checkpoint", "b"]).print_to_terminal()
    with pytest.raises(SystemExit, match="2"):
        parse(["nrfgs", "--load-config", "typo"])
    monkeypatch.chdir(tiny_scene)
    for words in ([], ["nrfgs-data", "--data", str(tiny_scene)]):
        config = parse(["nrfgs", *words])
        capsys.readouterr()
        config.print_to_terminal()
        assert capsys.readouterr().out.splitlines() == [f"nrfgs on {tiny_scene}"]


def test_on_a_cpu_smaller_images_are_advised_where_they_are_large(tiny_scene, tmp_path, capsys):
    ready(tiny_scene, tmp_path, steps=10_000)
    assert "in ten minutes: nrfgs-fast with --time-budget 10\n" in capsys.readouterr().out


# Signals and states, without a training.
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_a_request_and_handlers_are_given_back(number, capfd):
    request, before = StopRequest(), signal.getsignal(number)
    with heard_signals(request):
        assert request.signal is None
        os.kill(os.getpid(), number)
        os.kill(os.getpid(), number)  # the same one, heard twice
        assert request.signal == number
    assert signal.getsignal(number) is before
    assert capfd.readouterr().err.count("Stopping when this step is done") == 1


def test_what_is_ignored_stays_so():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        request = StopRequest()
        with heard_signals(request):
            os.kill(os.getpid(), signal.SIGHUP)
        assert request.signal is None
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize(("second", "seconds", "ends"), [
    (signal.SIGINT, 0.1, False), (signal.SIGINT, 2.0, True), (signal.SIGTERM, 2.0, False),
])  # fmt: skip
def test_only_a_second_ctrl_c_stops_at_once(second, seconds, ends, monkeypatch):
    """A first one that is heard twice, from the terminal and from a parent process, is no second one."""
    now, ended = [5.0], []
    monkeypatch.setattr(stopping, "monotonic", lambda: now[0])
    monkeypatch.setattr(os, "_exit", ended.append)
    request = StopRequest()
    request.hear(signal.SIGINT)
    now[0] += seconds
    request.hear(second)
    assert ended == ([130] if ends else [])


def test_a_table_that_is_half_changed_is_known():
    table = Table(5)
    splats, optimizers = dict(table.splats), table.optimizers
    assert rows_agree(splats, optimizers, [torch.zeros(5), None, 0.5, torch.tensor(3)])
    assert not rows_agree(splats, optimizers, [torch.zeros(6)])
    assert not rows_agree({**splats, "means": torch.nn.Parameter(torch.zeros(6, 3))}, optimizers, [])
    assert not rows_agree({name: torch.nn.Parameter(torch.zeros(6, 3)) for name in splats}, optimizers, [])
    optimizers["scales"].state[splats["scales"]]["exp_avg"] = torch.zeros(4, 3)
    assert not rows_agree(splats, optimizers, [])
