# SPDX-License-Identifier: Apache-2.0
"""A trained model as the PLY file that 3D Gaussian Splatting writes and other viewers read.

One vertex for each splat, 62 little-endian floats: x y z, nx ny nz (zeros), f_dc_0..2, f_rest_0..44, opacity (a logit),
scale_0..2 (logarithms), rot_0..3 (w x y z, of unit length). A viewer's colour is max(0, 1/2 + SH_C0 f_dc + ...), and
f_rest is channel-major: 15 coefficients of red, then of green, then of blue. `harmonics_fit.py` and `harmonics_tune.py`
turn a head's colours and opacities into a file's; `ns-export gaussian-splat` writes the same numbers, in the training's
world.
"""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from plyfile import PlyData, PlyElement
from torch import Tensor

from nrfgs_ns.appearance.head import Field
from nrfgs_ns.appearance.sh import ShConfig
from nrfgs_ns.data.views import in_view
from nrfgs_ns.errors import InputError
from nrfgs_ns.export.command import Ply
from nrfgs_ns.export.frames import NOWHERE, Y_DOWN, Similarity, to_capture
from nrfgs_ns.files import whole
from nrfgs_ns.model.harmonics_fit import PlainSplats
from nrfgs_ns.model.pinholes import pinhole
from nrfgs_ns.rasterizer import ProjectionOptions, composite_view, project_view
from nrfgs_ns.threads import draws_small, few_threads
from nrfgs_ns.trained.loading import finish, load_model, lost, measure_loss

PROPERTIES = (
    *("x", "y", "z", "nx", "ny", "nz"),
    *(f"f_dc_{i}" for i in range(3)),
    *(f"f_rest_{i}" for i in range(45)),
    "opacity",
    *(f"scale_{i}" for i in range(3)),
    *(f"rot_{i}" for i in range(4)),
)
"""The vertex properties of 3D Gaussian Splatting, in its order."""
FAINTEST_LOGIT = -5.5373
"""Splats with a smaller opacity logit are left out, as by ns-export: logit(1/255), below which nothing is drawn."""
SPARKS_EDGE = 1.4
"""Largest distance of a splat's centre from the image's middle, in halves of its size, in Spark 2.2: clipXY."""
WORTH_A_WORD = 0.1
"""Loss in dB from which the command mentions it."""


def export_ply(load_config: Path, options: Ply) -> None:
    """Write a PLY file, and report what it costs; see `nrfgs export ply --help`."""
    output = options.output
    pipeline = load_model(load_config, "test" if options.measure else "inference", options.measure)
    with few_threads(draws_small(pipeline)):
        pipeline.model.fit_on(pipeline.cameras_to_fit, options.steps)
        begin = perf_counter()
        fit = pipeline.model.fit
        seconds = perf_counter() - begin
        # Brush's mark, which splat-transform reads, too: the splats are dimmed for the blur that a renderer adds.
        comments = ["SplatRenderMode: mip"] if pipeline.model.config.rasterize_mode == "antialiased" else []
        placed = Y_DOWN if options.world == "viewers" else NOWHERE
        origin = np.zeros(3)
        if options.world == "capture":
            placed, origin = to_capture(pipeline.datamanager.train_dataparser_outputs)
            comments.append(f"origin {' '.join(f'{number:.17g}' for number in origin)}")
        report = {
            "splats": len(fit.splats.means),
            "written": write_splats(placed.moved(fit.splats), output, comments),
            "bytes": output.stat().st_size,
            "world": options.world,
            "exact": fit.exact,
            "ridge_views": fit.strength,
            "training_views": fit.views,
            "unseen_splats": fit.unseen,
            "seconds": {"fit": seconds},
        }
        if origin.any():
            report["origin"] = origin.tolist()
        if options.measure:
            report |= measure_loss(pipeline, pictures_of_file(pipeline.model, output, placed))
    finish(summary(output, report), report, options.report)


def summary(output: Path, report: dict[str, Any]) -> Iterator[str]:
    """A report in sentences."""
    fitted = f"harmonics fitted over {report['training_views']} training views"
    harmonics = "its harmonics as they are" if report["exact"] else fitted
    yield f"{output}: {report['written']:,} of {report['splats']:,} splats, {harmonics}, {report['bytes'] / 1e6:.1f} MB"
    if "origin" in report:
        yield f"Its coordinates are the capture's less {tuple(report['origin'])}, as its header says."
    if report["unseen_splats"]:
        yield f"{report['unseen_splats']:,} splats are seen by no training view and have their base colour."
    if "psnr_file" in report:
        yield f"{lost(report)} Base colours and opacities alone have {report['psnr_base']:.2f} dB."
        if report["psnr_file"] - report["psnr_on_screen"] > WORTH_A_WORD:
            yield (
                f"Viewers that leave out splats centred off the screen, as Spark does, show "
                f"{report['psnr_on_screen']:.2f} dB. In Spark raise clipXY from {SPARKS_EDGE}."
            )


def write_splats(splats: PlainSplats, path: Path, comments: Sequence[str] = ()) -> int:
    """Write the splats that are finite and not too faint; returns their number. InputError if there are none."""
    count = len(splats.means)
    rest = splats.features_rest.transpose(1, 2).reshape(count, -1)  # channel-major
    normals = splats.means.new_zeros(count, 3)
    columns = (splats.means, normals, splats.features_dc, rest, splats.opacities, splats.scales, splats.quats)
    columns = torch.cat(columns, dim=1)
    keep = torch.isfinite(columns).all(dim=1) & (splats.opacities[:, 0] >= FAINTEST_LOGIT)
    if not keep.any():
        raise InputError(f"{path} is not written: none of the {count} splats is finite and opaque enough to be drawn.")
    table = np.ascontiguousarray(columns[keep].cpu().numpy(), dtype="<f4")
    vertices = table.view([(name, "<f4") for name in PROPERTIES])[:, 0]
    with whole(path) as aside:
        PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<", comments=list(comments)).write(str(aside))
    return len(vertices)


def read_splats(path: Path) -> PlainSplats:
    """Read a file of `write_splats`."""
    vertices = PlyData.read(str(path))["vertex"]
    columns = torch.from_numpy(np.stack([vertices[name] for name in PROPERTIES]))
    means, _, features_dc, rest, opacities, scales, quats = columns.split((3, 3, 3, 45, 1, 3, 4))
    flat = means.T, quats.T, scales.T, opacities.T, features_dc.T, rest.reshape(3, 15, -1).permute(2, 1, 0)
    return PlainSplats(*(table.contiguous() for table in flat))


@torch.no_grad()
def render_splats(
    splats: PlainSplats, camera, background: Tensor, rasterize_mode: str = "classic", scene_unit: float = 1.0
) -> Tensor:
    """Render a file's splats over a background [3] with this project's rasterizer, [H, W, 3] in [0, 1]."""
    field = Field(ShConfig(degree=3).setup(), splats._asdict())
    planes = (scene_unit * plane for plane in (ProjectionOptions.near_plane, ProjectionOptions.far_plane))
    pose = camera.camera_to_worlds.reshape(1, 3, 4).to(splats.means.device)
    view = project_view(field.splats, pinhole(camera, pose, 1), ProjectionOptions(rasterize_mode, *planes))
    return composite_view(view, field.seen_from(view), background.to(splats.means.device))[0]["rgb"]


def pictures_of_file(model, path: Path, placed: Similarity) -> Callable[[Any], dict[str, Tensor]]:
    """A function from a camera to the images "file", "on_screen" (of the splats within SPARKS_EDGE) and "base" (the
    model's base colours and opacities); `placed` leads from the training's world to the file's."""
    file = placed.inverse.moved(read_splats(path))
    file = PlainSplats(*(value.to(model.device) for value in file))
    how = model.background_color, model.config.rasterize_mode, model.scene_unit

    def pictures(camera) -> dict[str, Tensor]:
        within, _ = in_view(file.means, camera, SPARKS_EDGE)
        return {
            "file": render_splats(file, camera, *how),
            "on_screen": render_splats(PlainSplats(*(value[within] for value in file)), camera, *how),
            "base": model.get_base_color(camera),
        }

    return pictures
