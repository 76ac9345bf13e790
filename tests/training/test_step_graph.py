# SPDX-License-Identifier: Apache-2.0
"""A step as one CUDA graph computes what its kernels compute one after the other. `pytest -m gpu`."""

import copy
from types import SimpleNamespace

import pytest
import torch
from nerfstudio.engine.optimizers import Optimizers
from short_trainings import command_line, set_up, trained, untrained

from nrfgs_lab.training_run import evaluate
from nrfgs_ns.densification import STRATEGIES, UNSEEN, memory, statistics
from nrfgs_ns.image import ssim
from nrfgs_ns.training import optimizers, step_graph
from nrfgs_ns.training.step_graph import MOST_SIZES, StepGraphs, _Kind


@pytest.fixture
def build(tiny_scene, tmp_path):
    """The pipeline of a training on a device, at full resolution, and its graphs."""

    def pipeline(device, method="nrfgs", *options):
        exact = ["--pipeline.model.num-downscales", 0]
        if method == "nrfgs":
            exact += ["--pipeline.model.appearance.precision", "fp32"]  # bf16 makes steps of what is rounded otherwise
        built = untrained(tiny_scene, tmp_path, method, *exact, *options, device=device)
        built.model.view_noise.sigma = 0.01
        # Splats start round, and turning a round splat changes nothing: its quaternion's gradient is rounding alone.
        built.model.gauss_params["scales"].data += 0.5 * torch.randn(built.model.num_points, 3).to(device)
        return built, StepGraphs(built.model, built.datamanager, SimpleNamespace(settle=lambda: None))

    return pipeline


def test_a_photograph_of_one_size_too_many_has_no_graph_and_it_is_said(build, monkeypatch):
    pipeline, graphs = build("cpu")
    assert graphs._obstacle({"image": torch.zeros(5, 4, 3)}) is None
    graphs._graphs = {_Kind((height, 4, 3), False, "photograph"): None for height in range(5, 5 + MOST_SIZES)}
    assert graphs._obstacle({"image": torch.zeros(5, 4, 3)}) is None
    assert "many sizes" in graphs._obstacle({"image": torch.zeros(4, 4, 3)})
    assert graphs._obstacle({"image": torch.zeros(4, 4, 3), "between": True}) is None  # a twin's picture
    pipeline.model.step = 29_000  # growth has ended
    assert graphs._obstacle({"image": torch.zeros(4, 4, 3)}) is None
    monkeypatch.setattr(memory, "share_used", lambda device: 0.6)
    assert "many sizes" in graphs._obstacle({"image": torch.zeros(4, 4, 3)})


def begin(pipeline, step: int) -> None:
    """What the trainer does before a step, with the same random numbers each time."""
    pipeline.model.step_cb(Optimizers({}, {}), step)
    torch.manual_seed(step)
    for parameter in pipeline.model.parameters():
        parameter.grad = None


def eager(pipeline, step: int, view: int, **more: torch.Tensor) -> tuple:
    """Loss, image and gradients of a step, kernel by kernel."""
    begin(pipeline, step)
    camera, batch = pipeline.datamanager.train_view(view)
    outputs = pipeline.model.get_outputs(camera)
    loss = sum(pipeline.model.get_loss_dict(outputs, batch | more).values())
    loss.backward()
    return loss.detach(), outputs["rgb"].detach(), gradients(pipeline)


def recorded(pipeline, graphs, step: int, view: int, **more: torch.Tensor) -> tuple | None:
    """The same as a graph; None if it is not taken."""
    begin(pipeline, step)
    camera, batch = pipeline.datamanager.train_view(view)
    if not graphs.prepare(camera, batch | more, step):
        return None
    outputs, losses = graphs.run(batch | more)
    loss = sum(losses.values())
    assert not loss.requires_grad
    return loss.clone(), outputs["rgb"].clone(), gradients(pipeline)


def gradients(pipeline) -> dict[str, torch.Tensor]:
    """Copies of all gradients, those on the screen among them, by name."""
    named = {name: value.grad.clone() for name, value in pipeline.model.named_parameters() if value.grad is not None}
    info = pipeline.model.info
    means2d = info["means2d"]
    if (means2d.is_leaf or means2d.retains_grad) and means2d.grad is not None:
        named["means2d"] = torch.zeros(pipeline.model.num_points, 2, device=means2d.device)
        named["means2d"][info["gaussian_ids"]] = means2d.grad
    return named


def assert_same(got, expected) -> None:
    """Atomics add in any order, and packed and dense kernels round alike but for that."""
    torch.testing.assert_close(got[0], expected[0], rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(got[1], expected[1], rtol=0, atol=1e-5)
    assert got[2].keys() == expected[2].keys()
    for name, gradient in expected[2].items():
        assert (got[2][name] - gradient).norm() <= 1e-4 * gradient.norm() + 1e-9, name


@pytest.mark.parametrize("words, step", [
    ("nrfgs --pipeline.model.camera-optimizer.mode SO3xR3", 0),
    ("nrfgs --pipeline.model.robust-loss 0.1", 500),
    ("nrfgs --pipeline.model.robust-loss 0.1", 1999),
    ("nrfgs-deferred", 0),  # its network sees pixels
    ("nrfgs-latent-spec", 0),
])  # fmt: skip
def test_what_is_not_recorded_is_said_once(build, words, step, capsys, monkeypatch):
    pipeline, graphs = build("cpu", *words.split())
    batch, pipeline.model.step = pipeline.datamanager.train_view(0)[1], step
    monkeypatch.setattr(type(pipeline.model), "device", torch.device("cuda"))
    assert not any(graphs._can_record(batch) for _ in range(2))
    assert capsys.readouterr().out.count("not recorded") == 1


def test_graphs_of_replaced_splats_are_freed_while_steps_are_not_recorded(build, monkeypatch):
    pipeline, graphs = build("cpu", "nrfgs", "--pipeline.model.robust-loss", "0.1")
    model, batch = pipeline.model, pipeline.datamanager.train_view(0)[1]
    monkeypatch.setattr(type(model), "device", torch.device("cuda"))
    graphs._drop_if_outdated()
    graphs._graphs = {_Kind((9, 9, 3), False, "photograph"): SimpleNamespace(most_pairs=lambda: 2, count=1)}
    model.step = 499
    assert graphs._can_record(batch) and graphs._graphs
    model.step = 500
    for name, value in model.gauss_params.items():
        model.gauss_params[name] = torch.nn.Parameter(value.detach().clone())
    assert not graphs._can_record(batch) and not graphs._graphs


RECORDED = [*(f"densification {name},opacity_seen={seen}" for name in STRATEGIES for seen in ("base", "peak"))]
RECORDED = [*RECORDED, "robust-loss 0.1"]
"""Options that change what a step does."""


@pytest.mark.parametrize("option", RECORDED)
def test_every_strategy_is_recorded(build, option, monkeypatch):
    name, value = option.split()
    pipeline, graphs = build("cpu", "nrfgs", f"--pipeline.model.{name}", value)
    batch = pipeline.datamanager.train_view(0)[1]
    monkeypatch.setattr(type(pipeline.model), "device", torch.device("cuda"))
    for pipeline.model.step in (0, 499, 2000, 20_000):
        assert graphs._can_record(batch)


@pytest.mark.gpu
@pytest.mark.parametrize("method", ["nrfgs", "nrfgs-sh", "nrfgs-best"])
@pytest.mark.parametrize("step", [10, 100, 20_000], ids=["head rests", "growing", "at rest"])
class TestOnCuda:
    def test_a_step_is_the_same_recorded(self, build, method, step):
        pipeline, graphs = build("cuda", method)
        assert recorded(pipeline, graphs, step, 0) is None  # the first of its kind
        for view in (0, 3, 5):
            expected = eager(pipeline, step + view, view)
            assert_same(recorded(pipeline, graphs, step + view, view), expected)
        assert not graphs._given_up

    def test_new_splats_and_too_little_room(self, build, method, step):
        pipeline, graphs = build("cuda", method)
        model = pipeline.model
        for _ in range(2):
            recorded(pipeline, graphs, step, 0)
        for name, value in model.gauss_params.items():
            model.gauss_params[name] = torch.nn.Parameter(torch.cat([value, value[:50]]).detach())
        assert recorded(pipeline, graphs, step, 1) is None
        assert_same(recorded(pipeline, graphs, step, 1), eager(pipeline, step, 1))
        (graph,) = graphs._graphs.values()
        graph.room.pairs = 1
        assert_same(recorded(pipeline, graphs, step, 2), eager(pipeline, step, 2))
        assert [graph] != list(graphs._graphs.values())
        assert not graphs._given_up


@pytest.mark.gpu
@pytest.mark.parametrize("option", RECORDED)
@pytest.mark.parametrize("step", [100, 20_000])
def test_every_strategy_sees_and_adds_the_same(build, option, step):
    """Terms of the loss, changes of opacity, and the memory of residuals."""
    name, value = option.split()
    pipeline, graphs = build("cuda", "nrfgs", f"--pipeline.model.{name}", value)
    model, remembered = pipeline.model, []
    recorded(pipeline, graphs, step, 0)
    for view in (0, 3, 5):
        for make in (eager, lambda *of: recorded(of[0], graphs, *of[1:])):
            if model.trimming is not None:
                model.trimming.histogram.fill_(1.0)
            result, info = make(pipeline, step + view, view), model.info
            change = torch.full((model.num_points,), UNSEEN, device=model.device)
            if "change" in info:
                change[info["gaussian_ids"]] = info["change"]
            histogram = None if model.trimming is None else model.trimming.histogram.clone()
            remembered.append((result, change, histogram))
        (expected, change, residuals), (got, same_change, same_residuals) = remembered[-2:]
        assert_same(got, expected)
        torch.testing.assert_close(same_change, change, rtol=1e-4, atol=1e-5)
        assert (change > UNSEEN).any() == (model.densification.opacity_seen == "peak")
        if residuals is not None:  # a rounding moves a pixel to the next bin
            assert (same_residuals.cumsum(0) - residuals.cumsum(0)).abs().max() < 0.01 * residuals.sum()
    assert not graphs._given_up


@pytest.mark.gpu
def test_graphs_of_many_sizes_share_their_memory(build, monkeypatch):
    """In any order each computes the eager step. In bfloat16 a few rounded rows would show in so small an image."""
    pipeline, graphs = build("cuda", "nrfgs", "--pipeline.model.appearance.precision", "fp32")
    sizes = [(36 - 2 * cut, 48 - 2 * cut) for cut in range(6)]
    train_view = pipeline.datamanager.train_view

    def cropped(index: int):
        camera, batch = train_view(index)
        height, width = sizes[min(index, 5)]
        camera = copy.deepcopy(camera)
        camera.height[:], camera.width[:] = height, width
        return camera, {**batch, "image": batch["image"][:height, :width].contiguous()}

    monkeypatch.setattr(pipeline.datamanager, "train_view", cropped)
    recorded(pipeline, graphs, 20_000, 0)
    for view in (0, 1, 2, 3, 4, 5, 2, 0, 5):
        expected = eager(pipeline, 20_000 + view, view)
        assert_same(recorded(pipeline, graphs, 20_000 + view, view), expected)
    assert len(graphs._graphs) == 6 > MOST_SIZES and not graphs._given_up


@pytest.mark.gpu
def test_a_photographs_exposure_is_learnt_the_same(build):
    pipeline, graphs = build("cuda", "nrfgs", "--pipeline.model.photographs", "on")
    with torch.no_grad():
        pipeline.model.photograph.shots.normal_(0.0, 0.1)
    recorded(pipeline, graphs, 100, 0)
    for view in (0, 3, 5):
        expected = eager(pipeline, 100 + view, view)
        assert "photograph.shots" in expected[2]
        assert_same(recorded(pipeline, graphs, 100 + view, view), expected)


@pytest.mark.gpu
def test_each_photograph_has_its_mask(build):
    pipeline, graphs = build("cuda", "nrfgs")
    height, width = pipeline.datamanager.train_view(0)[1]["image"].shape[:2]
    recorded(pipeline, graphs, 100, 0)
    for view in (0, 3, 5):
        mask = torch.rand(height, width, 1, generator=torch.Generator().manual_seed(view)) < 0.7
        expected = eager(pipeline, 100 + view, view, mask=mask)
        assert_same(recorded(pipeline, graphs, 100 + view, view, mask=mask), expected)
    assert (expected[0] - eager(pipeline, 105, 5)[0]).abs() > 1e-3


@pytest.mark.gpu
def test_a_graph_outlives_others(build):
    """They are recorded in turn on PyTorch's 32 streams and thrown away, and free memory is given back."""
    pipeline, graphs = build("cuda", "nrfgs", "--pipeline.model.photographs", "on")
    with torch.no_grad():
        pipeline.model.photograph.shots.normal_(0.0, 0.1)
    height, width = pipeline.datamanager.train_view(0)[1]["image"].shape[:2]
    for _ in range(2):
        recorded(pipeline, graphs, 100, 0)
    (first,) = graphs._graphs.values()
    for _ in range(40):
        recorded(pipeline, graphs, 100, 1, mask=torch.ones(height, width, 1, dtype=torch.bool))
        (other,) = (graph for graph in graphs._graphs.values() if graph is not first)
        other.room.pairs = 1
    torch.cuda.empty_cache()
    assert_same(recorded(pipeline, graphs, 103, 3), eager(pipeline, 103, 3))
    assert first in graphs._graphs.values()


@pytest.mark.gpu
def test_a_training_learns_the_same(tiny_scene, tmp_path, monkeypatch):
    """With refinements, resets and three resolutions on the way, the lowest of which is too low to be recorded."""
    psnr = []
    for taken in (True, False):
        with monkeypatch.context() as only:
            if not taken:
                only.setattr(StepGraphs, "_can_record", lambda *_: False)
            args = command_line("nrfgs", tiny_scene, tmp_path / str(taken), 600, {"--schedule-steps": 30000})
            failures = []
            only.setattr(step_graph, "warn", failures.append)
            psnr.append(evaluate(trained(args), tmp_path / "eval.json")["psnr"])
            assert not failures
    assert abs(psnr[0] - psnr[1]) < 0.7  # two trainings of one seed differ by a few tenths


@pytest.mark.gpu
def test_no_kernel_is_left_to_the_first_steps(tiny_scene, tmp_path):
    from nrfgs_ns.rasterizer import gsplat_cuda

    trials = [ssim.kernels_run_on, statistics.try_kernel, optimizers.try_kernel]
    trials += [gsplat_cuda._kernels_run_on, gsplat_cuda._compositing_runs_on]
    for one in trials:
        one.cache_clear()
    trainer = set_up(command_line("nrfgs", tiny_scene, tmp_path, 3, {"--pipeline.model.num-downscales": 0}))
    trials.append(trainer.pipeline.model.head.fused.prepared_on)
    before = [one.cache_info().misses for one in trials]
    assert before == [1] * len(trials)
    trainer.train()
    assert [one.cache_info().misses for one in trials] == before
    assert not trainer.graphs._given_up
