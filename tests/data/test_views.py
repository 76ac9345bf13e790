# SPDX-License-Identifier: Apache-2.0
"""Some views of many, and how many of them differ; and a scene must train alike whatever it is measured in."""

import math

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from short_trainings import command_line, set_up
from small_capture import rescale

from nrfgs_lab.scenes import SceneConfig, write_scene
from nrfgs_ns.appearance.nrf import NrfConfig
from nrfgs_ns.appearance.vdgs import VdgsConfig
from nrfgs_ns.data.views import different_views, evenly_spaced, nearest_depth, scene_unit


@pytest.mark.parametrize("total, wanted, expected", [(10, 4, [0, 2, 5, 7]), (3, 5, [0, 1, 2]), (5, 0, [])])
def test_evenly_spaced(total, wanted, expected):
    assert evenly_spaced(total, wanted) == expected


@pytest.mark.parametrize("reach", [1e-9, 1e-3, 0.3, 3.0, 1e3, 1e9])
def test_the_unit_is_the_power_of_two_next_to_the_reach_of_the_cameras(reach):
    positions = torch.randn(50, 3)
    positions -= positions.mean(0)
    positions *= reach / positions.abs().max()
    unit = scene_unit(positions + 1e6 * reach)  # wherever they are
    assert 2**-0.51 <= unit / reach <= 2**0.51 and torch.tensor(unit).log2() % 1 == 0


def test_scaled_cameras_are_left_alone():
    positions = torch.rand(50, 3) * 0.1
    positions[0, 0] = 1.0  # nerfstudio's scaling after centring on a focus: their mean is elsewhere
    assert scene_unit(positions) == 1.0
    for nothing in (positions[:0], positions[1:2] * 100, torch.ones(3, 3) * 7):
        assert scene_unit(nothing) == 1.0


def ring_of_poses(count, outwards=False):
    """Cameras on a circle that look at its centre or away from it, [count, 3, 4]."""
    angles = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
    back = torch.stack([angles.cos(), angles.sin(), 0 * angles], dim=-1)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(back)
    rotation = torch.stack([torch.linalg.cross(up, back), up, -back if outwards else back], dim=-1)
    return torch.cat([rotation, 5 * back[..., None]], dim=-1)


@pytest.mark.parametrize("scale, size", [(1.0, 100), (1.0, 400), (50.0, 100)])
def test_the_nearest_depth_is_that_of_the_camera_that_comes_nearest(scale, size):
    """In world units, whatever the size of the images; a few stray points before a camera do not count."""
    generator = torch.Generator().manual_seed(1)
    points = torch.rand(4000, 3, generator=generator) - 0.5
    points[:, :] *= 2 / points.norm(dim=1, keepdim=True)  # a sphere of radius 2
    poses = ring_of_poses(12).float()
    poses[3, :, 3] *= 4 / 5  # this one stands 2 before the sphere
    stray = 0.9 * poses[3, :, 3] + 0.01 * torch.randn(5, 3, generator=generator)
    poses[:, :, 3] *= scale
    cameras = Cameras(poses, float(size), float(size), size / 2, size / 2, size, size)
    assert nearest_depth(scale * torch.cat([points, stray]), cameras) == pytest.approx(2 * scale, rel=0.02)
    assert nearest_depth(scale * points[:10], cameras) == 0.0


def test_a_view_that_another_one_is_does_not_count_and_one_in_another_direction_does():
    ring = ring_of_poses(44)
    assert different_views(ring) == different_views(ring.float()) == 44
    assert different_views(torch.cat([ring, ring])) == 44
    beside = ring.clone()
    beside[:, :, 3] += 1e-3 * torch.randn(44, 3, generator=torch.Generator().manual_seed(0))
    assert different_views(torch.cat([ring, beside])) == 44, "posed by themselves they stand almost there"
    assert different_views(torch.cat([ring[:1].expand(100, 3, 4), ring])) == 44, "a video that stands still for a while"
    assert different_views(ring_of_poses(300).repeat(20, 1, 1)) == 300
    assert different_views(ring[:1]) == different_views(ring[:1].expand(7, 3, 4)) == 1
    far = torch.cat([ring, ring])
    far[:, :, 3] = 1e6 + 1e-3 * far[:, :, 3]
    assert different_views(far) == 44
    assert different_views(torch.cat([ring, ring_of_poses(44, outwards=True)])) == 88
    tripod = torch.cat([ring[:, :, :3], ring[:1, :, 3:].expand(44, 3, 1)], dim=-1)
    assert different_views(tripod) == different_views(torch.cat([tripod, tripod])) == 44
    beside = ring.clone()
    beside[:, :, 3] += 0.1 * ring[:, :, 0]  # a stereo rig, a seventh of the spacing wide
    assert different_views(torch.cat([ring, beside])) == 88


@pytest.mark.parametrize("config", [NrfConfig(output_init="default"), VdgsConfig()], ids=["nrf", "vdgs"])
@pytest.mark.parametrize("unit", [2.0**-10, 2.0**10])
def test_a_head_sees_the_same_in_any_unit(config, unit):
    """Floor of the distance included: the first splat sits on the camera."""
    torch.manual_seed(0)
    head = config.setup()
    head.set_step(10**6)
    splats = {"means": torch.randn(20, 3), "opacities": torch.randn(20, 1), **head.splat_params(torch.rand(20, 3))}
    center, rows = splats["means"][0].clone(), torch.arange(20)
    expected = head(splats, rows, center)
    head.scene_unit = unit
    found = head({**splats, "means": splats["means"] * unit}, rows, center * unit)
    # The power of two is exact but for log(r unit) - log(unit): two roundings of numbers up to 12, seen by a network.
    for ours, theirs in zip(found, expected, strict=True):
        assert (ours - theirs).abs().max() < 1e-5


def first_step(folder, factor, out, densification):
    """A trainer after backward of step 0 on one small scene, every length times `factor`, auto-scaling off."""
    write_scene(SceneConfig(views=8, width=32, height=24, points=150, samples=1), folder)
    rescale(folder, factor)
    plain = {"--pipeline.model.num-downscales": 0, "--pipeline.model.background-color": "black"}
    plain |= {"--pipeline.model.appearance.output-init": "default", "--pipeline.model.densification": densification}
    trainer = set_up([*command_line("nrfgs", folder, out, 1, plain), "nrfgs-data", "--auto-scale-poses", "False"])
    trainer.pipeline.model.step_cb(trainer.optimizers, 0)
    outputs, losses, _ = trainer.pipeline.get_train_loss_dict(0)
    sum(losses.values()).backward()
    return trainer, outputs["rgb"].detach(), sum(losses.values()).item()


@pytest.mark.parametrize(
    "strategy, factor", [("splatfacto", 2.0**-10), ("original", 2.0**10), ("mcmc", 2.0**-10), ("mcmc", 2.0**10)]
)
def test_a_step_without_auto_scaling_is_the_same_in_any_unit(strategy, factor, tmp_path):
    """Powers of two are exact: what differs is the rounding of log-scales and log distances, 2^-20, ten layers deep."""
    densification = "mcmc,budget=200" if strategy == "mcmc" else strategy
    base, base_rgb, base_loss = first_step(tmp_path / "one", 1.0, tmp_path / "out", densification)
    other, rgb, loss = first_step(tmp_path / "other", factor, tmp_path / "out", densification)
    assert base_rgb.std() > 0.01
    # A contribution at the cut-off of 1/255 may come or go with the rounding.
    assert ((rgb - base_rgb).abs() > 1e-4).float().mean() < 0.01
    assert loss == pytest.approx(base_loss, rel=1e-3)
    ours, theirs = other.pipeline.model.gauss_params, base.pipeline.model.gauss_params
    for name, length in (("means", factor), ("scales", 1.0), ("opacities", 1.0), ("latents", 1.0)):
        gradient, expected = ours[name].grad * length, theirs[name].grad
        assert (gradient - expected).norm() < 1e-2 * expected.norm(), name

    # What moves the means, and what decides whether splats come or go.
    for trainer in (base, other):
        for parameter in trainer.pipeline.model.gauss_params.values():
            parameter.grad.copy_(torch.ones_like(parameter.grad))  # Adam's first step is its learning rate
        trainer.optimizers.optimizer_step_all()
    for name, length in (("means", factor), ("scales", 1.0)):
        step = ours[name].detach() - theirs[name].detach() * length
        offset = 0.0 if name == "means" else torch.tensor(factor).log()
        assert (step - offset).abs().max() < 1e-5 * max(1.0, theirs[name].abs().max().item()) * length, name
    models = [trainer.pipeline.model for trainer in (base, other)]
    if strategy == "mcmc":
        for trainer, model in zip((base, other), models, strict=True):
            torch.manual_seed(3)
            model.gauss_params["opacities"].data.fill_(-12.0)  # what cannot be seen explores
            model.densification.post_backward(1, model.info, model.gauss_params, trainer.optimizers.optimizers)
        assert (ours["means"] - theirs["means"] * factor).abs().max() < 1e-5 * factor * theirs["means"].abs().max()
        penalties = [model.densification.regularisation(model.gauss_params)["mcmc_scale_reg"] for model in models]
        assert penalties[1].item() == pytest.approx(penalties[0].item(), rel=1e-4)
    else:
        scales = [model.densification.state["scene_scale"] for model in models]
        assert scales[1] == pytest.approx(factor * scales[0], rel=1e-5)
