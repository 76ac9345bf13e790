# SPDX-License-Identifier: Apache-2.0
"""Files of version 1, which nothing writes any more, are read as they were."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from compact_1 import encode_1
from torch.testing import assert_close

from nrfgs_ns.appearance.diffuse import DIFFUSE
from nrfgs_ns.appearance.field import Field
from nrfgs_ns.appearance.head import base_colors
from nrfgs_ns.appearance.nrf import NrfConfig
from nrfgs_ns.appearance.reduce import with_diffuse
from nrfgs_ns.compact.decode import decode
from nrfgs_ns.compact.encode import LARGEST_LOGIT
from nrfgs_ns.compact.format import write_container
from nrfgs_ns.compact.precision import Precision
from nrfgs_ns.errors import InputError

pytestmark = pytest.mark.usefixtures("no_cuda")


def field(count: int = 60) -> Field:
    torch.manual_seed(3)
    config = NrfConfig(latent_dim=8, hidden_width=16, output_init="default")
    head = config.setup().requires_grad_(False)
    splats = {
        "means": torch.randn(count, 3) * torch.tensor([1.0, 5.0, 0.2]),
        "quats": torch.randn(count, 4) * 3,
        "scales": torch.randn(count, 3) - 4,
        "opacities": torch.randn(count, 1) * 4,
        "features_dc": torch.randn(count, 3),
        "latents": torch.randn(count, 8) * torch.linspace(2.0, 0.1, 8),
    }
    diffuse = torch.rand(count) < 0.4
    return with_diffuse(Field(head, splats), diffuse, splats["features_dc"], splats["opacities"])


def through_a_file(one: Field, tmp_path: Path, precision: Precision | None = None):
    header, streams = encode_1(one, precision or Precision(), {"rasterize_mode": "classic"})
    write_container(tmp_path / "f.nrf", header, streams)
    return decode(tmp_path / "f.nrf")


def matched(one: Field, found: dict) -> torch.Tensor:
    """The row of the field that each row of the file came from: the nearest mean."""
    rows = torch.cdist(found["means"].double(), one.splats["means"].double()).argmin(dim=1)
    assert len(rows.unique()) == len(rows)
    return rows


def test_every_number_comes_back_within_half_a_step(tmp_path):
    precision = Precision()
    one = field()
    decoded = through_a_file(one, tmp_path, precision)
    found, truth = decoded.splats, {name: value[matched(one, decoded.splats)] for name, value in one.splats.items()}
    diffuse = found[DIFFUSE]
    assert (diffuse == truth[DIFFUSE]).all() and 0 < diffuse.sum() < 60
    # Half a step, and float32's rounding of numbers below 16: 2^-20.
    rounding = 2.0**-20
    median = one.splats["scales"].mean(dim=1).median().exp().item()
    assert (found["means"] - truth["means"]).abs().max() <= precision.means * median / 2 + rounding
    assert (found["scales"] - truth["scales"]).abs().max() <= precision.scales / 2 + rounding
    cut = truth["opacities"].clamp(-LARGEST_LOGIT, LARGEST_LOGIT)
    assert (found["opacities"] - cut).abs().max() <= precision.opacities / 2 + rounding
    drawn = base_colors(truth["features_dc"])
    drawn[diffuse] = drawn[diffuse].clamp_min(0.0)  # as the rasterizer gets them
    assert (base_colors(found["features_dc"]) - drawn).abs().max() <= precision.colors / 2 + rounding
    spread = one.splats["latents"][~one.splats[DIFFUSE]].double().std(dim=0, correction=0).max().item()
    off = (found["latents"] - truth["latents"])[~diffuse].abs().max()
    assert off <= precision.latents * spread / 2 + rounding
    assert off > precision.latents * spread / 8, "a bound that is far from reached would be the wrong one"
    assert (found["latents"][diffuse] == 0).all()
    turned = (torch.nn.functional.normalize(truth["quats"], dim=1) * found["quats"]).sum(dim=1).abs()
    assert turned.min() > 1 - (8 * math.sqrt(0.5) / 255) ** 2  # `test_quantise.py` has the bound of each component
    for name, weight in one.head.state_dict().items():
        assert_close(decoded.weights[name], weight, rtol=2**-11, atol=2**-25)  # float16, subnormal below 2^-14
    assert decoded.config == one.head.config


@pytest.mark.parametrize(
    "change, says",
    [
        (lambda header, streams: header.update(format="jpeg"), "holds 'jpeg'"),
        (lambda header, streams: header["head"].update(name="sh"), "head named 'sh'"),
        (lambda header, streams: header["head"]["config"].update(shine=1), "unknown option 'shine'"),
        (lambda header, streams: header["head"]["config"].update(latent_dim=9), "grid of latents is not 9 numbers"),
        (lambda header, streams: header["head"]["config"].update(num_bands=0), "num_bands is 0"),
        (lambda header, streams: header["splats"].update(view=1), "view.means"),
        (lambda header, streams: header.pop("grids"), "KeyError"),
        (lambda header, streams: streams.pop("diffuse.colors"), "diffuse.colors"),
        (lambda header, streams: streams["view.quats_largest"].fill(7), "in range"),
        (lambda header, streams: header.update(quats_bits=0), "quats_bits"),
        (
            lambda header, streams: header["head"]["config"].update(latent_dim=streams["head.low.0.weight"].shape[1]),
            "head.low.0.weight",  # it has inputs beside the latents
        ),
        (lambda header, streams: header.update(quats_bits=1), "quats_bits is 1"),
        (lambda header, streams: header.update(quats_bits=17), "quats_bits is 17"),
        (lambda header, streams: header.update(quats_bits=10**9), "quats_bits"),
        (lambda header, streams: header.update(quats_bits=2.5), "quats_bits"),
        (lambda header, streams: header["grids"]["means"].update(low=[0.0]), "grid of means"),
        (
            lambda header, streams: header["grids"]["means"].update(low=[[0.0], [0.0], [0.0]]),
            "low of the grid of means",
        ),
        (lambda header, streams: header["grids"]["colors"].update(step=["a", 1, 1]), "grid of colors"),
        (lambda header, streams: header["grids"]["latents"].update(step=1.0), "grid of latents"),
        (lambda header, streams: header["splats"].update(view=-1), "-1"),
    ],
)
def test_files_that_describe_no_field_are_refused(change, says, tmp_path):
    header, streams = encode_1(field(), Precision(), {})
    change(header, streams)
    write_container(tmp_path / "f.nrf", header, streams)
    with pytest.raises(InputError, match=says):
        decode(tmp_path / "f.nrf")


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_grid_that_is_not_finite_is_refused(value, tmp_path, monkeypatch):
    """JSON as others write it may say NaN, or 1e999; `write_container` does not."""
    header, streams = encode_1(field(), Precision(), {})
    header["grids"]["scales"]["step"][1] = value
    monkeypatch.setattr("nrfgs_ns.compact.decode.read_container", lambda path: (header, streams))
    with pytest.raises(InputError, match="step of the grid of scales"):
        decode(tmp_path / "f.nrf")


def test_a_misleading_size_allocates_nothing(tmp_path):
    """Without view-dependent splats no latents are in the file; a header may not make gigabytes of zeros of them."""
    one = field()
    one.splats[DIFFUSE][:] = True
    header, streams = encode_1(one, Precision(), {})
    header["head"]["config"]["latent_dim"] = 10**9
    streams["view.latents"] = np.zeros((10**9, 0), dtype=np.uint8)
    header["grids"]["latents"] = {"low": [0.0], "step": [1.0]}
    write_container(tmp_path / "f.nrf", header, streams)
    with pytest.raises(InputError, match="head.low.0.weight"):
        decode(tmp_path / "f.nrf")
