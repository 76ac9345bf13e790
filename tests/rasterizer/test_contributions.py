# SPDX-License-Identifier: Apache-2.0
"""What splats contribute to an image, against the dense float64 twin."""

from dataclasses import replace

import pytest
import torch
from agreement import FLOAT32, judge
from gsplat_call import rasterization
from hypothesis import given, settings
from make_gsplat_fixtures import CASES, Case, upstream
from test_against_twin import scenes

from nrfgs_ns.host import gsplat_version
from nrfgs_ns.rasterizer import Projection, ProjectionOptions, contributions, project

PROJECTING = ("near_plane", "far_plane", "rasterize_mode")


def of_case(case: Case, device: str = "cpu") -> tuple[Projection, torch.Tensor]:
    """Its projection, and what each row contributes; both without gradients."""
    means, quats, scales, opacities, _, viewmats, Ks = (t.to(device) for t in case.arguments()[:-2])
    options = {name: value for name, value in case.options.items() if name in PROJECTING}
    projection = project(means, quats, scales, viewmats, Ks, case.width, case.height, ProjectionOptions(**options))
    return projection, contributions(projection, opacities[projection.gaussian_ids])


def check(case: Case, device: str = "cpu", bounds: str = "square") -> None:
    """The twin's gradient of the picture by a colour; where a cut-off lies within rounding a share is anything up to
    1."""
    case = replace(case, options={name: value for name, value in case.options.items() if name in PROJECTING})
    upper, alphas = upstream(case, bounds=bounds)  # 0 at such pixels, else +-1
    verdict = judge(case, (upper.abs(), torch.zeros_like(alphas)), FLOAT32, bounds=bounds)
    projection, shares = of_case(case, device)
    rows, cameras, shares = projection.gaussian_ids.cpu(), projection.camera_ids.cpu(), shares.cpu().double()
    assert not shares.requires_grad
    total = torch.zeros(len(case.viewmats), len(case.means), dtype=torch.float64)
    total[cameras, rows] = shares
    free = (upper[..., 0] == 0).sum(dim=(1, 2)).double()[:, None]
    expected, tolerance = (found["grad_colors"][..., 0] for found in (verdict.values, verdict.tolerances))
    if case.colors.dim() == 2:
        total, free = total.sum(dim=0), free.sum()
    excess = (total - expected).abs() - tolerance - free
    assert excess.numel() == 0 or excess.max() <= 0


@pytest.mark.parametrize("name", CASES)
def test_hard_cases(name):
    check(CASES[name]())


@settings(max_examples=15, derandomize=True)
@given(scenes())
def test_random_scenes(case):
    check(case)


@pytest.mark.gpu
@pytest.mark.parametrize("name", CASES)
def test_hard_cases_on_the_gpu(name):
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    check(CASES[name](), "cuda", "rectangle" if gsplat_version() >= (1, 5) else "square")


def test_all_shares_together_are_what_the_picture_is_opaque_by():
    """Over all splats and pixels, the sums of shares and of the picture's alpha are one number."""
    case = CASES["several_cameras"]()
    projection, shares = of_case(case)
    _, alphas, _ = rasterization(*case.arguments())
    assert shares.shape == (len(projection.gaussian_ids),)
    assert shares.sum().item() == pytest.approx(alphas.sum().item(), rel=1e-5)
