# SPDX-License-Identifier: Apache-2.0
"""The CUDA back end: gsplat's kernels, called stage by stage as its packed rasterization calls them, and ours for what
training needs most: `tile_lists.py`, `compositing_triton.py`.

The differences between gsplat 1.4.0 and 1.5.3 stay in this file. 1.5.3 has batches; bounds a splat by a rectangle of
3.33 standard deviations along each axis of the image, where 1.4.0 has a square of 3 along the longest one; names
images, not cameras; and in the packed layout takes no backgrounds of several images.

gsplat 1.6, read on its main branch in August 2026 and refused until it has been tried: packed projection has another
column before the radii; `spherical_harmonics` takes means and cameras, not directions; opacity ends at 0.99, not 0.999,
and antialiasing has a floor, so that `torch_cpu`, the page and the fixtures would differ; numbers of channels without
compiled kernels raise.
"""

from __future__ import annotations

import torch
from gsplat import fully_fused_projection, isect_offset_encode, isect_tiles, rasterize_to_pixels, spherical_harmonics
from torch import Tensor

from nrfgs_ns.host import GSPLAT, gsplat_version
from nrfgs_ns.kernels.trial import tried_once

from . import EPS2D, TILE_SIZE, Projection, ProjectionOptions

HAS_BATCHES = gsplat_version() >= (1, 5)
if (installed := ".".join(map(str, gsplat_version()))) not in GSPLAT:
    raise ImportError(f"gsplat {installed} is not known here; use {' or '.join(GSPLAT)}.")

MOST_TILES = 2**16  # tiles with a 16-bit number, as `tile_lists.py` needs


def load_kernels(device: torch.device) -> None:
    """Load all of gsplat's kernels, by calling one, and try ours."""
    spherical_harmonics(0, torch.ones(1, 3, device=device), torch.ones(1, 1, 3, device=device))
    _kernels_run_on(device)
    _compositing_runs_on(device)


def project(geometry: tuple[Tensor, ...], cameras: tuple, options: ProjectionOptions) -> Projection:
    """See `nrfgs_ns.rasterizer.project`: means, quats, scales; viewmats, Ks, width, height.

    gsplat lets NaN pass its tests for visibility: a head would turn such a row into NaN gradients of shared weights.
    Then the projection is repeated without those splats. The check costs three sums, which may overflow by themselves,
    and one wait, right after gsplat's.
    """
    if options.every_row:
        return _every_row(geometry, cameras, options)
    rows = _visible_rows(geometry, cameras, options)
    if not options.assume_finite:
        _, gaussian_ids, _, means2d, depths, conics, _, _ = rows
        if not torch.isfinite(means2d.detach().sum() + depths.detach().sum() + conics.detach().sum()):
            bad = ~torch.isfinite(torch.cat([means2d, depths[:, None], conics], dim=1)).all(dim=1)
            keep = torch.ones(len(geometry[0]), dtype=torch.bool, device=gaussian_ids.device)
            keep[gaussian_ids[bad]] = False
            kept = keep.nonzero().squeeze(1)
            geometry = tuple(table.index_select(0, kept) for table in geometry)
            camera_ids, gaussian_ids, *others = _visible_rows(geometry, cameras, options)
            rows = (camera_ids, kept.index_select(0, gaussian_ids), *others)
    *columns, extents = rows
    viewmats, _, width, height = cameras
    return Projection(*columns, width=width, height=height, n_cameras=len(viewmats), extents=extents)


def _kernel(geometry: tuple[Tensor, ...], cameras: tuple, options: ProjectionOptions, *, packed: bool) -> tuple:
    """Call gsplat. Its dense kernel (not packed) has rows for all splats, and another radius formula."""
    means, quats, scales = geometry
    planes = {"near_plane": options.near_plane, "far_plane": options.far_plane}
    antialiased = options.rasterize_mode == "antialiased"
    return fully_fused_projection(
        means, None, quats, scales, *cameras, eps2d=EPS2D, **planes, calc_compensations=antialiased, packed=packed
    )


def _every_row(geometry: tuple[Tensor, ...], cameras: tuple, options: ProjectionOptions) -> Projection:
    """One camera's rows of all splats. Invisible rows have radius 0, and meaningless numbers otherwise."""
    rows = _kernel(geometry, cameras, options, packed=False)
    radii, *columns = (None if part is None else part.squeeze(0) for part in rows)
    extents = radii if HAS_BATCHES else None
    radii = radii.amax(dim=-1) if HAS_BATCHES else _packed_radii(radii, columns[2].detach())
    row = torch.arange(len(radii), device=radii.device)
    _, _, width, height = cameras
    return Projection(torch.zeros_like(row), row, radii, *columns, width, height, n_cameras=1, extents=extents)


def _packed_radii(radii: Tensor, conics: Tensor) -> Tensor:
    """Radii of gsplat 1.4's packed kernel, whose floor under a round splat's discriminant is not its dense kernel's."""
    a, b, c = conics.unbind(dim=1)
    det = a * c - b * b
    middle = 0.5 * (a + c) / det
    largest = middle + torch.sqrt(torch.clamp_min(middle * middle - 1.0 / det, 0.1))
    return torch.where(radii > 0, torch.ceil(3.0 * torch.sqrt(largest)), 0.0).to(torch.int32)


def _visible_rows(geometry: tuple[Tensor, ...], cameras: tuple, options: ProjectionOptions) -> tuple:
    """Packed rows: camera_ids, gaussian_ids, radii, means2d, depths, conics, compensations, gsplat 1.5's extents."""
    means, _, scales = geometry
    if len(means) == 0:  # gsplat 1.5.3 divides by the number of splats, which ends the process
        ids = torch.empty(0, dtype=torch.int64, device=means.device)
        compensations = means[:, 2] if options.rasterize_mode == "antialiased" else None
        sides = ids.new_empty((0, 2), dtype=torch.int32) if HAS_BATCHES else None
        return ids, ids, ids.int(), means[:, :2], means[:, 2], scales, compensations, sides
    rows = _kernel(geometry, cameras, options, packed=True)
    if not HAS_BATCHES:
        return (*rows, None)
    camera_ids, gaussian_ids, extents, *others = rows[1:]  # one batch
    return camera_ids, gaussian_ids, extents.amax(dim=-1), *others, extents


def composite(
    projection: Projection, colors: Tensor, opacities: Tensor, backgrounds: Tensor | None, absgrad: bool
) -> tuple[Tensor, Tensor, dict]:
    """Render [C, H, W, D] over backgrounds [C, D], alphas [C, H, W, 1], and gsplat's tile lists for `info`."""
    listed = _kernels_take(projection, opacities)
    ours = listed and torch.is_grad_enabled() and colors.shape[1] == 3 and _compositing_runs_on(colors.device)
    side = TILE_SIZE // 2 if ours else TILE_SIZE
    tables = projection.means2d, projection.conics, colors, opacities
    shape = projection.width, projection.height, side
    lists = _lists(projection, opacities, side, by_gsplat=not listed)
    render, alphas = (_our_image if ours else _gsplats_image)(tables, backgrounds, shape, lists, absgrad)
    return render, alphas, {"isect_offsets": lists[0], "flatten_ids": lists[1], "tile_size": side}


def _gsplats_image(
    tables: tuple[Tensor, ...], backgrounds: Tensor | None, shape: tuple, lists: tuple[Tensor, Tensor], absgrad: bool
) -> tuple[Tensor, Tensor]:
    """Render and alphas by gsplat's kernels."""
    behind = backgrounds
    if HAS_BATCHES and behind is not None:  # its check knows one image only, and sends that one no gradient
        behind = behind[0] if len(behind) == 1 and not behind.requires_grad else None
    render, alphas = rasterize_to_pixels(*tables, *shape, *lists, backgrounds=behind, packed=True, absgrad=absgrad)
    if backgrounds is not None and behind is None:
        render = render + (1.0 - alphas) * backgrounds[:, None, None]
    return render, alphas


def _our_image(
    tables: tuple[Tensor, ...], backgrounds: Tensor | None, shape: tuple, lists: tuple[Tensor, Tensor], absgrad: bool
) -> tuple[Tensor, Tensor]:
    """The same of one image of three channels by the kernels of `compositing_triton.py`."""
    from .compositing_triton import CompositeSplats

    means2d, conics, colors, opacities = (table.contiguous() for table in tables)
    background = colors.new_zeros(1, 3) if backgrounds is None else backgrounds.to(colors.dtype).contiguous()
    return CompositeSplats.apply(means2d, conics, opacities, colors, background, *lists, shape[:2], absgrad)


def _lists(projection: Projection, opacities: Tensor, side: int, by_gsplat: bool) -> tuple[Tensor, Tensor]:
    """Offsets into a list of rows, and the list: the splats that each tile draws, as the compositing kernels take them.

    Args:
        side: of a tile, in pixels; for our compositing half of gsplat's.
        by_gsplat: gsplat makes the lists, not the kernels of `tile_lists.py`.
    """
    tile_width, tile_height = -(-projection.width // side), -(-projection.height // side)
    bounds = projection.radii
    if HAS_BATCHES:
        extents = projection.extents  # a square where another device has projected them
        bounds = projection.radii[:, None].expand(-1, 2) if extents is None else extents
    means2d, depths, conics = projection.means2d, projection.depths, projection.conics
    if not by_gsplat:
        from .tile_lists import tile_lists

        tables = (table.detach().contiguous() for table in (means2d, bounds, depths, conics, opacities))
        return tile_lists(*tables, tile_width, tile_height, split=side < TILE_SIZE)
    number, ids = ("n_images", "image_ids") if HAS_BATCHES else ("n_cameras", "camera_ids")
    rows = {number: projection.n_cameras, ids: projection.camera_ids, "gaussian_ids": projection.gaussian_ids}
    tiles = side, tile_width, tile_height
    _, isect_ids, flatten_ids = isect_tiles(means2d, bounds, depths, *tiles, packed=True, **rows)
    return isect_offset_encode(isect_ids, projection.n_cameras, tile_width, tile_height), flatten_ids


def _kernels_take(projection: Projection, opacities: Tensor) -> bool:
    """Whether the kernels of `tile_lists.py` make the lists, of at least one splat."""
    tiles = -(-projection.width // TILE_SIZE) * (-(-projection.height // TILE_SIZE) + 1)  # with the row below the image
    is_one_image = projection.n_cameras == 1 and tiles <= MOST_TILES
    return is_one_image and len(opacities) > 0 and _kernels_run_on(opacities.device)


@tried_once("The list of each tile's splats")
def _kernels_run_on(device: torch.device) -> bool:
    """Whether the kernels of `tile_lists.py` run on a device."""
    _lists_of_one(device)
    return True


@tried_once("Compositing of training images, which needs Triton 3.4 or newer,")
def _compositing_runs_on(device: torch.device) -> bool:
    """Whether the kernels of `compositing_triton.py`, and that which splits lists, run on a device."""
    from .compositing_triton import CompositeSplats

    lists = _lists_of_one(device, split=True)
    leaf = torch.ones(1, 3, device=device, requires_grad=True)
    for absgrad in (False, True):
        tables = leaf[:, :2].contiguous(), leaf * 1, leaf[:, 0].contiguous(), leaf * 1, torch.zeros_like(leaf)
        CompositeSplats.apply(*tables, *lists, (1, 1), absgrad)[0].sum().backward()
    return True


def _lists_of_one(device: torch.device, split: bool = False) -> tuple[Tensor, Tensor]:
    """The list of an image's only tile, of one splat."""
    from .tile_lists import tile_lists

    ones = torch.ones(1, 3, device=device)
    radii = torch.ones(1, 2, dtype=torch.int32, device=device) if HAS_BATCHES else ones[0, :1].int()
    return tile_lists(ones[:, :2].contiguous(), radii, ones[0, :1], ones, ones[0, :1], 1, 1, split=split)
