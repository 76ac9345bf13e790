# SPDX-License-Identifier: Apache-2.0
"""Capacity "auto": what pays stays, what does not goes, and what is left trains, resumes and loads."""

import json
from pathlib import Path

import pytest
import torch
from nerfstudio.engine.callbacks import TrainingCallbackAttributes
from nerfstudio.utils.eval_utils import eval_setup
from short_trainings import assert_same_training, checkpoint_of, command_line, models_of, trained
from torch.testing import assert_close

from nrfgs_ns.appearance.diffuse import DIFFUSE
from nrfgs_ns.appearance.reduce import Field, latent_basis, with_rank, with_unit_axes
from nrfgs_ns.capacity.config import CapacitySearch
from nrfgs_ns.capacity.install import install
from nrfgs_ns.capacity.report import add_to_report, continue_report, read_report
from nrfgs_ns.capacity.search import Decision, decide
from nrfgs_ns.capacity.settle import BASE, FIELD, TABLES, Settling, keep_the_mean, lesson_order, settle
from nrfgs_ns.errors import InputError
from nrfgs_ns.export import Export, read_splats
from nrfgs_ns.model import NrfgsModel
from nrfgs_ns.studies.run import evaluate, parse, train

pytestmark = pytest.mark.usefixtures("no_cuda")
SEARCH = "--pipeline.model.capacity-search"


DECIDES_AFTER_9 = {
    "--pipeline.model.warmup-length": 2,
    "--pipeline.model.refine-every": 4,
    "--pipeline.model.reset-alpha-every": 20,
    "--pipeline.model.stop-split-at": 100,
    "--pipeline.model.num-downscales": 0,
    "--pipeline.model.appearance.output-init": "default",
    "--pipeline.model.appearance.latent-dim": 6,
    "--pipeline.model.warmup-steps": 0,
    "--pipeline.model.capacity": "auto",
    f"{SEARCH}.step": 9,
    f"{SEARCH}.settle": 4,
    f"{SEARCH}.tolerance-db": 100.0,
}
"""Splits and prunes every 4th step, and decides after step 9; the field says something at once."""
ORIGINAL = {"--pipeline.model.densification": "original"}
MCMC = {
    "--pipeline.model.densification": "mcmc",
    "--pipeline.model.reset-alpha-every": None,
    "--pipeline.model.stop-split-at": None,
}


def words(scene: Path, out: Path, *more: dict, steps: int = 18) -> list[str]:
    """A command line for ns-train."""
    return command_line("nrfgs", scene, out, steps, DECIDES_AFTER_9, *more)


def set_up(scene: Path, out: Path, *more: dict, steps: int = 18):
    trainer = parse(words(scene, out, *more, steps=steps)).setup(local_rank=0, world_size=1)
    trainer.setup()
    return trainer


@pytest.fixture
def loud(tiny_scene, tmp_path):
    """The parts of a training whose field changes a lot with the view, before its first step."""
    torch.manual_seed(0)
    trainer = set_up(tiny_scene, tmp_path)
    model = trainer.pipeline.model
    with torch.no_grad():
        for branch in (model.head.low, model.head.high):
            branch[2].weight.mul_(6.0)
        model.gauss_params["opacities"].normal_(0.0, 2.0)
        model.gauss_params["latents"].mul_(20.0)
    for name in ("means", "scales", "quats"):  # where they should be, from where an Adam without state would push them
        trainer.optimizers.optimizers[name].param_groups[0]["lr"] = 1e-7
    return model, trainer.pipeline.datamanager, trainer.optimizers


def learn_gently(optimizers, share: float) -> None:
    """A tenth or so of the usual rates: after few steps with an Adam that starts anew, a score says little else."""
    for name in ("field", "latents", "features_dc", "opacities"):
        optimizers.optimizers[name].param_groups[0]["lr"] *= share


def photograph(model, data, appearance_of) -> None:
    """Let the training's photographs be the model's own pictures."""
    was_training = model.training
    model.eval()
    for index in range(len(data.train_dataset)):
        camera, _ = data.train_view(index)
        with torch.no_grad():
            view = model.look(camera)
            rgb = model.paint(view, appearance_of(view))[0]["rgb"]
        data.cached_train[index]["image"] = (rgb * 255).round().to(torch.uint8)
    model.train(was_training)


def test_a_scene_that_changes_with_the_view_keeps_what_shows_it(loud):
    model, data, optimizers = loud
    photograph(model, data, lambda view: model.head(view.splats, view.visible, view.center))
    learn_gently(optimizers, 0.1)
    before = {name: value.clone() for name, value in model.state_dict().items() if name != "_extra_state"}
    told: list[str] = []
    decision = decide(model, data, optimizers.optimizers, CapacitySearch(settle=8), told.append)
    tried = [f"the field without its {part}" for part in ("high branch", "opacity residual", "distance")]
    # What is kept is not tried again, unless something else went.
    assert told[:4] == ["the whole field", *tried] and told[-1] == "latents of fewer numbers"
    worth = {trial.part: trial.loss_db for trial in decision.trials}
    assert worth["high branch"] > 1.0 and worth["opacity residual"] > 1.0
    assert not {"high branch", "opacity residual"} & set(decision.dropped)
    assert all(loss > 1.0 for trial in decision.trials[1:3] for _, loss, _ in trial.rounds)
    assert {len(trial.rounds) for trial in decision.trials} == {2}  # the gap does not close
    for name, value in before.items():  # trying leaves the model as it is
        assert torch.equal(model.state_dict()[name], value), name


@pytest.fixture
def quiet(loud):
    """A scene that looks the same from everywhere; the field says little, and all of it is wrong."""
    model, data, optimizers = loud
    with torch.no_grad():
        for branch in (model.head.low, model.head.high):
            branch[2].weight.mul_(0.1)
            branch[2].bias.zero_()
    photograph(model, data, lambda view: model.head.base_appearance(view.splats, view.visible))
    learn_gently(optimizers, 0.3)
    return model, data, optimizers


def test_a_scene_that_looks_the_same_from_everywhere_keeps_nothing(quiet):
    model, data, optimizers = quiet
    decision = decide(model, data, optimizers.optimizers, CapacitySearch(settle=4))
    assert decision.dropped[:3] == ["high branch", "opacity residual", "distance"]
    trials = {trial.part: trial for trial in decision.trials}
    assert all(trial.loss_db <= trial.limit_db for trial in trials.values() if trial.dropped)
    head, splats = decision.chosen.field
    assert head.high is None and not head.config.opacity_residual and not head.config.use_distance
    assert splats["latents"].shape[1] == head.config.latent_dim
    assert decision.trials[-1].bytes < decision.trials[0].bytes


def test_what_is_gained_by_dropping_parts_is_not_spent_on_latents(quiet):
    """The field is better without what was wrong; latents are cut from that better field, and measured against it."""
    model, data, optimizers = quiet
    trials = decide(model, data, optimizers.optimizers, CapacitySearch(settle=4, tolerance_db=20.0)).trials
    *_, last_part, latents = trials
    assert latents.part.startswith("latents") and last_part.dropped and last_part.psnr > trials[0].psnr
    assert latents.loss_db == pytest.approx(last_part.psnr - latents.psnr)


@pytest.mark.parametrize("part", ["high branch", "opacity residual"])
def test_what_all_views_see_alike_moves_into_the_base(part, loud):
    """A part that is dropped takes along less if the base keeps its mean."""
    from nrfgs_ns.appearance.reduce import without_high_branch, without_opacity_residual

    model, data, _ = loud
    model.eval()
    field = Field(model.head, {name: value.detach() for name, value in model.gauss_params.items()})
    smaller = {"high branch": without_high_branch, "opacity residual": without_opacity_residual}[part](field)
    views = [data.train_view(index) for index in range(len(data.train_dataset))]
    kept = keep_the_mean(model, field, smaller, views)

    def error(other: Field) -> float:
        total = 0.0
        for camera, _ in views:
            view = model.look(camera)
            with torch.no_grad():
                pictures = [model.paint(view, f.head(f.splats, view.visible, view.center))[0]["rgb"]
                            for f in (field, other)]  # fmt: skip
            total += float((pictures[0] - pictures[1]).square().mean())
        return total

    assert error(kept) < 0.8 * error(smaller)


def test_settling_learns_from_the_views_given_and_from_no_other(loud, monkeypatch):
    model, data, optimizers = loud
    data.set_views_aside([2, 5])
    seen = []
    original = NrfgsModel.photometric_loss
    monkeypatch.setattr(
        NrfgsModel,
        "photometric_loss",
        lambda self, outputs, batch: seen.append((batch["image_idx"], original(self, outputs, batch))) or seen[-1][1],
    )
    order = lesson_order(data, 100)
    assert sorted(order) == [0, 1, 3, 4, 6, 7] and lesson_order(data, 100) == order and len(lesson_order(data, 4)) == 4
    field = Field(model.head, {name: value.detach() for name, value in model.gauss_params.items()})
    means = field.splats["means"].clone()
    settled = settle(model, field, [data.train_view(index) for index in order], 24, optimizers.optimizers)
    assert [index for index, _ in seen] == order * 4
    losses = [float(loss) for _, loss in seen]
    assert sum(losses[-6:]) < sum(losses[:6])
    assert not settled.field.splats["means"].equal(means) and model.gauss_params["means"].equal(means)
    for name in ("field", "latents", "features_dc", "opacities"):
        assert all(state["step"] == 24 for state in settled.moments[name].values())


def test_what_settles_is_the_mean_over_the_last_half_geometry_included(loud, monkeypatch):
    model, data, optimizers = loud
    steps: dict[int, list[torch.Tensor]] = {}

    class Watched(torch.optim.Adam):
        def step(self):
            super().step()
            value = self.param_groups[0]["params"][0].detach().clone()
            steps.setdefault(id(self), []).append(value)

    monkeypatch.setattr(torch.optim, "Adam", Watched)
    for name in ("means", "scales", "quats"):
        optimizers.optimizers[name].param_groups[0]["lr"] = 1e-3
    field = Field(model.head, {name: value.detach() for name, value in model.gauss_params.items()})
    settled = settle(model, field, [data.train_view(index) for index in range(4)], 5, optimizers.optimizers)
    shared, *tables = steps.values()  # in the order of the groups
    results = [next(settled.field.head.parameters()), *(settled.field.splats[name] for name in (*BASE, "latents"))]
    assert len(tables) == 6
    for seen, result in zip([shared, *tables], results, strict=True):
        assert len(seen) == 5 and not seen[0].equal(seen[-1])  # all learn
        assert_close(result.detach(), torch.stack(seen[2:]).mean(0), rtol=1e-6, atol=1e-7)


def test_a_later_round_is_what_as_many_steps_at_one_go_give(loud):
    """To the bit, and looking at a round changes neither those after it nor, later, itself."""
    model, data, optimizers = loud
    for name in ("means", "scales", "quats"):
        optimizers.optimizers[name].param_groups[0]["lr"] = 1e-3
    field = Field(model.head, {name: value.detach() for name, value in model.gauss_params.items()})
    views = [data.train_view(index) for index in range(3)]
    settling = Settling(model, field, views, 3, optimizers.optimizers, FIELD)
    assert model.config.background_color == "random"
    generator = torch.get_rng_state()
    rounds = [settling.advance() for _ in range(3)]
    assert generator.equal(torch.get_rng_state())
    torch.rand(1)
    assert [settled.steps for settled in rounds] == [3, 6, 12]
    for settled in rounds:
        straight = settle(model, field, views, settled.steps, optimizers.optimizers, FIELD)
        for one, other in zip(settled.field.head.parameters(), straight.field.head.parameters(), strict=True):
            assert one.equal(other) and one.requires_grad
        for name in TABLES:
            assert settled.field.splats[name].equal(straight.field.splats[name]), name
    for name, group in straight.moments.items():  # of twelve steps, as those of the last round
        for one, other in zip(rounds[-1].moments[name].values(), group.values(), strict=True):
            assert all(one[key].equal(other[key]) for key in ("step", "exp_avg", "exp_avg_sq")), name
    held = rounds[-1].field.splats["latents"]
    assert set(rounds[-1].moments["latents"]) == {held} and held.equal(straight.field.splats["latents"])


def test_adam_goes_on_but_for_what_has_another_shape(loud):
    """One step of settling after two of training: the splats' base has made three, shared weights and latents one."""
    model, data, optimizers = loud
    for name in ("features_dc", "latents"):
        for _ in range(2):
            model.gauss_params[name].grad = torch.ones_like(model.gauss_params[name])
            optimizers.optimizers[name].step()
    field = Field(model.head, {name: value.detach() for name, value in model.gauss_params.items()})
    views = [data.train_view(0)]
    fresh = settle(model, field, views, 1, optimizers.optimizers, FIELD).moments
    assert {name: {int(state["step"]) for state in fresh[name].values()} for name in ("features_dc", "latents")} == {
        "features_dc": {3},
        "latents": {1},
    }
    assert optimizers.optimizers["features_dc"].state[model.gauss_params["features_dc"]]["step"] == 2, "left as it was"


def test_what_has_settled_is_what_trains_on(loud):
    model, data, optimizers = loud
    for name in ("means", "scales", "quats"):
        optimizers.optimizers[name].param_groups[0]["lr"] = 1e-3
    before = {name: model.gauss_params[name].detach().clone() for name in BASE}
    decision = decide(model, data, optimizers.optimizers, CapacitySearch(settle=2, tolerance_db=100.0))
    install(model, optimizers, decision.chosen)
    for name in (*BASE, "latents"):
        assert model.gauss_params[name].equal(decision.chosen.field.splats[name]), name
    assert all(not model.gauss_params[name].equal(value) for name, value in before.items())


def test_unit_axes_are_the_same_components(loud):
    model, data, _ = loud
    field = Field(model.head, {name: value.detach() for name, value in model.gauss_params.items()})
    basis = latent_basis(field, torch.ones(model.num_points))
    unit = with_unit_axes(basis)
    assert_close(unit.axes.norm(dim=0), torch.ones(6, dtype=torch.float64))
    assert_close(unit.axes @ unit.inverse, torch.eye(6, dtype=torch.float64), rtol=0, atol=1e-6)
    view = model.eval().look(data.train_view(0)[0])
    for rank in (2, 6):
        one, other = (with_rank(field, b, rank) for b in (basis, unit))
        # The same function; float32 rounds other numbers, 1e-7 of sums around 10 behind slopes of at most 1.
        for a, b in zip(*(f.head(f.splats, view.visible, view.center) for f in (one, other)), strict=True):
            assert_close(a, b, rtol=0, atol=2e-5)


@pytest.fixture(scope="module")
def whole(tiny_scene, tmp_path_factory):
    """config.yml of an unbroken training that drops all it can."""
    return trained(words(tiny_scene, tmp_path_factory.mktemp("whole")))


def test_the_smaller_model_trains_saves_and_loads(whole, tmp_path):
    state = checkpoint_of(whole)
    found = state["pipeline"]["_model._extra_state"]["capacity"]
    assert found["step"] == 9
    assert found["head"] == {"latent_dim": 1, "num_bands": 1, "opacity_residual": False, "use_distance": False}
    assert state["pipeline"]["_model.gauss_params.latents"].shape[1] == 1
    assert not any("head.high" in name for name in state["pipeline"])
    for group in ("latents", "field"):
        # 4 steps of settling and 8 of training, or none since a split made the row; no state of what is gone.
        learnt = state["optimizers"][group]["state"]
        assert len(learnt) == (1 if group == "latents" else 4)
        assert all(of_one["step"] == 12 and (of_one["exp_avg"] != 0).any() for of_one in learnt.values())
    report = json.loads((whole.parent / "capacity.json").read_text())
    assert report["dropped"] == found["dropped"] and len(report["views_aside"]) == 2
    assert [trial["part"] for trial in report["trials"]][:4] == [
        "nothing",
        "high branch",
        "opacity residual",
        "distance",
    ]
    assert [trial["rounds"][0][0] for trial in report["trials"]] == [trial["steps"] for trial in report["trials"]]
    assert {trial["steps"] for trial in report["trials"]} == {4}, "all is dropped after the first round"
    results = evaluate(whole, tmp_path / "eval.json")
    _, pipeline, _, _ = eval_setup(whole)
    model = pipeline.model
    assert model.head.config.latent_dim == 1 and model.head.high is None
    assert model.config.appearance.latent_dim == 6, "what the user asked for stays as it was"
    weights = sum(value.numel() for value in model.head.parameters())
    assert weights == 64 * (1 + 3 + 1 + 9) + 64 + 3 * 64 + 3
    assert results["parameter_bytes"] == 4 * (model.num_points * (3 + 3 + 4 + 1 + 3 + 1) + weights)


def test_evidence_goes_on_with_a_training(tmp_path):
    """But for what was decided after the checkpoint was written, which is decided anew."""
    earlier, later = tmp_path / "earlier", tmp_path / "later"
    add_to_report(earlier, {"looks": [{"step": 6}, {"step": 14}], "step": 9, "dropped": [], "trials": [float("nan")]})
    continue_report(later, tmp_path / "nowhere", 10)
    continue_report(None, earlier, 10)
    assert read_report(later) == {}
    continue_report(later, earlier, 14)
    assert read_report(later) == {"looks": [{"step": 6}], "step": 9, "dropped": [], "trials": [None]}
    continue_report(later, earlier, 20)
    assert len(read_report(later)["looks"]) == 1, "its own"
    continue_report(tmp_path / "before", earlier, 9)
    assert read_report(tmp_path / "before") == {"looks": [{"step": 6}]}


@pytest.mark.parametrize("half", [pytest.param(8, marks=pytest.mark.slow), 13])
def test_resumed_training_is_the_unbroken_one(half, whole, tiny_scene, tmp_path, monkeypatch):
    """Cut before and after the decision. A part that begins after it does not decide again."""
    first = trained(words(tiny_scene, tmp_path / "half", steps=half))
    decisions = []
    monkeypatch.setattr("nrfgs_ns.capacity.schedule.decide", lambda *args: decisions.append(args) or decide(*args))
    rest = trained(words(tiny_scene, tmp_path / "rest", {"--load-dir": models_of(first)}, steps=18 - half))
    assert len(decisions) == (1 if half == 8 else 0)
    assert read_report(rest.parent)["step"] == read_report(whole.parent)["step"], "told, too"
    assert checkpoint_of(whole)["pipeline"]["_extra_state"]["sampling"]["views_aside"] == []
    assert_same_training(checkpoint_of(rest), checkpoint_of(whole))


def test_a_smaller_checkpoint_goes_on_with_capacity_full(whole, tiny_scene, tmp_path):
    """What was dropped stays dropped: the checkpoint says what is left."""
    rest = {"--load-dir": models_of(whole), "--pipeline.model.capacity": "full"}
    trainer = set_up(tiny_scene, tmp_path, rest, steps=2)
    assert trainer.pipeline.model.head.config.latent_dim == 1
    held = trainer.optimizers.optimizers["field"].param_groups[0]["params"]
    assert [id(one) for one in held] == [id(one) for one in trainer.pipeline.model.head.parameters()]
    trainer.train()


def test_decisions_are_made_by_views_that_nothing_has_trained_on(tiny_scene, tmp_path, monkeypatch):
    """Every photograph that a loss has been computed with, in steps and in settling; before the decision and after."""
    seen, aside = [], []
    original = NrfgsModel.photometric_loss

    def watch(self, outputs, batch):
        seen.append(int(batch["image_idx"]))
        return original(self, outputs, batch)

    def deciding(model, data, *rest):
        aside.extend(data.views_aside)
        decision = decide(model, data, *rest)
        assert not set(seen) & set(aside) and len(seen) > 10
        seen.clear()
        return decision

    monkeypatch.setattr(NrfgsModel, "photometric_loss", watch)
    monkeypatch.setattr("nrfgs_ns.capacity.schedule.decide", deciding)
    train(words(tiny_scene, tmp_path, steps=26))
    assert len(aside) == 2 and set(aside) < set(seen) == set(range(8))


@pytest.mark.slow
@pytest.mark.parametrize("densification", [ORIGINAL, MCMC], ids=["original", "mcmc"])
def test_densification_goes_on(densification, tiny_scene, tmp_path):
    config = trained(words(tiny_scene, tmp_path, densification))
    state = checkpoint_of(config)["pipeline"]
    latents = state["_model.gauss_params.latents"]
    assert latents.shape[1] == 1 and len(latents) == len(state["_model.gauss_params.means"]) != 300


@pytest.mark.slow
def test_with_diffuse_splats(tiny_scene, tmp_path):
    """Some splats are diffuse when it is decided; in the trial after it they come back, with smaller latents."""
    diffuse = {
        "--pipeline.model.diffuse.start": 6,
        "--pipeline.model.diffuse.every": 8,
        "--pipeline.model.diffuse.trial": 3,
        "--pipeline.model.diffuse.stop": 16,
        "--pipeline.model.diffuse.settle": 4,
        "--pipeline.model.diffuse.budget": 0.5,
    }
    config = trained(words(tiny_scene, tmp_path, diffuse))
    extra = checkpoint_of(config)["pipeline"]
    assert extra["_model._extra_state"]["capacity"]["head"]["latent_dim"] == 1
    assert extra["_model._extra_state"]["strategy"][DIFFUSE].any()
    assert extra["_extra_state"]["sampling"]["views_aside"] == []  # the last look was after step 14
    _, pipeline, _, _ = eval_setup(config)
    assert pipeline.model.densification.state[DIFFUSE].any()


def test_a_field_is_judged_before_splats_lose_it_after_the_same_step(tiny_scene, tmp_path, monkeypatch):
    """With the defaults both are due after step 20000, when a trial ends and all splats have their residual: a field
    that few of them still use would be found to be worth little."""
    trainer = set_up(tiny_scene, tmp_path, {"--pipeline.model.diffuse.start": 9})
    model, order = trainer.pipeline.model, []
    judged = Decision(None, [], [])
    monkeypatch.setattr("nrfgs_ns.capacity.schedule.decide", lambda *_: order.append("field") or judged)
    monkeypatch.setattr("nrfgs_ns.diffuse_splats.make_diffuse", lambda *_: order.append("splats") or [])
    monkeypatch.setattr("nrfgs_ns.diffuse_splats.DiffuseSchedule.tell", lambda *_: None)
    attributes = TrainingCallbackAttributes(trainer.optimizers, trainer.grad_scaler, trainer.pipeline, trainer)
    model.step = 9
    for callback in model.get_training_callbacks(attributes)[-3:]:
        callback.func(9)
    assert order == ["field", "splats"]


@pytest.mark.slow
def test_nothing_dropped_is_nothing_changed(tiny_scene, tmp_path, monkeypatch):
    trainer = set_up(tiny_scene, tmp_path, steps=12)
    real = decide

    def nothing(*args):
        return real(*args)._replace(chosen=None, dropped=[])

    monkeypatch.setattr("nrfgs_ns.capacity.schedule.decide", nothing)
    head, latents = trainer.pipeline.model.head, trainer.pipeline.model.gauss_params["latents"].shape[1]
    trainer.train()
    assert trainer.pipeline.model.head is head and trainer.pipeline.model.gauss_params["latents"].shape[1] == latents
    assert trainer.pipeline.model.capacity_found["dropped"] == []


def test_full_is_full(tiny_scene, tmp_path):
    trainer = set_up(tiny_scene, tmp_path, {"--pipeline.model.capacity": "full"}, steps=12)
    assert trainer.pipeline.datamanager.views_aside == []
    trainer.train()
    assert trainer.pipeline.model.capacity_found is None
    assert not (trainer.base_dir / "capacity.json").exists()


@pytest.mark.parametrize(
    "more, says",
    [
        ({f"{SEARCH}.step": -1}, "step is -1"),
        ({f"{SEARCH}.views": 0}, "views is 0"),
        ({f"{SEARCH}.views": 8}, "sets 8 training views aside, of 8"),
        ({f"{SEARCH}.settle": 0}, "settle is 0"),
        ({f"{SEARCH}.settle-most": 3}, "settle-most is 3; it must be at least .*settle, 4"),
        ({f"{SEARCH}.tolerance-db": -0.1}, "tolerance_db is -0.1"),
    ],
)
def test_what_cannot_be_done_is_refused_before_training(more, says, tiny_scene, tmp_path):
    with pytest.raises(InputError, match=says):
        set_up(tiny_scene, tmp_path, more)


def test_a_head_without_parts_is_refused(tiny_scene, tmp_path):
    line = ["nrfgs-sh", "--data", str(tiny_scene), "--output-dir", str(tmp_path), "--vis", "tensorboard"]
    with pytest.raises(InputError, match="'sh' head has no parts"):
        parse([*line, "--pipeline.model.capacity", "auto"]).setup(local_rank=0, world_size=1).setup()


def test_several_devices_are_refused(tiny_scene, tmp_path):
    trainer = set_up(tiny_scene, tmp_path)
    trainer.pipeline.world_size = 2
    attributes = TrainingCallbackAttributes(trainer.optimizers, trainer.grad_scaler, trainer.pipeline, trainer)
    with pytest.raises(InputError, match="spread over 2 devices"):
        trainer.pipeline.model.get_training_callbacks(attributes)


def test_a_training_that_has_seen_all_views_is_refused(tiny_scene, tmp_path):
    full = trained(words(tiny_scene, tmp_path / "full", {"--pipeline.model.capacity": "full"}, steps=2))
    with pytest.raises(InputError, match="has trained on all views for 2 steps"):
        set_up(tiny_scene, tmp_path / "auto", {"--load-dir": models_of(full)})


def test_an_end_before_the_decision_is_told(tiny_scene, tmp_path, capsys):
    set_up(tiny_scene, tmp_path, steps=5)
    assert "this training ends at step 4" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    "schedule, decides, told",
    [(None, 4, False), (None, 5, True), (40, 39, False), (40, 40, True)],
)
def test_a_decision_in_the_last_step_is_in_time(schedule, decides, told, tiny_scene, tmp_path, capsys):
    """The last of five steps is step 4; that of schedules of 40 steps, which are stretched to them, is step 39."""
    stretched = {} if schedule is None else {"--schedule-steps": schedule}
    set_up(tiny_scene, tmp_path, {f"{SEARCH}.step": decides, **stretched}, steps=5)
    kind = "" if schedule is None else " of the schedules"
    said = " ".join(capsys.readouterr().out.split())
    assert f"views are set aside until step {decides}{kind}, to decide" in said
    assert (f"but this training ends at step {(schedule or 5) - 1}{kind}: they are never" in said) == told


def test_what_is_left_is_drawn_and_exported(whole, tmp_path):
    """A viewer's way to a model and both formats of `nrfgs export`, from the checkpoint of a smaller field."""
    _, pipeline, _, _ = eval_setup(whole, test_mode="inference")
    model, cameras = pipeline.model, pipeline.datamanager.train_dataset.cameras
    picture = model.get_outputs_for_camera(cameras[:1])["rgb"]
    assert picture.shape[-1] == 3 and picture.std() > 0.01
    ply = tmp_path / "splats.ply"
    Export("ply", whole, ply, report=tmp_path / "ply.json").main()
    assert 0 < len(read_splats(ply).means) <= model.num_points
    Export("compact", whole, tmp_path / "field.nrf", report=tmp_path / "compact.json").main()
    for name in ("ply", "compact"):
        # Fitted harmonics and rounded numbers cost little of 20 steps' training; numbers in wrong places cost decibels.
        assert abs(json.loads((tmp_path / f"{name}.json").read_text())["loss_db"]) < 0.5, name
