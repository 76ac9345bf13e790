# SPDX-License-Identifier: Apache-2.0
"""Noise on where the head is asked from: how long it is, and that nothing else changes."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from short_trainings import REFINING, command_line, set_up

from nrfgs_ns.appearance.head import ViewNoise
from nrfgs_ns.data.views import camera_spacing, distinct_places


def ring(count: int, radius: float = 1.0) -> torch.Tensor:
    """Cameras evenly spaced on a circle, [count, 3]."""
    angles = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
    return radius * torch.stack([angles.cos(), angles.sin(), torch.zeros_like(angles)], dim=-1)


def test_spacing_of_even_cameras_is_the_distance_of_neighbours():
    assert camera_spacing(ring(40)) == pytest.approx(2 * math.sin(math.pi / 40))
    assert camera_spacing(torch.tensor([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0]])) == 5.0
    assert camera_spacing(torch.ones(7, 3)) == 0.0


@given(st.integers(0, 1000), st.floats(1e-3, 1e3), st.integers(4, 40))
def test_moving_turning_and_scaling_do_what_they_do_to_distances(seed, scale, count):
    generator = torch.Generator().manual_seed(seed)
    cameras = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64)).Q
    moved = scale * cameras @ turn.T + 10 * torch.randn(3, generator=generator, dtype=torch.float64)
    assert camera_spacing(moved) == pytest.approx(scale * camera_spacing(cameras), rel=1e-6)


def test_duplicates_pairs_and_strays_do_not_decide():
    cameras, apart = ring(40), camera_spacing(ring(40))
    assert camera_spacing(torch.cat([cameras, cameras, cameras[:10]])) == pytest.approx(apart)
    assert len(distinct_places(torch.cat([cameras, cameras + 1e-4]))) == 40
    stereo = torch.cat([cameras, 1.03 * cameras])  # a fifth of the spacing beside each
    assert camera_spacing(stereo) == pytest.approx(apart, rel=0.1)
    burst = torch.cat([cameras, cameras[3] + 0.005 * torch.randn(30, 3, dtype=torch.float64)])
    assert camera_spacing(burst) == pytest.approx(apart, rel=0.1)
    assert camera_spacing(torch.cat([cameras, torch.tensor([[0.0, 3.0, 0.0]])])) == pytest.approx(apart, rel=0.1)


def moved_by(noise: ViewNoise, splats: dict[str, torch.Tensor], step: int):
    """The table as the head sees it in a step."""
    return noise.moved(splats, noise.generator(splats["means"].device, step))


def test_noise_has_its_length_moves_nothing_else_and_is_the_steps_and_the_seeds_alone():
    splats = {"means": torch.zeros(20_000, 3, requires_grad=True), "latents": torch.ones(20_000, 4)}
    moved = moved_by(ViewNoise(0.3, 42), splats, 7)
    assert moved["means"].square().sum(dim=-1).mean().sqrt().item() == pytest.approx(0.3, rel=0.02)
    assert moved["means"].mean(dim=0).abs().max() < 0.01
    assert moved["latents"] is splats["latents"] and not splats["means"].any()
    assert (torch.autograd.grad(moved["means"].sum(), splats["means"])[0] == 1).all()
    assert moved_by(ViewNoise(0.0, 42), splats, 7) is splats
    splats, noise = {"means": torch.zeros(500, 3)}, ViewNoise(1.0, 42)
    state = torch.get_rng_state()
    first, second = moved_by(noise, splats, 0)["means"], moved_by(noise, splats, 1)["means"]
    assert torch.equal(torch.get_rng_state(), state), "another generator moved"
    assert torch.equal(moved_by(ViewNoise(1.0, 42), splats, 1)["means"], second)
    for other in (first, moved_by(ViewNoise(1.0, 43), splats, 1)["means"]):
        assert abs(torch.corrcoef(torch.stack([other.flatten(), second.flatten()]))[0, 1]) < 0.1


def test_evaluation_sees_no_noise(tiny_scene, tmp_path, no_cuda):
    trainer = set_up(command_line("nrfgs", tiny_scene, tmp_path, 1, REFINING))
    model = trainer.pipeline.model
    camera = trainer.pipeline.datamanager.eval_dataset.cameras[:1]
    with torch.no_grad():
        model.head.low[-1].weight.normal_()  # a field that says something
    sigma = model.view_noise.sigma
    assert sigma > 0

    def pictures(training: bool) -> list[torch.Tensor]:
        """With the noise and without."""
        model.train(training)
        rendered = []
        for model.view_noise.sigma in (sigma, 0.0):
            torch.manual_seed(0)  # of the background
            rendered.append(model.get_outputs(camera)["rgb"])
        return rendered

    assert torch.equal(*pictures(training=False))
    assert not torch.equal(*pictures(training=True))
