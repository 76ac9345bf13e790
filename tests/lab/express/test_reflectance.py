# SPDX-License-Identifier: Apache-2.0
"""Readers of measured reflectance, on files made here."""

import math

import numpy as np
import pytest
import torch
from PIL import Image
from torch.testing import assert_close

from nrfgs_lab.express.reflectance import (
    NETWORK_FILE,
    NUM_WEIGHTS,
    BtfName,
    angles_to_directions,
    half_difference,
    lit_color,
    parse_btf_name,
    read_btf,
    read_networks,
)
from nrfgs_ns.errors import InputError


@pytest.mark.parametrize(
    "name",
    [
        "00042 tl015 pl120 tv030 pv060",
        "tl015_pl120_tv030_pv060",
        "tv030 pv060 tl015 pl120",
        "wool-tl15-pl120-tv30-pv60",
    ],
)
def test_names_tell_their_angles(name):
    assert parse_btf_name(name) == BtfName(light=(15, 120), view=(30, 60))


@pytest.mark.parametrize(
    "name", ["readme", "tl015 pl120 tv030", "tl015 pl120 tv030 pv060 tl030", "", "atl1 pl2 tv3 pv4"]
)
def test_other_names_are_not_taken_for_photographs(name):
    assert parse_btf_name(name) is None


def photograph(folder, light, view, value=None, size=(6, 4)):
    """A picture, width x height `size`, in UBO2003's layout."""
    place = folder / f"tv{view[0]:03d}_pv{view[1]:03d}"
    place.mkdir(parents=True, exist_ok=True)
    pixels = np.full((size[1], size[0], 3), view[0] if value is None else value, dtype=np.uint8)
    path = place / f"00001 tl{light[0]:03d} pl{light[1]:03d} tv{view[0]:03d} pv{view[1]:03d}.png"
    Image.fromarray(pixels).save(path)
    return path


@pytest.fixture
def btf(tmp_path):
    for light in ((0, 0), (30, 0)):
        for view in ((0, 0), (15, 0), (15, 60), (75, 345), (30, 90), (45, 20)):
            photograph(tmp_path / "wool", light, view, value=view[0] + light[0])
    (tmp_path / "wool" / "notes.png").write_bytes(b"not a photograph")
    return tmp_path / "wool"


def test_photographs_of_one_light(btf):
    read = read_btf(btf, (30, 0))
    assert read.views == [(0, 0), (15, 0), (15, 60), (30, 90), (45, 20), (75, 345)]
    assert read.images.shape == (6, 4, 6, 3)
    expected = torch.tensor([(theta + 30) / 255 for theta, _ in read.views])
    assert_close(read.images[:, 2, 3, 1], expected)
    assert_close(read.directions[3], torch.tensor([0.0, 0.5, math.sqrt(0.75)]), rtol=0, atol=1e-6)


def test_broken_photographs_are_named(btf, tmp_path):
    with pytest.raises(InputError, match="no image under the light 45,0. Its lights: 0,0, 30,0"):
        read_btf(btf, (45, 0))
    with pytest.raises(InputError, match="is not a folder.*give the folder"):
        read_btf(tmp_path / "nowhere", (0, 0))
    archive = tmp_path / "wool.zip"
    archive.write_bytes(b"PK")
    with pytest.raises(InputError, match="wool.zip.*unpack it"):
        read_btf(archive, (0, 0))
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no image whose name tells its angles"):
        read_btf(tmp_path / "empty", (0, 0))
    odd = photograph(btf, (0, 0), (60, 18), size=(5, 4))
    with pytest.raises(InputError, match="is 5 x 4, but .* is 6 x 4"):
        read_btf(btf, (0, 0))
    odd.write_bytes(b"\x89PNG broken")
    with pytest.raises(InputError, match="pv018.png cannot be read"):
        read_btf(btf, (0, 0))
    odd.rename(btf / "tl000 pl000 tv000 pv000.png")
    with pytest.raises(InputError, match="same angles"):
        read_btf(btf, (0, 0))


def write_networks(folder, names=("a", "b"), weights=None):
    if weights is None:
        weights = np.random.default_rng(0).normal(0, 0.3, (len(names), NUM_WEIGHTS)).astype(np.float32)
    np.savez(folder / NETWORK_FILE, names=np.array(names), weights=weights)
    return weights


def test_networks_follow_their_layout(tmp_path):
    weights = write_networks(tmp_path)[1].astype(np.float64)
    x = np.random.default_rng(1).normal(size=(10, 6))
    w1, b1 = weights[:126].reshape(6, 21), weights[126:147]
    w2, b2 = weights[147:588].reshape(21, 21), weights[588:609]
    w3, b3 = weights[609:672].reshape(21, 3), weights[672:]
    expected = np.exp(np.maximum(np.maximum(x @ w1 + b1, 0) @ w2 + b2, 0) @ w3 + b3) - 1
    networks = read_networks(tmp_path)
    assert networks.names == ["a", "b"] and len(networks) == 2
    got = networks.brdf(1, torch.from_numpy(x).float())
    # float32 sums of 21 terms of order 1, then exp: a few 1e-6 of the value + 1.
    assert_close(got.double().numpy(), np.maximum(expected, 0), rtol=2e-5, atol=2e-5)
    assert (got > 0).any() and (got == 0).any()


def test_broken_networks_are_named(tmp_path):
    with pytest.raises(InputError, match=f"{NETWORK_FILE} does not exist"):
        read_networks(tmp_path)
    (tmp_path / NETWORK_FILE).write_bytes(b"PK\x03\x04 and nothing more")
    with pytest.raises(InputError, match="cannot be read"):
        read_networks(tmp_path)
    np.savez(tmp_path / NETWORK_FILE, names=np.array(["a"]))
    with pytest.raises(InputError, match="no array .*weights"):
        read_networks(tmp_path)
    write_networks(tmp_path, ["a"], np.zeros((1, 674), np.float32))
    with pytest.raises(InputError, match=r"weights are \[1, 674\]"):
        read_networks(tmp_path)
    write_networks(tmp_path, ["a", "b"], np.full((2, NUM_WEIGHTS), np.nan, np.float32))
    with pytest.raises(InputError, match="weights of a are not all finite"):
        read_networks(tmp_path)


def rotation(axis, angle):
    c, s = math.cos(angle), math.sin(angle)
    matrices = {"y": [[c, 0, s], [0, 1, 0], [-s, 0, c]], "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]]}
    return torch.tensor(matrices[axis], dtype=torch.double)


def test_coordinates_are_the_rotations_of_their_definition():
    generator = torch.Generator().manual_seed(3)
    normal = torch.tensor([0.0, 0.0, 1.0]).double()
    for _ in range(20):
        incoming, outgoing = torch.nn.functional.normalize(
            torch.randn(2, 3, generator=generator).double().abs() + 0.05, dim=-1
        )
        half = torch.nn.functional.normalize(incoming + outgoing, dim=0)
        theta, phi = math.acos(half[2]), math.atan2(half[1], half[0])
        difference = rotation("y", -theta) @ rotation("z", -phi) @ incoming
        expected = torch.cat([torch.tensor([math.sin(theta), 0.0, math.cos(theta)], dtype=torch.double), difference])
        assert_close(half_difference(normal, incoming, outgoing), expected, rtol=0, atol=1e-10)


def test_coordinates_do_not_depend_on_the_frame_and_are_finite_at_the_mirror_direction():
    incoming, outgoing = angles_to_directions([(40, 20), (70, 200)]).double()
    normal = torch.tensor([0.0, 0.0, 1.0]).double()
    turn = rotation("z", 0.7) @ rotation("y", 1.1) @ rotation("z", -2.0)
    assert_close(
        half_difference(turn @ normal, turn @ incoming, turn @ outgoing),
        half_difference(normal, incoming, outgoing),
        rtol=0,
        atol=1e-12,
    )
    mirrored = half_difference(normal.float(), *angles_to_directions([(40, 20), (40, 200)]))
    sine, cosine = math.sin(math.radians(40)), math.cos(math.radians(40))
    assert_close(mirrored, torch.tensor([0.0, 0.0, 1.0, sine, 0.0, cosine]), rtol=0, atol=1e-3)


def test_white_paper_is_white_and_colours_stay_in_range():
    paper = torch.full((1, 3), 1 / math.pi)
    assert_close(lit_color(paper, torch.ones(1)), torch.ones(1, 3))
    # sRGB of linear 0.5, from the standard's formula.
    assert_close(lit_color(0.5 * paper, torch.ones(1)), torch.full((1, 3), 1.055 * 0.5 ** (1 / 2.4) - 0.055))
    assert (lit_color(100 * paper, torch.tensor([-0.3])) == 0).all()
    assert_close(lit_color(100 * paper, torch.ones(1)), torch.ones(1, 3))
