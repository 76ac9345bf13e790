# SPDX-License-Identifier: Apache-2.0
"""The change of images without each splat, against images without it."""

import pytest
import torch
from agreement import devices
from make_gsplat_fixtures import CASES
from torch.testing import assert_close

from nrfgs_ns.rasterizer import ProjectionOptions, changes_without, composite, project


@devices
@pytest.mark.parametrize("name", ["ordinary", "several_cameras", "antialiased"])
def test_an_image_without_the_splat(name, device):
    """At one pixel and channel the estimate is exact, whatever the sign; over all it is so in the mean."""
    case = CASES[name]()
    means, quats, scales, opacities, _, viewmats, Ks = (t.to(device) for t in case.arguments()[:-2])
    options = ProjectionOptions(case.options.get("rasterize_mode", "classic"))
    projection = project(means, quats, scales, viewmats, Ks, case.width, case.height, options)
    colors = torch.rand(len(projection.gaussian_ids), 3, generator=torch.Generator().manual_seed(3)).to(device)
    opacities = (0.9 * opacities)[projection.gaussian_ids]  # below the cap of alpha
    behind = torch.tensor([0.9, 0.1, 0.4], device=device).repeat(projection.n_cameras, 1)
    generator = torch.Generator(device).manual_seed(5)
    render = composite(projection, colors, opacities, backgrounds=behind)[0]
    rows = list(range(0, len(opacities), max(1, len(opacities) // 6)))
    gone = []
    for row in rows:
        fewer = opacities.clone()
        fewer[row] = 0.0
        gone.append((composite(projection, colors, fewer, backgrounds=behind)[0] - render).square())
    gone = torch.stack(gone)
    place = tuple(int(i) for i in torch.unravel_index(gone.sum(dim=(0, -1)).argmax(), gone.shape[1:4]))
    counted = torch.zeros(*render.shape[:-1], 1, dtype=torch.bool, device=device)
    counted[place] = True
    one = changes_without(projection, colors[:, :1], opacities, counted, generator, backgrounds=behind[:, :1])
    assert_close(one[rows], gone[(slice(None), *place, 0)], rtol=1e-3, atol=1e-7)
    counted[:] = True
    many = changes_without(projection, colors, opacities, counted, generator, backgrounds=behind, passes=400)
    # 400 drawings: a standard deviation is at most sqrt(2 / 400) = 0.07. Below 1/255 the image is not linear: a small
    # part of a row.
    assert_close(many[rows], gone.sum(dim=(1, 2, 3, 4)), rtol=0.3, atol=1e-4)
    assert not many.requires_grad and (many >= 0).all()
