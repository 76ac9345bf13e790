# SPDX-License-Identifier: Apache-2.0
"""The lists of what each tile draws, on a GPU: gsplat's images and gradients from them. In Triton's interpreter:
tile_lists_interpreted.py."""

import pytest
import torch
from tile_list_cases import assert_lists, splats

from nrfgs_ns.rasterizer import ProjectionOptions, composite, project


@pytest.mark.gpu
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

        camera = torch.eye(4).cuda()[None], torch.tensor([[[200.0, 0, 150], [0, 200, 100], [0, 0, 1]]]).cuda(), 300, 200

        def render() -> tuple[list[torch.Tensor], int]:
            """Image and gradients, and the number of pairs of splats and tiles."""
            leaves = [table.clone().requires_grad_() for table in tables]
            *geometry, colors, opacities = leaves
            seen = project(*geometry, *camera, ProjectionOptions(rasterize_mode, assume_finite=True))
            rows, options = seen.gaussian_ids, {"with_depth": mode == "RGB+ED", "assume_finite": True}
            background = torch.full((1, 3), 0.3).cuda()
            image, _, info = composite(seen, colors[rows], opacities[rows], backgrounds=background, **options)
            image.backward(upstream)
            offsets, pairs = info["isect_offsets"], len(info["flatten_ids"])
            if offsets.shape[1] > info["tile_height"]:  # the row below the image has spare room
                pairs = int(offsets[0, -1, 0])
            return [image.detach(), *(leaf.grad for leaf in leaves)], pairs

        assert gsplat_cuda._kernels_run_on(torch.device("cuda", 0))
        mine, pairs = render()
        monkeypatch.setattr(gsplat_cuda, "MOST_TILES", 0)
        theirs, all_pairs = render()
        assert pairs <= all_pairs
        torch.testing.assert_close(mine[0], theirs[0], rtol=0, atol=2e-6)
        for got, expected in zip(mine[1:], theirs[1:], strict=True):
            assert (got - expected).norm() <= 1e-5 * expected.norm()  # atomics add in any order
