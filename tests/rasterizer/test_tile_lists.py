# SPDX-License-Identifier: Apache-2.0
"""The lists of what each tile draws, on a GPU: gsplat's images and gradients from them. In Triton's interpreter:
tile_lists_interpreted.py."""

import math

import pytest
import torch
from tile_list_cases import assert_lists, splats


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
class TestOnCuda:
    def test_tiles_list_what_draws_in_them(self):
        from nrfgs_ns.rasterizer.tile_lists import tile_lists

        of = splats(3000, 300, 200)
        lists = tile_lists(*(table.cuda() for table in of), 19, 13, 16)
        assert_lists(*(part.cpu() for part in lists), of, 19, 13, 16)

    @pytest.mark.parametrize("mode", ["RGB", "RGB+ED"])
    @pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
    def test_images_and_gradients_are_those_of_gsplats_lists(self, monkeypatch, mode, rasterize_mode):
        from nrfgs_ns.rasterizer import gsplat_cuda

        count = 5000
        generator = torch.Generator().manual_seed(0)

        def random(*shape: int) -> torch.Tensor:
            return torch.randn(*shape, generator=generator).cuda()

        tables = [2 * random(count, 3), random(count, 4), (0.7 * random(count, 3) - 3).exp()]
        tables[0][:, 2] += 6.0
        tables += [torch.sigmoid(random(count, 3)), torch.sigmoid(2 * random(count) - 1)]
        upstream = random(1, 200, 300, 3 if mode == "RGB" else 4)

        def render() -> tuple[list[torch.Tensor], int]:
            leaves = [table.clone().requires_grad_() for table in tables]
            image, pairs, _ = drawn(*leaves, 300, 200, mode, rasterize_mode)
            image.backward(upstream)
            return [image.detach(), *(leaf.grad for leaf in leaves)], pairs

        assert gsplat_cuda._kernels_run_on(torch.device("cuda", 0))
        mine, pairs = render()
        monkeypatch.setattr(gsplat_cuda, "MOST_TILES", 0)
        theirs, all_pairs = render()
        assert pairs <= all_pairs
        torch.testing.assert_close(mine[0], theirs[0], rtol=0, atol=2e-6)
        for got, expected in zip(mine[1:], theirs[1:], strict=True):
            assert (got - expected).norm() <= 1e-5 * expected.norm()  # atomics add in any order

    def test_long_splats_are_listed_where_they_are(self, monkeypatch):
        """A splat a pixel wide at 45 degrees meets a row of tiles, which is 15 pixels from first to last, in no more
        than 15 + 2 sqrt(2) 3.34 sqrt(1.6) = 27 pixels, so in at most 3 tiles of 16. Its box, r pixels to each side, has
        2 r / 16 in that row: the share of gsplat's pairs is at most 24 / r."""
        from nrfgs_ns.rasterizer import gsplat_cuda

        count, pixel = 200, 6.0 / 400.0  # in the world, at the splats' depth
        generator = torch.Generator().manual_seed(0)
        means = (torch.rand(count, 3, generator=generator) - 0.5) * torch.tensor([50 * pixel, 50 * pixel, 0.2])
        means[:, 2] += 6.0
        turn = torch.tensor([math.cos(math.pi / 8), 0.0, 0.0, math.sin(math.pi / 8)]).expand(count, 4)
        scales = torch.tensor([64.0, 1.0, 1.0]).mul(pixel).expand(count, 3)
        tables = [
            means,
            turn,
            scales,
            torch.rand(count, 3, generator=generator),
            torch.rand(count, generator=generator),
        ]
        tables = [table.contiguous().cuda() for table in tables]
        mine, pairs, radii = drawn(*tables, 640, 480, focal=400.0)
        monkeypatch.setattr(gsplat_cuda, "MOST_TILES", 0)
        theirs, all_pairs, _ = drawn(*tables, 640, 480, focal=400.0)
        least = radii.min().item()
        assert len(radii) == count and 140 <= least and radii.max().item() <= 480 / 2 - 25  # whole boxes are in sight
        assert pairs <= 24 / least * all_pairs
        torch.testing.assert_close(mine, theirs, rtol=0, atol=2e-6)


def drawn(
    means, quats, scales, colors, opacities, width, height, mode="RGB", rasterize_mode="classic", focal=200.0
) -> tuple[torch.Tensor, int, torch.Tensor]:
    """The image of splats before a camera, how many pairs of splats and tiles it took, and the splats' radii."""
    from nrfgs_ns.rasterizer import ProjectionOptions, composite, project

    K = torch.tensor([[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]]).cuda()
    view = torch.eye(4).cuda()[None]
    options = ProjectionOptions(rasterize_mode, assume_finite=True)
    seen = project(means, quats, scales, view, K, width, height, options)
    rows, background = seen.gaussian_ids, torch.full((1, 3), 0.3).cuda()
    image, _, info = composite(
        seen, colors[rows], opacities[rows], with_depth=mode == "RGB+ED", assume_finite=True, backgrounds=background
    )
    offsets, pairs = info["isect_offsets"], len(info["flatten_ids"])
    if offsets.shape[1] > info["tile_height"]:  # the row below the image has what there is only room for
        pairs = int(offsets[0, -1, 0])
    return image, pairs, seen.radii
