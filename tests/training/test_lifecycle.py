# SPDX-License-Identifier: Apache-2.0
"""Train, evaluate, render, resume, refuse: nerfstudio's own commands on a tiny scene, with CUDA out of reach."""

import functools
import io
import json
import re
from pathlib import Path

import pytest
import torch
from nerfstudio.scripts.eval import ComputePSNR
from nerfstudio.utils.eval_utils import eval_setup
from rich.console import Console
from short_trainings import assert_same_training, checkpoint_of, command_line, models_of, set_up, trained, untrained
from torch.testing import assert_close

from nrfgs_lab.training_run import evaluate, parse
from nrfgs_ns.appearance import gsnb, sg
from nrfgs_ns.data.pictures import read_size
from nrfgs_ns.densification import Splatfacto
from nrfgs_ns.errors import InputError
from nrfgs_ns.training import pipeline, progress, trainer_config
from nrfgs_ns.training.checkpoint_files import read_latest

pytestmark = pytest.mark.usefixtures("no_cuda")

RULES = Splatfacto(warmup_length=2, refine_every=4, reset_alpha_every=6, densify_grad_thresh=1e-6, stop_split_at=100)
BUSY = {
    "--pipeline.model.densification": RULES,
    "--pipeline.model.resolution-schedule": 10,
    "--pipeline.model.num-downscales": 1,
    "--pipeline.model.few-views": "off",
}
"""Densify every 4th step, reset opacity every 24th. 8 training views hold densification back for 12 steps after it."""
STEPS, HALF = 26, 13
"""Refinements at steps 12, 16 and 20, a reset at step 24; a checkpoint after the step in the middle."""

METHODS = {
    "nrfgs": (3 + 32, 6664, ["latents", "field"]),
    "nrfgs-sh": (48, 0, []),
    "nrfgs-vdgs": (48, 524_288 + 1729, ["field"]),
    "nrfgs-gsnb": (48, 7760, ["features_rest", "field"]),
    "nrfgs-sg": (24, 0, ["sg_axes", "sg_sharpness", "sg_colors"]),
    "nrfgs-deferred": (16, 38_787, ["features", "field"]),
    "nrfgs-latent-spec": (15, 28_167, ["features", "field"]),
}
"""Of each method: colour numbers per splat, shared weights, and groups of parameters that its head adds."""


def options(scene: Path, out: Path, method: str = "nrfgs", *more: dict, steps: int = STEPS) -> list[str]:
    return command_line(method, scene, out, steps, BUSY, *more)


@pytest.fixture(scope="module", autouse=True)
def schedules():
    """All of a head happens within a test: the first lobes come after splits."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gsnb, "RAMP_STEPS", 20)
        patch.setattr(sg, "START_STEP", 10)
        yield


@pytest.fixture(scope="module")
def finished(tiny_scene, tmp_path_factory):
    """config.yml of a finished training of each method, which has the checkpoint of step `HALF`, too."""

    @functools.cache
    def config_of(method: str) -> Path:
        return trained(options(tiny_scene, tmp_path_factory.mktemp(method), method, {"--steps-per-save": HALF}))

    return config_of


@pytest.mark.parametrize("method", METHODS)
def test_train_and_eval(method, finished, tmp_path, recwarn, printed):
    config = finished(method)
    results = evaluate(config, tmp_path / "eval.json")
    assert not [warning for warning in recwarn if "degrees of freedom" in str(warning.message)]
    images = results["per_image"]
    assert len(images) == 2
    assert results["psnr"] == pytest.approx(sum(image["psnr"] for image in images) / 2)
    assert 8 < results["psnr"] < 40 and 0 < results["ssim"] < 1 and 0 < results["l1"] < 1
    # 48 x 36 is too small for MS-SSIM's five scales, and LPIPS has no weights here: no number, and no crash.
    assert results["ms_ssim"] is None and results["lpips"] is None
    _, loaded, path, step = eval_setup(config)
    assert step == STEPS - 1
    assert results["splats"] == loaded.model.num_points
    assert results["parameter_bytes"] == loaded.model.parameter_bytes
    colors, shared, groups = METHODS[method]
    assert results["parameter_bytes"] == 4 * (loaded.model.num_points * (3 + 3 + 4 + 1 + colors) + shared)
    # Adam's running mean of every tensor that the head adds has moved: it is learning.
    state = checkpoint_of(config)
    for group in groups:
        learning = state["optimizers"][group]["state"]
        assert learning and all((of_one["exp_avg"] != 0).any() for of_one in learning.values()), group
        if group != "field":
            assert learning[0]["exp_avg"].shape == state["pipeline"][f"_model.gauss_params.{group}"].shape

    if method == "nrfgs":
        pipeline.print_evaluation(results | {"per_image": [*images, {"image": "hidden.png", "psnr": None}]})
        assert re.search(r"(?s)Means over 2 test views\b.*nothing to measure of hidden.png", printed())
        ComputePSNR(config, tmp_path / "again.json", render_output_path=tmp_path / "pairs").main()
        assert [file.name[:13] for file in sorted((tmp_path / "pairs").iterdir())] == ["eval_img_0000", "eval_img_0001"]


def test_renderings_have_the_names_of_their_photographs(finished, tmp_path, tiny_scene, dataset_render):
    config = finished("nrfgs")
    dataset_render(load_config=config, output_path=tmp_path / "renders", image_format="png").main()
    names = json.loads((tiny_scene / "transforms.json").read_text())["test_filenames"]
    for output in ("rgb", "depth", "accumulation", "gt-rgb"):
        folder = tmp_path / "renders" / "test" / output
        assert sorted(file.stem for file in folder.rglob("*.png")) == sorted(Path(name).stem for name in names)
    half = {"image_format": "png", "rendered_output_names": ["rgb", "gt-rgb"], "downscale_factor": 2.0}
    dataset_render(load_config=config, output_path=tmp_path / "half", **half).main()
    assert [read_size(file) for file in (tmp_path / "half").rglob("*.png")] == 4 * [(24, 18)]


@pytest.mark.parametrize("method", METHODS)
def test_resumed_training_is_the_unbroken_one(method, finished, tiny_scene, tmp_path):
    """From the checkpoint in the middle. In both parts splats are split (with random samples), pruned and their Adam
    state carried along; the second resets opacities."""
    folder = models_of(finished(method))
    rest = checkpoint_of(trained(options(tiny_scene, tmp_path, method, {"--load-dir": folder, "--load-step": HALF})))
    whole, half = (read_latest(folder, step)[1] for step in (STEPS - 1, HALF))
    counts = [len(part["pipeline"]["_model.gauss_params.means"]) for part in (half, whole)]
    assert counts[0] != counts[1], "nothing was densified in the second part: the test would prove nothing"
    assert_same_training(rest, whole)


def test_learning_rates_of_the_command_count_where_a_training_goes_on(finished, tiny_scene, tmp_path):
    """Those with a schedule and those without one, at the schedule's present place."""
    load = {"--load-dir": models_of(finished("nrfgs"))}
    faster = {f"--optimizers.{name}.optimizer.lr": 10 * lr for name, lr in (("means", 1.6e-4), ("quats", 1e-3))}
    faster |= {"--optimizers.means.scheduler.lr-final": 1.6e-5, "--optimizers.quats.optimizer.eps": 1e-9}
    rates = []
    for name, more in (("same", {}), ("faster", faster)):
        trainer = set_up(options(tiny_scene, tmp_path / name, "nrfgs", load, more, steps=STEPS + 2))
        groups = {name: trainer.optimizers.optimizers[name].param_groups[0] for name in ("means", "quats")}
        before = [group["lr"] for group in groups.values()]
        for name, parameter in trainer.pipeline.model.gauss_params.items():
            (held,) = trainer.optimizers.optimizers[name].param_groups[0]["params"]
            assert held is parameter, "the host's way, replacing parameters on load, leaves orphans"
        trainer.train()
        rates.append(torch.tensor(before + [group["lr"] for group in groups.values()]))
    assert_close(rates[1], 10 * rates[0])
    assert rates[0][2] < rates[0][0], "the schedule of the means fell"
    assert groups["quats"]["eps"] == 1e-9


@pytest.mark.parametrize("method, more, says", [
    ("nrfgs-sh", {}, "written by the 'nrf' head"),
    ("nrfgs", {"--pipeline.model.appearance.latent-dim": 8}, "latents"),
    ("nrfgs", {"--pipeline.model.appearance.hidden-width": 32}, "head.low"),
    ("nrfgs", {"--pipeline.model.appearance.split-bands": False}, "head."),
])  # fmt: skip
def test_checkpoint_of_another_head_is_refused(method, more, says, finished, tiny_scene, tmp_path):
    args = options(tiny_scene, tmp_path, method, {"--load-dir": models_of(finished("nrfgs"))}, more)
    with pytest.raises(InputError, match=says) as error:
        set_up(args)
    assert "the config.yml beside it" in str(error.value)
    with pytest.raises(SystemExit, match="2"):  # ns-train would take that file alone, and begin anew
        parse([*args, "--load-config", str(finished("nrfgs"))])


SPOKEN = {"--logging.local-writer.enable": True, "--logging.steps-per-log": 1}


def test_a_training_with_the_line_is_the_one_without(tiny_scene, tmp_path, monkeypatch):
    """The second goes on from a checkpoint, though nerfstudio names step 0 with what it logs before the first step."""
    said = io.StringIO()
    for name, value in (("SECONDS_BETWEEN_LINES", 0.0), ("SHORTEST", 0.0), ("SHARE", float("inf"))):
        monkeypatch.setattr(progress, name, value)
    monkeypatch.setattr(progress, "CONSOLE", Console(file=said, force_terminal=False, width=200))
    options = {"--pipeline.model.densification": "splatfacto,warmup_length=2,refine_every=4"}
    load = {"--load-dir": models_of(trained(command_line("nrfgs", tiny_scene, tmp_path / "half", 6, options)))}
    quiet = trained(command_line("nrfgs", tiny_scene, tmp_path / "quiet", 12, options, load))
    assert not said.getvalue()
    spoken = trained(command_line("nrfgs", tiny_scene, tmp_path / "spoken", 12, options, load, SPOKEN))
    assert_same_training(checkpoint_of(quiet), checkpoint_of(spoken), rtol=0.0, atol=0.0)

    pattern = r"step (\d+) of 12 .* (\d+\.\d) dB on test view (\S+\.png)"
    lines = [re.match(pattern, line) for line in said.getvalue().splitlines()]
    assert [int(line[1]) for line in lines] == [*range(7, 13), 12] and len({line[3] for line in lines}) == 1


def test_the_size_of_large_or_smaller_photographs_is_said(tiny_scene, tmp_path, monkeypatch, capsys):
    args = command_line("nrfgs", tiny_scene, tmp_path, 2, {"--data": None, "--pipeline.model.num-downscales": 0})
    lines = []
    for factor, most in (("1", 1600), ("2", 1600), ("1", 10)):
        monkeypatch.setattr(trainer_config, "MAX_AUTO_RESOLUTION", most)
        set_up([*args, "nrfgs-data", "--data", str(tiny_scene), "--downscale-factor", factor])
        lines.append(re.findall(r"Images are read at .*, (\d+ x \d+) .*--downscale-factor", capsys.readouterr().out))
    assert lines == [[], ["24 x 18"], ["48 x 36"]]


def test_a_start_takes_one_thread_of_the_cpu(tiny_scene, tmp_path, monkeypatch):
    """Beside another process many small operations take many times as long with several."""
    counts, before = [], torch.get_num_threads()
    monkeypatch.setattr(pipeline, "photograph_model", lambda *_: counts.append(torch.get_num_threads()))
    torch.set_num_threads(2)
    try:
        untrained(tiny_scene, tmp_path)
        assert (counts, torch.get_num_threads()) == ([1], 2)
    finally:
        torch.set_num_threads(before)
