# SPDX-License-Identifier: Apache-2.0
"""Where an image comes from: composited colours, or a head at the pixel that turns composited features into one."""

import pytest
import torch
from torch.testing import assert_close

from nrfgs_ns.appearance.field import Field
from nrfgs_ns.appearance.head import SplatAppearance
from nrfgs_ns.appearance.sh import ShConfig
from nrfgs_ns.model.renderer import Pinhole, composite_view, project_view, projection_options, world_to_camera
from nrfgs_ns.rasterizer import composite

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
    view = project_view(table(camera.center + distances * rays.view(63, 3)), camera, projection_options("classic", 1.0))
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
    view = project_view(splats, turned_camera(), projection_options("classic", 1.0))
    appearance = Field(head, splats).seen_from(view)
    outputs, _ = composite_view(view, appearance, BACKGROUND, with_depth=with_depth)
    render, alpha, _ = composite(view.projection, *appearance, backgrounds=BACKGROUND[None], with_depth=with_depth)
    assert torch.equal(outputs["rgb"], render[0, ..., :3].clamp(0, 1)) and torch.equal(
        outputs["accumulation"], alpha[0]
    )
    assert len(view.visible) > 3 and outputs["rgb"].std() > 0.05
    if with_depth:
        assert torch.equal(outputs["depth"][alpha[0] > 0], render[0, ..., 3:][alpha[0] > 0])


def test_the_image_of_features_is_drawn_over_the_background_and_then_exposed():
    torch.manual_seed(0)
    splats, camera = table(torch.randn(6, 3)), turned_camera()
    view = project_view(splats, camera, projection_options("classic", 1.0))
    features = torch.rand(len(view.visible), 5)
    appearance = SplatAppearance(features, torch.full((len(features),), 0.6))
    seen = []

    def image_of(composited, rays):
        seen.append((composited, rays))
        return composited[..., 1:4] + 0.1 * rays

    drawn, _ = composite_view(view, appearance, BACKGROUND, image_of=image_of, look=lambda rgb: 0.5 * rgb)
    ((composited, rays),) = seen
    blended, alpha, _ = composite(view.projection, *appearance)
    assert torch.equal(composited, blended[0]) and torch.equal(rays, camera.rays())
    image = alpha[0] * (composited[..., 1:4] + 0.1 * rays) + (1 - alpha[0]) * BACKGROUND
    assert_close(drawn["rgb"], 0.5 * image)
    assert 0.1 < alpha.mean() < 0.9 and drawn["depth"].shape == (7, 9, 1)
