# SPDX-License-Identifier: Apache-2.0
"""`gsplat.rasterization` by `project` and `composite`, for comparisons with gsplat."""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from nrfgs_ns.rasterizer import ProjectionOptions, composite, project


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
