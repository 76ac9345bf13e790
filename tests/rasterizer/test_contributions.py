# SPDX-License-Identifier: Apache-2.0
"""Contributions of splats to an image, against the dense float64 twin."""

from dataclasses import replace

import pytest
import torch
from agreement import BOUNDS, devices, judge
from make_gsplat_fixtures import CASES, upstream

from nrfgs_ns.rasterizer import ProjectionOptions, contributions, project

PROJECTING = ("near_plane", "far_plane", "rasterize_mode")


@devices
@pytest.mark.parametrize("name", CASES)
def test_hard_cases(name, device):
    """The twin's gradient of the image by a colour; where a cut-off lies within rounding, a share is anything up to
    1."""
    case = CASES[name]()
    case = replace(case, options={name: value for name, value in case.options.items() if name in PROJECTING})
    upper, alphas = upstream(case, bounds=BOUNDS[device])  # 0 at such pixels, else +-1
    verdict = judge(case, (upper.abs(), torch.zeros_like(alphas)), bounds=BOUNDS[device])

    means, quats, scales, opacities, _, viewmats, Ks = (t.to(device) for t in case.arguments()[:-2])
    options = ProjectionOptions(**case.options)
    projection = project(means, quats, scales, viewmats, Ks, case.width, case.height, options)
    shares = contributions(projection, opacities[projection.gaussian_ids])
    assert not shares.requires_grad
    total = torch.zeros(len(viewmats), len(means), dtype=torch.float64)
    total[projection.camera_ids.cpu(), projection.gaussian_ids.cpu()] = shares.cpu().double()
    free = (upper[..., 0] == 0).sum(dim=(1, 2)).double()[:, None]
    expected, tolerance = (table["grad_colors"][..., 0] for table in (verdict.values, verdict.tolerances))
    if case.colors.dim() == 2:
        total, free = total.sum(dim=0), free.sum()
    assert ((total - expected).abs() <= tolerance + free).all()
