# SPDX-License-Identifier: Apache-2.0
"""The model on the CPU: what it renders, crops, masks, and how it starts."""

import math

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.engine.callbacks import TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.models.splatfacto import SplatfactoModel
from nerfstudio.utils.rich_utils import CONSOLE
from pytorch_msssim import SSIM
from short_trainings import untrained
from torch.testing import assert_close

from nrfgs_ns.appearance.head import Field, SplatAppearance
from nrfgs_ns.appearance.sh import ShConfig
from nrfgs_ns.errors import InputError
from nrfgs_ns.model.model import NrfgsModel
from nrfgs_ns.model.pinholes import Pinholes, pinhole
from nrfgs_ns.model.warmup import warm_up
from nrfgs_ns.rasterizer import Pinhole, ProjectionOptions, composite, composite_view, project_view, world_to_camera

pytestmark = pytest.mark.usefixtures("no_cuda")


@pytest.fixture
def build(tiny_scene, tmp_path):
    off = "--pipeline.model.few-views", "off"
    return lambda method="nrfgs", *options: untrained(tiny_scene, tmp_path, method, *off, *options)


def test_the_head_sees_only_what_the_camera_sees(build, monkeypatch):
    pipeline = build()
    model = pipeline.model.eval()
    rows, forward = [], model.head.forward
    monkeypatch.setattr(model.head, "forward", lambda *args: rows.append(args[1]) or forward(*args))
    camera, _ = pipeline.datamanager.fixed_indices_eval_dataloader[0]
    model.get_outputs_for_camera(camera)
    to_camera = world_to_camera(camera.camera_to_worlds)[0]
    z = model.means.detach() @ to_camera[2, :3] + to_camera[2, 3]
    (visible,) = rows
    assert 0 < len(visible) < model.num_points
    assert (z[visible] >= 0.01).all()


def test_crop_keeps_what_is_inside(build):
    pipeline = build()
    pipeline.eval()
    model, (camera, _) = pipeline.model, pipeline.datamanager.fixed_indices_eval_dataloader[0]
    centre, size = model.means.detach().mean(dim=0), model.means.detach().std(dim=0)
    everything = OrientedBox.from_params(tuple(centre.tolist()), (0.0, 0.0, 0.0), (1e3, 1e3, 1e3))
    some = OrientedBox.from_params(tuple(centre.tolist()), (0.0, 0.0, 0.0), tuple(size.tolist()))
    nothing = OrientedBox.from_params((1e3, 1e3, 1e3), (0.0, 0.0, 0.0), (1e-3, 1e-3, 1e-3))
    whole = model.get_outputs_for_camera(camera)
    assert torch.equal(model.get_outputs_for_camera(camera, obb_box=everything)["rgb"], whole["rgb"])
    part = model.get_outputs_for_camera(camera, obb_box=some)
    assert 0 < part["accumulation"].sum() < whole["accumulation"].sum()
    # By hand: the same model with the splats outside taken away.
    inside = some.within(model.means).reshape(-1)
    for name, value in model.gauss_params.items():
        model.gauss_params[name] = torch.nn.Parameter(value[inside])
    assert_close(part["rgb"], model.get_outputs_for_camera(camera)["rgb"])
    empty = model.get_outputs_for_camera(camera, obb_box=nothing)
    assert empty["accumulation"].abs().max() == 0
    assert torch.equal(empty["rgb"], empty["background"])


def test_metrics_count_only_what_is_inside_the_mask(build):
    pipeline = build()
    model, (camera, batch) = pipeline.model.eval(), pipeline.datamanager.fixed_indices_eval_dataloader[0]
    outputs, truth = model.get_outputs_for_camera(camera), batch["image"].float() / 255
    batch = {**batch, "image": batch["image"].clone(), "mask": torch.arange(48).expand(36, 48)[..., None] >= 16}
    batch["image"][:, :16] = 255
    metrics, _ = model.get_image_metrics_and_images(outputs, batch)
    inside = (outputs["rgb"] - truth)[:, 16:]
    assert metrics["psnr"] == pytest.approx(-10 * math.log10(inside.square().mean()), abs=1e-3)
    assert metrics["l1"] == pytest.approx(inside.abs().mean().item(), abs=1e-5)
    assert model.get_metrics_dict(outputs, batch)["psnr"].item() == pytest.approx(metrics["psnr"], abs=1e-3)


def test_training_resolution_follows_the_schedule(build):
    pipeline = build()
    for step, size in ((0, (9, 12)), (3000, (18, 24)), (6000, (36, 48))):
        pipeline.model.step_cb(Optimizers({}, {}), step)
        camera, batch = pipeline.datamanager.next_train(step)
        outputs = pipeline.model(camera)
        assert tuple(outputs["rgb"].shape[:2]) == size
        assert torch.isfinite(pipeline.model.get_loss_dict(outputs, batch)["main_loss"])


def test_intrinsics_shrink_with_the_image_and_poses_are_inverted_with_y_and_z_flipped():
    camera = Cameras(torch.eye(4)[None, :3], fx=100.0, fy=90.0, cx=50.0, cy=31.0, width=101, height=63)[0:1]
    seen_from = pinhole(camera, camera.camera_to_worlds, 2)
    assert (seen_from.width, seen_from.height) == (50, 31)
    assert_close(seen_from.K[0], torch.tensor([[50.0, 0, 25], [0, 45, 15.5], [0, 0, 1]]))
    rotation = torch.linalg.qr(torch.randn(3, 3))[0]
    pose = torch.cat([rotation, torch.randn(3, 1)], dim=1)[None]
    matrix = world_to_camera(pose)[0]
    ahead = pose[0, :, 3] - 2 * rotation[:, 2]  # nerfstudio looks along -z
    assert_close(matrix @ torch.cat([ahead, torch.ones(1)]), torch.tensor([0.0, 0, 2, 1]), atol=1e-5, rtol=0)
    above = pose[0, :, 3] + rotation[:, 1]
    assert_close(matrix @ torch.cat([above, torch.ones(1)]), torch.tensor([0.0, -1, 0, 1]), atol=1e-5, rtol=0)


@pytest.mark.parametrize("batched", [True, False])
def test_a_fixed_camera_is_what_a_camera_is(batched):
    pose = torch.cat([torch.linalg.qr(torch.randn(3, 3))[0], 100 * torch.randn(3, 1)], dim=1)
    cameras = Cameras(pose[None], fx=100.5, fy=90.25, cx=50.0, cy=31.0, width=101, height=63)
    camera = cameras[0:1] if batched else cameras[0]
    expected, got = pinhole(camera, pose[None], 1), Pinholes().of_full_size(camera, torch.device("cpu"))
    assert (got.width, got.height) == (101, 63)
    for name in ("viewmat", "K", "center"):
        assert torch.equal(getattr(got, name), getattr(expected, name)) and getattr(got, name).data_ptr() % 16 == 0


@pytest.mark.gpu
def test_a_camera_on_the_gpu_is_asked_once_until_it_is_written_to():
    pinholes, gpu = Pinholes(), torch.device("cuda")
    camera = Cameras(torch.eye(4)[None, :3], fx=100.0, fy=90.0, cx=50.0, cy=31.0, width=101, height=63)[0:1].to("cuda")
    assert pinholes.of_full_size(camera, gpu) is pinholes.of_full_size(camera, gpu)
    camera.camera_to_worlds[0, 0, 3] = 7.0
    assert pinholes.of_full_size(camera, gpu).center.tolist() == [7.0, 0.0, 0.0]


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_few_or_duplicate_points_start_finite(build, count):
    """Splatfacto asks for three neighbours and takes the logarithm of their distance."""
    model = build().model
    model.seed_points = (torch.zeros(count, 3), torch.full((count, 3), 100, dtype=torch.uint8))
    assert all(len(value) == count and torch.isfinite(value).all() for value in model._initial_splats().values())


@pytest.mark.parametrize("masked", [False, True])
def test_losses_are_splatfactos(build, masked):
    """Value and gradient of the sum; nerfstudio's own code, given its own SSIM, is the twin."""
    pipeline = build("nrfgs-sh")
    pipeline.model.config.num_downscales = 0
    model = pipeline.model
    model.gauss_params["scales"].data[:50, 0] += 4.0  # a round splat has no gradient by its rotation
    model.config.use_scale_regularization = model.config.use_bilateral_grid = False  # which splatfacto reads
    camera, batch = pipeline.datamanager.next_train(0)
    if masked:
        batch["mask"] = torch.rand(*batch["image"].shape[:2], 1) > 0.3
    model.ssim = SSIM(data_range=1.0, size_average=True, channel=3)
    results = []
    for losses_of in (NrfgsModel.get_loss_dict, SplatfactoModel.get_loss_dict):
        model.zero_grad()
        torch.manual_seed(0)  # the random background
        loss = sum(losses_of(model, model(camera), batch).values())
        loss.backward()
        results.append((loss.detach(), {name: value.grad for name, value in model.gauss_params.items()}))
    (loss, gradients), (expected, expected_gradients) = results
    # SSIM divides by variances that vanish in flat places: rounding at 2^-24 is amplified by up to 1 / C2 = 1,100.
    assert_close(loss, expected, rtol=0, atol=1e-4)
    for name, gradient in gradients.items():
        error = (gradient - expected_gradients[name]).norm() / expected_gradients[name].norm()
        assert error < 1e-3, (name, error)


def residual(model, cameras) -> float:
    views = [model.project(cameras[index : index + 1]) for index in range(len(cameras))]
    losses = [model.head.neutral_loss(model.field.splats, view.visible, view.center) for view in views]
    return torch.stack(losses).mean().sqrt().item()


def test_warm_up_quiets_a_loud_field_and_moves_nothing_else(build):
    pipeline = build("nrfgs", "--pipeline.model.appearance.output-init", "default")
    model, cameras = pipeline.model, pipeline.datamanager.train_dataset.cameras
    splats = {name: value.detach().clone() for name, value in model.gauss_params.items()}
    before = residual(model, cameras)
    warm_up(model, cameras, steps=50)
    assert before > 0.01 and residual(model, cameras) < before / 3
    for name, value in model.gauss_params.items():
        assert torch.equal(value, splats[name]) and value.grad is None
    assert all(weight.grad is None for weight in model.head.parameters())
    model.warms_up = False
    with pytest.raises(InputError, match="on one device only"):
        warm_up(model, cameras, steps=1)


@pytest.mark.parametrize("method", ["nrfgs", "nrfgs-sh"])
def test_warm_up_leaves_alone_zero_outputs_and_heads_without_weights(build, method):
    pipeline = build(method)
    weights = [weight.detach().clone() for weight in pipeline.model.head.parameters()]
    with CONSOLE.capture() as log:
        warm_up(pipeline.model, pipeline.datamanager.train_dataset.cameras, steps=50)
    assert log.get() == ""
    assert all(torch.equal(a, b) for a, b in zip(weights, pipeline.model.head.parameters(), strict=True))


@pytest.mark.parametrize("option, steps", [((), 8), (("--pipeline.model.warmup-steps", "3"), 3)])
def test_training_starts_with_one_warm_up_step_per_view_or_as_many_as_asked(build, monkeypatch, option, steps):
    taken = []
    monkeypatch.setattr("nrfgs_ns.model.model.warm_up", lambda model, cameras, steps: taken.append(steps))
    pipeline = build("nrfgs", *option)
    attributes = TrainingCallbackAttributes(optimizers=None, grad_scaler=None, pipeline=pipeline, trainer=None)
    first = pipeline.get_training_callbacks(attributes)[0]
    for step in range(3):
        first.run_callback_at_location(step, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
    assert taken == [steps], "once, before step 0"


# Where an image comes from: composited colours, or a head at the pixel that turns composited features into one.
BACKGROUND = torch.tensor([0.2, 0.5, 0.9])


def turned_camera(dtype=torch.float32) -> Pinhole:
    """A camera of 9 x 7 pixels at (0.3, -0.2, 4) that looks a little past the origin, with unequal focal lengths."""
    axis = torch.tensor([[0, -0.2, 0.1], [0.2, 0, -0.05], [-0.1, 0.05, 0]], dtype=torch.float64)
    turn = torch.linalg.matrix_exp(axis).to(dtype)
    center = torch.tensor([0.3, -0.2, 4.0], dtype=dtype)
    K = torch.tensor([[[8.0, 0, 4.2], [0, 9.0, 3.1], [0, 0, 1]]], dtype=dtype)
    return Pinhole(world_to_camera(torch.cat([turn, center[:, None]], dim=1)[None]), K, 9, 7, center)


def table(means: torch.Tensor, **more: torch.Tensor) -> dict[str, torch.Tensor]:
    count = len(means)
    quats = torch.linspace(-1, 1, 4 * count, dtype=means.dtype).view(count, 4).cos()
    scales = torch.linspace(-1.5, -0.5, 3 * count, dtype=means.dtype).view(count, 3)
    return {"means": means, "quats": quats, "scales": scales, "opacities": torch.ones_like(means[:, :1]), **more}


def test_a_ray_leads_to_its_pixel():
    camera = turned_camera(torch.float64)
    rays = camera.rays()
    assert_close(rays.norm(dim=-1), torch.ones(7, 9, dtype=torch.float64))
    distances = torch.linspace(1, 3, 63, dtype=torch.float64)[:, None]
    view = project_view(table(camera.center + distances * rays.view(63, 3)), camera, ProjectionOptions())
    rows, columns = torch.meshgrid(torch.arange(7), torch.arange(9), indexing="ij")
    centers = torch.stack([columns, rows], dim=-1).view(63, 2) + 0.5
    assert len(view.visible) == 63
    assert_close(view.projection.means2d, centers.double())


@pytest.mark.parametrize("with_depth", [False, True])
def test_without_a_head_at_the_pixel_the_image_is_what_the_rasterizer_blends(with_depth):
    """To the bit."""
    torch.manual_seed(0)
    head = ShConfig(degree=1).setup()
    splats = table(torch.randn(6, 3), **head.splat_params(torch.rand(6, 3)))
    view = project_view(splats, turned_camera(), ProjectionOptions())
    appearance = Field(head, splats).seen_from(view)
    outputs, _ = composite_view(view, appearance, BACKGROUND, with_depth=with_depth)
    render, alpha, _ = composite(view.projection, *appearance, backgrounds=BACKGROUND[None], with_depth=with_depth)
    assert torch.equal(outputs["rgb"], render[0, ..., :3].clamp(0, 1))
    assert torch.equal(outputs["accumulation"], alpha[0])
    assert len(view.visible) > 3 and outputs["rgb"].std() > 0.05
    if with_depth:
        assert torch.equal(outputs["depth"][alpha[0] > 0], render[0, ..., 3:][alpha[0] > 0])


def test_the_image_of_features_is_drawn_over_the_background_and_then_exposed():
    torch.manual_seed(0)
    splats, camera = table(torch.randn(6, 3)), turned_camera()
    view = project_view(splats, camera, ProjectionOptions())
    features = torch.rand(len(view.visible), 5)
    appearance, seen = SplatAppearance(features, torch.full((len(features),), 0.6)), []

    def image_of(composited, rays):
        seen.append((composited, rays))
        return composited[..., 1:4] + 0.1 * rays

    drawn, _ = composite_view(view, appearance, BACKGROUND, image_of=image_of, look=lambda rgb: 0.5 * rgb)
    ((composited, rays),) = seen
    blended, alpha, _ = composite(view.projection, *appearance)
    assert torch.equal(composited, blended[0]) and torch.equal(rays, camera.rays())
    assert_close(drawn["rgb"], 0.5 * (alpha[0] * (composited[..., 1:4] + 0.1 * rays) + (1 - alpha[0]) * BACKGROUND))
    assert 0.1 < alpha.mean() < 0.9 and drawn["depth"].shape == (7, 9, 1)
