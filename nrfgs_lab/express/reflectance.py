# SPDX-License-Identifier: Apache-2.0
"""Readers for measured reflectance: photographs of a bidirectional texture function, and BRDFs as small networks.

**Photographs** (`read_btf`) in the layout of the Bonn BTF database UBO2003, which the UTIA database shares: one image
for each pair of view and light, in any tree of folders, with the four angles in whole degrees in the file name,

    tv030_pv060/00042 tl015 pl120 tv030 pv060.jpg

t is the angle from the surface's normal, p the azimuth, l the light, v the view.

**Networks** (`read_networks`) as Sztrajman et al. fitted them to measured isotropic BRDFs ("Neural BRDF Representation
and Importance Sampling", Computer Graphics Forum 2021), many in one `.npz`: `names` [M] and `weights` [M, 675], a row
being W1 [6, 21], b1, W2 [21, 21], b2, W3 [21, 3], b3, row-major. They are fits: smoother than the measurements.

In both, directions are unit vectors that leave the surface, whose normal is z.
"""

import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import torch
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from nrfgs_ns.errors import InputError

IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".ppm"}
LAYERS = ((6, 21), (21, 21), (21, 3))
"""Inputs and outputs of a network's three layers."""
NUM_WEIGHTS = sum(inputs * outputs + outputs for inputs, outputs in LAYERS)
NETWORK_FILE = "nbrdf_weights.npz"
PARALLEL = 1e-4
"""Sine of the angle between half vector and normal below which they count as parallel."""

Angles = tuple[int, int]
"""Angle from the normal and azimuth, whole degrees."""


@dataclass(frozen=True)
class BtfName:
    """The angles in the name of a photograph."""

    light: Angles
    """where the light was"""
    view: Angles
    """where the camera was"""


def parse_btf_name(name: str) -> BtfName | None:
    """The angles in the file name `name`, or None if it does not have exactly one each of tl, pl, tv and pv."""
    angles = {}
    for key in ("tl", "pl", "tv", "pv"):
        found = re.findall(rf"(?<![A-Za-z]){key}(\d+)", name)
        if len(found) != 1:
            return None
        angles[key] = int(found[0])
    return BtfName(light=(angles["tl"], angles["pl"]), view=(angles["tv"], angles["pv"]))


@dataclass
class Btf:
    """One material under one light, from V views."""

    views: list[Angles]
    """angles of the views, sorted"""
    directions: Tensor
    """unit vectors from the surface to the camera, [V, 3]"""
    images: Tensor
    """values as stored / 255, [V, H, W, 3]"""


def read_btf(folder: Path, light: Angles) -> Btf:
    """Read the photographs of one material that were taken under one light.

    Args:
        folder: holds the images, in any sub-folders.
        light: the light's angle from the normal and azimuth, degrees.

    Raises:
        InputError: no such folder, no photograph in it or none under this light, two of the same view, an image that
            cannot be read or is of another size.
    """
    folder = Path(folder)
    if not folder.is_dir():
        fix = "unpack it and give the folder" if folder.is_file() else "give the folder that holds the images"
        raise InputError(f"{folder} is not a folder. A BTF is a folder of images: {fix}.")
    found: dict[BtfName, Path] = {}
    for path in sorted(path for path in folder.rglob("*") if path.suffix.lower() in IMAGE_SUFFIXES):
        angles = parse_btf_name(path.stem)
        if angles is None:
            continue
        if angles in found:
            raise InputError(f"{path} has the same angles as {found[angles]}. Keep one material to a folder.")
        found[angles] = path
    if not found:
        raise InputError(
            f"{folder} has no image whose name tells its angles, as in 'tl015 pl120 tv030 pv060.jpg'. "
            "Give the folder of one UBO2003 material."
        )
    views = sorted(angles.view for angles in found if angles.light == light)
    if not views:
        lights = ", ".join(f"{theta},{phi}" for theta, phi in sorted({angles.light for angles in found}))
        raise InputError(f"{folder} has no image under the light {light[0]},{light[1]}. Its lights: {lights}.")
    images = list(_read_images(found[BtfName(light=light, view=view)] for view in views))
    return Btf(views, angles_to_directions(views), torch.stack(images))


def _read_images(paths: Iterable[Path]) -> Iterator[Tensor]:
    """Images [H, W, 3] in [0, 1], all of the first one's size."""
    first: tuple[Path, tuple[int, int]] | None = None
    for path in paths:
        try:
            with Image.open(path) as image:
                pixels = np.asarray(image.convert("RGB"))
        except (UnidentifiedImageError, OSError, SyntaxError) as error:
            raise InputError(f"{path} cannot be read as an image ({error}). Fetch it again.") from error
        first = first or (path, pixels.shape[:2])
        if pixels.shape[:2] != first[1]:
            height, width = pixels.shape[:2]
            raise InputError(
                f"{path} is {width} x {height}, but {first[0]} is {first[1][1]} x {first[1][0]}. "
                "All images of a material must have one size."
            )
        yield torch.from_numpy(pixels.astype(np.float32) / 255.0)


def angles_to_directions(angles: Iterable[Angles]) -> Tensor:
    """Unit vectors [V, 3] at angles (from the normal, azimuth) in degrees."""
    theta, phi = torch.tensor(list(angles), dtype=torch.double).deg2rad().unbind(-1)
    return torch.stack([theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()], dim=-1).float()


@dataclass
class BrdfNetworks:
    """M measured BRDFs, each a network of 675 weights."""

    names: list[str]
    """as in `merl/chrome`"""
    weights: Tensor
    """[M, 675]"""

    def __len__(self) -> int:
        return len(self.names)

    def brdf(self, material: int, coordinates: Tensor) -> Tensor:
        """BRDF [..., 3] of one material in 1 / sr, RGB, not negative.

        Args:
            material: index into `names`.
            coordinates: [..., 6], as from `half_difference`.
        """
        x, start = coordinates, 0
        for layer, (inputs, outputs) in enumerate(LAYERS):
            end = start + inputs * outputs
            weight = self.weights[material, start:end].view(inputs, outputs)
            x = x @ weight + self.weights[material, end : end + outputs]
            start = end + outputs
            if layer < len(LAYERS) - 1:
                x = x.relu()
        return x.exp().sub(1.0).clamp_min(0.0)


def read_networks(folder: Path) -> BrdfNetworks:
    """Read the networks in `folder` / nbrdf_weights.npz.

    Raises:
        InputError: the file is missing, broken, or not of the form in the module's docstring.
    """
    path = Path(folder) / NETWORK_FILE
    if not path.is_file():
        raise InputError(f"{path} does not exist. Give the folder that holds {NETWORK_FILE}.")
    try:
        with np.load(path, allow_pickle=False) as arrays:
            names, weights = arrays["names"], arrays["weights"]
    except KeyError as error:
        raise InputError(f"{path} has no array {error}. It must hold 'names' and 'weights'.") from error
    except (OSError, ValueError, BadZipFile) as error:
        raise InputError(f"{path} cannot be read ({error}). Fetch it again.") from error
    if weights.ndim != 2 or weights.shape != (len(names), NUM_WEIGHTS) or len(names) == 0:
        raise InputError(
            f"{path}: weights are {list(weights.shape)} for {len(names)} names, but must be [M, {NUM_WEIGHTS}] with "
            "one row for each name."
        )
    if not np.isfinite(weights).all():
        bad = str(names[~np.isfinite(weights).all(axis=1)][0])
        raise InputError(f"{path}: the weights of {bad} are not all finite. Fetch the file again.")
    return BrdfNetworks([str(name) for name in names], torch.from_numpy(weights.astype(np.float32)))


def half_difference(normals: Tensor, incoming: Tensor, outgoing: Tensor) -> Tensor:
    """Rusinkiewicz coordinates of an isotropic BRDF, as the networks take them.

    With h the unit half vector at angle t from the normal, turned about the normal until its azimuth is zero, and the
    incoming direction in the frame whose z is h: (sin t, 0, cos t, d_x, d_y, d_z).

    Args:
        normals, incoming, outgoing: unit vectors [..., 3] that broadcast against each other.

    Returns:
        [..., 6].
    """
    half = torch.nn.functional.normalize(incoming + outgoing, dim=-1)
    cos_h = (normals * half).sum(-1).clamp(-1.0, 1.0)
    sin_h = (1.0 - cos_h.square()).sqrt()
    cos_i = (normals * incoming).sum(-1)
    d_z = (incoming * half).sum(-1).clamp(-1.0, 1.0)
    # The frame's x is (h cos t - n) / sin t, its y is n x h / sin t.
    parallel = sin_h < PARALLEL
    floor = sin_h.clamp_min(PARALLEL)
    d_x = (d_z * cos_h - cos_i) / floor
    d_y = (normals * torch.linalg.cross(half, incoming.expand_as(half), dim=-1)).sum(-1) / floor
    # An isotropic BRDF with h along n is the same for every azimuth: take zero.
    d_x = torch.where(parallel, (1.0 - d_z.square()).sqrt(), d_x)
    d_y = torch.where(parallel, torch.zeros_like(d_y), d_y)
    return torch.stack(torch.broadcast_tensors(sin_h, torch.zeros_like(sin_h), cos_h, d_x, d_y, d_z), dim=-1)


def lit_color(brdf: Tensor, cos_incoming: Tensor) -> Tensor:
    """Display colour [..., 3] in [0, 1] of BRDF values [..., 3], light falling at cosine [...].

    The light is such that white paper (BRDF 1 / pi), facing it, is white: pi * brdf * cos, clipped at 1 as a photograph
    is, then the sRGB curve.
    """
    linear = (math.pi * brdf * cos_incoming.clamp_min(0.0)[..., None]).clamp(0.0, 1.0)
    return torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clamp_min(0.0031308) ** (1 / 2.4) - 0.055)
