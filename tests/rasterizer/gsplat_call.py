# SPDX-License-Identifier: Apache-2.0
"""`gsplat.rasterization` by `project` and `composite`, for comparisons with gsplat; and by our kernels alone."""

from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import pytest
import torch
from make_gsplat_fixtures import Case
from torch import Tensor
from torch.testing import assert_close

from nrfgs_ns.rasterizer import Projection, ProjectionOptions, composite, project
from nrfgs_ns.rasterizer.torch_cpu import compositing


def rasterization(
    *arguments: Any,
    packed: bool = True,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    absgrad: bool = False,
    **options: Any,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """`project`, then `composite`, of gsplat's nine arguments; options are fields of `ProjectionOptions`.

    packed False gives `info` gsplat's dense layout: radii, means2d, depths, conics and opacities with leading
    dimensions [C, N] and zeros where a splat is not visible; camera_ids and gaussian_ids are None.
    """
    means, quats, scales, opacities, colors, viewmats, Ks, width, height = arguments
    n, c = len(means), len(viewmats)
    projection = project(means, quats, scales, viewmats, Ks, width, height, ProjectionOptions(**options))
    cell = (projection.camera_ids, projection.gaussian_ids)
    if not packed:
        dense_means2d = means.new_zeros(c, n, 2).index_put(cell, projection.means2d)
        projection = replace(projection, means2d=dense_means2d[cell])
    render, alphas, info = composite(
        projection,
        colors[cell] if colors.dim() == 3 else colors[projection.gaussian_ids],
        opacities[projection.gaussian_ids],
        backgrounds=backgrounds,
        with_depth=render_mode == "RGB+ED",
        absgrad=absgrad,
    )
    if not packed:
        for name in ("radii", "depths", "conics", "opacities"):
            rows = info[name]
            info[name] = rows.new_zeros(c, n, *rows.shape[1:]).index_put(cell, rows)
        info.update(means2d=dense_means2d, camera_ids=None, gaussian_ids=None)
        if absgrad and dense_means2d.requires_grad:

            def densify(grad: Tensor) -> None:
                dense_means2d.absgrad = torch.zeros_like(grad).index_put(cell, projection.means2d.absgrad)

            dense_means2d.register_hook(densify)
    return render, alphas, info


def assert_background_shines(case: Case) -> dict[str, Any]:
    """Where light is left, the background is seen, and has a gradient; returns `info`."""
    background = torch.tensor([[0.3, 0.6, 0.9]], requires_grad=True)
    black, alphas, _ = rasterization(*case.arguments())
    render, _, info = rasterization(*case.arguments(), backgrounds=background)
    assert_close(render, black + (1 - alphas) * background[:, None, None])
    weight = torch.rand(render.shape)
    (render * weight).sum().backward()
    assert_close(background.grad, (weight * (1 - alphas)).sum((1, 2)))
    return info


class Theirs(Exception):
    """gsplat's kernels would have composited."""


def draw_with_our_kernels(monkeypatch: pytest.MonkeyPatch, device: str) -> None:
    """Composite what the CPU has projected by our kernels on a device, and never by gsplat's."""
    from nrfgs_ns.rasterizer import gsplat_cuda

    usual = compositing.composite

    def composite(projection: Projection, colors: Tensor, opacities: Tensor, backgrounds: Tensor | None, *how: bool):
        if len(opacities) == 0:
            return usual(projection, colors, opacities, backgrounds, *how)
        tables = {name: value.to(device) for name, value in vars(projection).items() if isinstance(value, Tensor)}
        moved = replace(projection, **tables)
        tables = colors.to(device), opacities.to(device), None if backgrounds is None else backgrounds.to(device)
        render, alphas, lists = gsplat_cuda.composite(moved, *tables, *how)
        if projection.means2d.requires_grad:

            def leave(_: Tensor) -> None:
                if hasattr(moved.means2d, "absgrad"):
                    projection.means2d.absgrad = moved.means2d.absgrad.cpu()

            projection.means2d.register_hook(leave)
        return render.cpu(), alphas.cpu(), lists

    monkeypatch.setattr(gsplat_cuda, "_gsplats_image", Mock(side_effect=Theirs))
    for name in ("_kernels_run_on", "_compositing_runs_on"):
        monkeypatch.setattr(gsplat_cuda, name, lambda _: True)
    monkeypatch.setattr(compositing, "composite", composite)


def for_our_kernels(case: Case) -> Case:
    """The first camera of a case, in three channels, over a background."""
    options = {name: value for name, value in case.options.items() if name in ("near_plane", "rasterize_mode")}
    options["backgrounds"] = torch.tensor([[0.2, 0.5, -0.8]])
    colors = torch.cat([case.colors[0] if case.colors.dim() == 3 else case.colors] * 3, dim=1)[:, :3]
    return replace(case, colors=colors, viewmats=case.viewmats[:1], Ks=case.Ks[:1], options=options)
