# SPDX-License-Identifier: Apache-2.0
"""Splats that lose their residual in training: what moves, what is carried along, and that they come back."""

from pathlib import Path

import pytest
import torch
from gsplat.strategy.ops import duplicate, remove, split
from nerfstudio.engine.callbacks import TrainingCallbackAttributes
from nerfstudio.utils.eval_utils import eval_setup
from short_trainings import assert_same_training, checkpoint_of, command_line, models_of, trained
from torch.testing import assert_close

from nrfgs_ns.appearance.diffuse import DIFFUSE, SHIFT, mean_length
from nrfgs_ns.appearance.head import SplatAppearance
from nrfgs_ns.appearance.reduce import Field
from nrfgs_ns.capacity.report import add_to_report, read_report
from nrfgs_ns.diffuse_splats import (
    DiffuseSchedule,
    DiffuseSplats,
    give_back,
    make_diffuse,
    put_diffuse_last,
    schedule_for,
)
from nrfgs_ns.errors import InputError
from nrfgs_ns.field_views import FieldViews, dropped
from nrfgs_ns.residuals import look_over
from nrfgs_ns.studies.run import parse

BELOW_4 = DiffuseSplats(threshold=4.0)
pytestmark = pytest.mark.usefixtures("no_cuda")


DIFFUSE_TWICE = {
    "--pipeline.model.warmup-length": 2,
    "--pipeline.model.refine-every": 4,
    "--pipeline.model.reset-alpha-every": 20,
    "--pipeline.model.densify-grad-thresh": 1e-6,
    "--pipeline.model.num-downscales": 0,
    "--pipeline.model.stop-split-at": 100,
    "--pipeline.model.appearance.output-init": "default",
    "--pipeline.model.warmup-steps": 0,
    "--pipeline.model.appearance.latent-dim": 4,
    "--pipeline.model.diffuse.start": 6,
    "--pipeline.model.diffuse.every": 8,
    "--pipeline.model.diffuse.trial": 3,
    "--pipeline.model.diffuse.threshold": 4.0,
}
"""Splits and prunes every 4th step; splats become diffuse after step 6, 14 and 22."""
NO_FIELD = dict.fromkeys(name for name in DIFFUSE_TWICE if "appearance" in name or "warmup-steps" in name)
MCMC = {"--pipeline.model.densification": "mcmc"} | dict.fromkeys(
    name
    for name in DIFFUSE_TWICE
    if name.split(".")[-1] in ("densify-grad-thresh", "reset-alpha-every", "stop-split-at")
)


def words(scene: Path, out: Path, *more: dict, method: str = "nrfgs", steps: int = 24) -> list[str]:
    """A command line for ns-train."""
    return command_line(method, scene, out, steps, DIFFUSE_TWICE, *more)


@pytest.fixture
def untrained(tiny_scene, tmp_path):
    """A model whose field says something, and its datamanager."""
    torch.manual_seed(0)
    pipeline = parse(words(tiny_scene, tmp_path)).pipeline.setup(device="cpu", test_mode="test")
    pipeline.eval()
    return pipeline.model, pipeline.datamanager


def picture(model, camera) -> torch.Tensor:
    with torch.no_grad():
        return model.get_outputs_for_camera(camera)["rgb"]


def test_some_become_diffuse_and_all_get_back_what_they_had(untrained):
    model, data = untrained
    cameras = data.train_dataset.cameras
    before = {name: value.detach().clone() for name, value in model.gauss_params.items()}
    full = picture(model, cameras[:1])
    make_diffuse(model, data, BELOW_4, {})
    diffuse, shift = model.densification.state[DIFFUSE], model.densification.state[SHIFT]
    assert 20 < int(diffuse.sum()) < model.num_points - 20
    assert (shift[~diffuse] == 0).all() and shift[diffuse].abs().max() > 1e-3
    assert (model.gauss_params["features_dc"][~diffuse] == before["features_dc"][~diffuse]).all()
    changed = picture(model, cameras[:1])
    again = look_over(model, cameras)
    assert (again.largest[diffuse] < 1e-2).all() and again.largest[~diffuse].max() > 4.0  # float32's rounding of means
    assert 0 < (changed - full).abs().mean() < 4.0 / 255  # what one splat changes by at most, on average
    give_back(model)
    assert DIFFUSE not in model.densification.state and SHIFT not in model.densification.state
    for name, value in before.items():
        # Added and taken away in float32; the numbers are below 8.
        assert_close(model.gauss_params[name].detach(), value, rtol=0, atol=2e-6, msg=name)
    assert_close(picture(model, cameras[:1]), full, rtol=0, atol=1e-5)
    give_back(model)  # nothing to give: nothing happens


def test_a_splat_that_starts_to_matter_comes_back(untrained):
    model, data = untrained
    cameras = data.train_dataset.cameras
    make_diffuse(model, data, BELOW_4, {})
    first = model.densification.state[DIFFUSE].clone()
    give_back(model)
    row, loud = int(first.nonzero()[0]), int(look_over(model, cameras).largest.argmax())
    assert not first[loud]
    with torch.no_grad():  # it becomes another of those that matter most, at the same place
        for value in model.gauss_params.values():
            value[row] = value[loud]
    make_diffuse(model, data, BELOW_4, {})
    assert first[row] and not model.densification.state[DIFFUSE][row]
    assert model.densification.state[DIFFUSE].any()


@pytest.fixture
def learning(untrained):
    """The same with an Adam for each group, and two views set aside whose photographs are the model's own pictures, as
    are all others."""
    model, data = untrained
    with torch.no_grad():  # residuals of many sizes
        for branch in (model.head.low, model.head.high):
            branch[2].weight.mul_(2.0)
        model.gauss_params["latents"].mul_(10.0)
        model.gauss_params["opacities"].normal_(0.0, 1.0)
    for index in range(len(data.train_dataset)):
        camera, _ = data.train_view(index)
        data.cached_train[index]["image"] = (picture(model, camera) * 255).round().to(torch.uint8)
    data.set_views_aside([2, 6])
    rates = {"latents": 1e-3, "features_dc": 1e-3, "opacities": 1e-3, "means": 1e-5, "scales": 1e-4, "quats": 1e-4}
    optimizers = {name: torch.optim.Adam([model.gauss_params[name]], lr=rate) for name, rate in rates.items()}
    optimizers["field"] = torch.optim.Adam(model.head.parameters(), lr=1e-4)
    return model, data, optimizers


def test_how_many_is_chosen_by_what_they_cost(learning):
    """The more may be lost, the more splats become diffuse: all of them where everything may."""
    model, data, optimizers = learning
    shares = []
    for budget in (0.0, 10.0, 1e3):
        make_diffuse(model, data, DiffuseSplats(budget=budget, settle=4), optimizers)
        shares.append(model.densification.state[DIFFUSE].float().mean().item())
        give_back(model)
    assert shares == sorted(shares) and shares[0] < 0.7 and shares[0] < shares[1] < shares[2] == 1.0


def test_noise_that_was_learnt_does_not_hold_splats(learning):
    """Residuals fitted to the training views, which say nothing of others, are worth much there, and nothing aside."""
    model, data, optimizers = learning
    cameras = data.train_dataset.cameras
    field = Field(model.head, {name: value.detach() for name, value in model.gauss_params.items()})
    seen = look_over(model, cameras)
    mean = dropped(field, seen, float("inf"))
    for index in data.views_aside:  # there, the scene is what the others see on average
        view = model.look(cameras[index : index + 1])
        rgb = model.paint(view, mean.head(mean.splats, view.visible, view.center))[0]["rgb"]
        data.cached_train[index]["image"] = (rgb * 255).round().to(torch.uint8)
    others = FieldViews(model, [data.train_view(index) for index in range(8) if index not in data.views_aside])
    assert others.psnr(field) - others.psnr(mean) > 3.0
    make_diffuse(model, data, DiffuseSplats(budget=0.0, settle=1), optimizers)
    assert model.densification.state[DIFFUSE].all()


def test_the_head_is_evaluated_for_the_others_only(untrained):
    model, data = untrained
    cameras, all_bytes = data.train_dataset.cameras, model.parameter_bytes
    assert model.num_diffuse == 0
    make_diffuse(model, data, BELOW_4, {})
    diffuse, rows = model.densification.state[DIFFUSE], []
    assert model.num_diffuse == diffuse.sum() > 0
    assert model.parameter_bytes == all_bytes - 4 * model.gauss_params["latents"].shape[1] * model.num_diffuse
    handle = model.head.low.register_forward_hook(lambda _, inputs, __: rows.append(len(inputs[0])))
    model.train()
    model.step = 0
    outputs = model.get_outputs(cameras[:1])
    handle.remove()
    visible = model.info["gaussian_ids"]
    assert rows == [int((~diffuse[visible]).sum())] and 0 < rows[0] < len(visible)
    outputs["rgb"].sum().backward()
    assert (model.gauss_params["latents"].grad[diffuse] == 0).all()
    assert model.gauss_params["features_dc"].grad[diffuse].abs().sum() > 0


def test_densification_carries_the_tables_along(untrained):
    model, data = untrained
    make_diffuse(model, data, BELOW_4, {})
    state = model.densification.state
    params = model.gauss_params
    optimizers = {name: torch.optim.Adam([value]) for name, value in params.items()}
    with torch.no_grad():  # a mark that tells whose row it is
        params["latents"][:, 0] = state[DIFFUSE].float()
        params["latents"][:, 1:4] = state[SHIFT][:, :3]
    torch.manual_seed(0)
    for change in (duplicate, split, remove):
        chosen = torch.rand(len(params["means"])) < 0.3
        change(params, optimizers, state, chosen)
        assert len(state[DIFFUSE]) == len(state[SHIFT]) == len(params["means"])
        assert (params["latents"][:, 0].bool() == state[DIFFUSE]).all()
        assert (params["latents"][:, 1:4] == state[SHIFT][:, :3]).all()
    assert 0 < state[DIFFUSE].sum() < len(state[DIFFUSE])


def everything(model, optimizers) -> dict[str, torch.Tensor]:
    """All that has a row for each splat: parameters, moments, statistics."""
    tables = {f"parameter {name}": value.detach().clone() for name, value in model.gauss_params.items()}
    for name, optimizer in optimizers.items():
        (parameter,) = optimizer.param_groups[0]["params"]
        assert parameter is model.gauss_params[name]
        moments = optimizer.state[parameter]
        assert float(moments["step"]) == 1
        tables |= {f"{moment} {name}": moments[moment].clone() for moment in ("exp_avg", "exp_avg_sq")}
    return tables | {name: value.clone() for name, value in model.densification.state.items() if torch.is_tensor(value)}


def test_diffuse_splats_come_last_with_all_that_is_theirs(untrained):
    model, data = untrained
    params, state = model.gauss_params, model.densification.state
    optimizers = {name: torch.optim.Adam([value], lr=1e-3) for name, value in params.items()}
    for name, value in params.items():
        value.grad = torch.randn_like(value)
        optimizers[name].step()
        value.grad = None
    state |= {name: torch.rand(model.num_points) for name in ("grad2d", "count", "radii")}
    put_diffuse_last(model, optimizers)  # none is: nothing happens
    make_diffuse(model, data, BELOW_4, {})
    camera = data.train_dataset.cameras[:1]
    before, drawn = everything(model, optimizers), picture(model, camera)
    diffuse = before[DIFFUSE]
    assert (diffuse[:-1] & ~diffuse[1:]).any()
    put_diffuse_last(model, optimizers)
    after = everything(model, optimizers)
    order = torch.cat([(~diffuse).nonzero()[:, 0], diffuse.nonzero()[:, 0]])
    assert after.keys() == before.keys() and len(after) == 3 * len(params) + 5
    for name, value in before.items():
        assert torch.equal(after[name], value[order]), name
    assert isinstance(state["scene_scale"], float)
    assert_close(picture(model, camera), drawn, rtol=0, atol=1e-6)  # splats of one depth may be blended in turn
    held = list(params.values())
    put_diffuse_last(model, optimizers)  # they do: the optimisers keep what they have
    assert all(value is old for value, old in zip(params.values(), held, strict=True))
    give_back(model)
    model.train()
    model.get_outputs(camera)["rgb"].sum().backward()
    for optimizer in optimizers.values():
        optimizer.step()


def test_the_schedule_moves_what_densification_has_put_behind(untrained, tmp_path):
    model, data = untrained
    params, state = model.gauss_params, model.densification.state
    optimizers = {name: torch.optim.Adam([value]) for name, value in params.items()}
    schedule = DiffuseSchedule(DiffuseSplats(start=6, every=20, trial=3, threshold=4.0), data, optimizers, tmp_path)
    for step in range(6, 9):
        schedule.after_step(model, step)
        count, diffuse = model.num_points, state[DIFFUSE]
        assert len(diffuse) == count and torch.equal(diffuse, diffuse.sort().values) and 0 < diffuse.sum() < count
        duplicate(params, optimizers, state, ~diffuse & (torch.arange(count) < 10))
        assert not state[DIFFUSE][-1]


def test_the_schedule(untrained, monkeypatch):
    model, data = untrained
    done = []

    def look(model, *_):
        done.append(("look", step))
        model.densification.state[DIFFUSE] = torch.zeros(1, dtype=torch.bool)
        return []

    def trial(model):
        done.append(("trial", step))
        model.densification.state.pop(DIFFUSE, None)

    monkeypatch.setattr("nrfgs_ns.diffuse_splats.make_diffuse", look)
    monkeypatch.setattr("nrfgs_ns.diffuse_splats.give_back", trial)
    schedule = DiffuseSchedule(DiffuseSplats(start=6, every=10, trial=3, stop=30), data, {})
    for step in range(60):
        schedule.after_step(model, step)
    assert schedule.last_decision == 26 and not schedule.is_done(25) and schedule.is_done(26)
    assert done == [("look", 6), ("trial", 13), ("look", 16), ("trial", 23), ("look", 26)]


@pytest.fixture(scope="module")
def whole(tiny_scene, tmp_path_factory):
    """config.yml of the unbroken training."""
    return trained(words(tiny_scene, tmp_path_factory.mktemp("whole")))


COSTLY = {"--pipeline.model.residual-cost": 0.05, "--pipeline.model.diffuse.stop": 20}
"""The last look is after step 22."""


@pytest.mark.parametrize(
    "more, charged",
    [
        ({"--pipeline.model.stop-split-at": 16}, range(13, 23)),  # splits after step 12, and not after 16 any more
        ({"--pipeline.model.stop-split-at": 0}, range(23)),
        ({"--pipeline.model.warmup-length": 240}, range(23)),
        ({}, range(21, 23)),  # splits after step 20, and would after the training's last one
        ({"--pipeline.model.stop-split-at": 16, "--schedule-steps": 48}, range(23)),  # step 8: before the first
        ({"--pipeline.model.stop-split-at": 9, "--schedule-steps": 12}, range(17, 23)),  # step 18
        ({"--pipeline.model.residual-cost": 0.0, "--pipeline.model.stop-split-at": 0}, range(0)),
    ],
)
def test_residuals_cost_from_the_end_of_densification_until_the_last_look(more, charged, tiny_scene, tmp_path):
    """While splats are added nothing is charged: gradients on the screen would stay large, and more splats split."""
    trainer = parse(words(tiny_scene, tmp_path, COSTLY, more)).setup(local_rank=0, world_size=1)
    trainer.setup()
    assert charged_steps(trainer, 0) == list(charged)


@pytest.mark.parametrize("start, charged", [(8, range(13, 23)), (15, range(15, 23)), (23, range(0))])
def test_a_continued_training_charges_as_the_unbroken_one(start, charged, tiny_scene, tmp_path):
    line = words(tiny_scene, tmp_path, COSTLY, {"--pipeline.model.stop-split-at": 16}, steps=24 - start)
    trainer = parse(line).setup(local_rank=0, world_size=1)
    trainer.setup()
    trainer._start_step = start
    attributes = TrainingCallbackAttributes(trainer.optimizers, trainer.grad_scaler, trainer.pipeline, trainer)
    trainer.pipeline.model.get_training_callbacks(attributes)
    assert charged_steps(trainer, start) == list(charged)


def test_a_continued_training_keeps_the_evidence_of_its_folder(tiny_scene, tmp_path):
    trainer = parse(words(tiny_scene, tmp_path)).setup(local_rank=0, world_size=1)
    trainer.setup()
    attributes = TrainingCallbackAttributes(trainer.optimizers, trainer.grad_scaler, trainer.pipeline, trainer)
    for start, kept in ((8, {"looks": []}), (0, {})):
        add_to_report(trainer.base_dir, {"looks": []})
        trainer._start_step = start
        trainer.pipeline.model.get_training_callbacks(attributes)
        assert read_report(trainer.base_dir) == kept
    # Looks that are made again, from a checkpoint before them, are there once.
    model = trainer.pipeline.model
    model.densification.state[DIFFUSE] = torch.zeros(model.num_points, dtype=torch.bool)
    schedule = schedule_for(model, trainer.pipeline.datamanager, 1, None, trainer.base_dir)
    for step in (6, 14, 6, 14):
        schedule.tell(model, step, [])
    assert [look["step"] for look in read_report(trainer.base_dir)["looks"]] == [6, 14]


def test_a_threshold_sets_no_view_aside(tiny_scene, tmp_path):
    trainer = parse(words(tiny_scene, tmp_path)).setup(local_rank=0, world_size=1)
    trainer.setup()
    assert trainer.pipeline.datamanager.views_aside == []


def charged_steps(trainer, start: int) -> list[int]:
    """The steps from `start` to 23 in whose loss residuals are; nothing that comes after a step is done."""
    trainer.pipeline.train()
    steps = []
    for step in range(start, 24):
        trainer.pipeline.model.step = step
        _, losses, _ = trainer.train_iteration(step)
        steps += [step] if "residual" in losses else []
    return steps


@pytest.mark.parametrize(
    "more, told",
    [
        ({"--pipeline.model.stop-split-at": 16}, False),
        ({"--pipeline.model.stop-split-at": 28}, True),
        ({"--pipeline.model.stop-split-at": 28, "--schedule-steps": 160}, False),  # stretched, it ends at step 7
        # The last look would be after step 62. Step 24, the last, splits: the end comes before a step that is charged.
        ({"--pipeline.model.stop-split-at": 28, "--pipeline.model.diffuse.stop": 60, "--max-num-iterations": 25}, True),
        ({"--pipeline.model.diffuse.start": None}, True),
        ({"--pipeline.model.diffuse.start": None, "--pipeline.model.residual-cost": 0.0}, False),
    ],
)
def test_a_cost_that_is_never_charged_is_told(more, told, tiny_scene, tmp_path, capsys):
    line = words(tiny_scene, tmp_path, COSTLY, {"--pipeline.model.stop-split-at": 16}, more, steps=40)
    parse(line).setup(local_rank=0, world_size=1).setup()
    assert ("residual-cost has no effect" in " ".join(capsys.readouterr().out.split())) == told


def test_what_a_residual_costs(untrained):
    """Three splats: silent; longer by 3-4-12 of 13 parts; diffuse. Only what says something is pulled at."""
    base = SplatAppearance(torch.full((3, 3), 0.5), torch.full((3,), 0.5))
    changes = torch.tensor([[0.0, 0, 0, 0], [0.03, 0.04, 0.0, 0.12], [0.0, 0, 0, 0]], requires_grad=True)
    length = mean_length(base, SplatAppearance(base.colors + changes[:, :3], base.opacities + changes[:, 3]))
    assert_close(length, torch.tensor(0.13 / 3), rtol=0, atol=1e-4)  # the round corner's size
    length.backward()
    assert (changes.grad[[0, 2]] == 0).all()
    assert_close(changes.grad[1], torch.tensor([3.0, 4.0, 0.0, 12.0]) / 13 / 3, rtol=1e-5, atol=0)
    assert_close(
        mean_length(SplatAppearance(*(t[:0] for t in base)), SplatAppearance(*(t[:0] for t in base))) + 1,
        torch.ones(()),
        rtol=0,
        atol=2e-4,
    )


@pytest.mark.parametrize("half", [8, pytest.param(12, marks=pytest.mark.slow)])
def test_resumed_training_is_the_unbroken_one(half, whole, tiny_scene, tmp_path):
    """Cut while some splats are diffuse (after step 7) and in a trial (after step 11 to 13)."""
    first = trained(words(tiny_scene, tmp_path / "half", steps=half))
    rest = trained(words(tiny_scene, tmp_path / "rest", {"--load-dir": models_of(first)}, steps=24 - half))
    assert (DIFFUSE in strategy_of(first)) == (half == 8)
    assert_same_training(checkpoint_of(rest), checkpoint_of(whole))
    diffuse = strategy_of(rest)[DIFFUSE]
    assert [look["step"] for look in read_report(rest.parent)["looks"]] == [6, 14, 22]
    assert SHIFT in strategy_of(rest) and len(diffuse) != 300 and 0 < int(diffuse.sum()) < len(diffuse)
    assert torch.equal(diffuse, diffuse.sort().values)
    _, pipeline, _, _ = eval_setup(rest)
    assert (pipeline.model.densification.state[DIFFUSE] == diffuse).all()


def strategy_of(config: Path) -> dict:
    """What densification carries along, in a training's checkpoint."""
    return checkpoint_of(config)["pipeline"]["_model._extra_state"]["strategy"]


@pytest.mark.parametrize("more, last", [({}, 23), ({"--schedule-steps": 6000}, 23), ({"--time-budget": 100}, None)])
def test_an_end_before_the_last_look_is_told(more, last, tiny_scene, tmp_path, capsys):
    """Looks are made at steps of the training, whatever its schedules are stretched to. With a time budget nobody knows
    the last one."""
    beyond = {"--pipeline.model.diffuse.start": 2000, "--pipeline.model.diffuse.threshold": None}
    parse(words(tiny_scene, tmp_path, beyond, more)).setup(local_rank=0, world_size=1).setup()
    said = " ".join(capsys.readouterr().out.split())
    assert (f"this training ends at step {last}:" in said) == ("this training ends" in said) == (last is not None)


def test_a_new_training_begins_a_new_report(tiny_scene, tmp_path):
    line = words(tiny_scene, tmp_path, {"--timestamp": "again", "--pipeline.model.diffuse.stop": 5}, steps=8)
    for _ in range(2):
        config = trained(line)
        assert [look["step"] for look in read_report(config.parent)["looks"]] == [6]
    off = parse([*line, "--pipeline.model.diffuse.start", "None"]).setup(local_rank=0, world_size=1)
    off.setup()
    assert read_report(config.parent) == {}


def test_off_is_off(tiny_scene, tmp_path):
    config = parse(words(tiny_scene, tmp_path, {"--pipeline.model.diffuse.start": "None"}))
    assert config.pipeline.model.diffuse.start is None
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    assert schedule_for(trainer.pipeline.model, trainer.pipeline.datamanager, 1) is None
    trainer.train()
    state = trainer.pipeline.model.densification.state
    assert DIFFUSE not in state and SHIFT not in state
    assert DIFFUSE not in trainer.pipeline.model._splats_to_draw()


@pytest.mark.parametrize(
    "method, more, says",
    [
        ("nrfgs-sh", NO_FIELD, "'sh' head has no residual"),
        ("nrfgs", MCMC, "'mcmc' moves splats"),
        ("nrfgs", {"--pipeline.model.diffuse.start": -1}, "start is -1"),
        ("nrfgs", {"--pipeline.model.diffuse.trial": 8}, "trial is 8 steps"),
        ("nrfgs", {"--pipeline.model.diffuse.threshold": 0.0}, "threshold is 0.0"),
        ("nrfgs", {"--pipeline.model.diffuse.budget": -1}, "budget is -1"),
        ("nrfgs", {"--pipeline.model.diffuse.budget": "nan"}, "budget is nan"),
        ("nrfgs", {"--pipeline.model.diffuse.views": 0}, "views is 0"),
        ("nrfgs", {"--pipeline.model.diffuse.settle": 0}, "settle is 0"),
        ("nrfgs", {"--pipeline.model.residual-cost": -1}, "residual-cost is -1"),
    ],
)
def test_what_cannot_be_followed_is_refused_before_training(method, more, says, tiny_scene, tmp_path):
    line = words(tiny_scene, tmp_path, more, method=method)
    with pytest.raises(InputError, match=says):
        parse(line).setup(local_rank=0, world_size=1).setup()
