# SPDX-License-Identifier: Apache-2.0
"""The lists of what each tile draws, on a GPU: gsplat's images and gradients from them. In Triton's interpreter:
tile_lists_interpreted.py."""

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
            image, pairs = drawn(*leaves, 300, 200, mode, rasterize_mode)
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


def drawn(
    means, quats, scales, colors, opacities, width, height, mode="RGB", rasterize_mode="classic"
) -> tuple[torch.Tensor, int]:
    """The image of splats before a camera, and how many pairs of splats and tiles it took."""
    from nrfgs_ns.rasterizer import ProjectionOptions, composite, project

    K = torch.tensor([[[200, 0, width / 2], [0, 200, height / 2], [0, 0, 1]]]).cuda()
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
    return image, pairs
