# SPDX-License-Identifier: Apache-2.0
"""Files of version 1, which nothing writes any more, are read as they were."""

import numpy as np
import pytest
from compact_fields import VERSION_1

from nrfgs_ns.compact.decode import decode
from nrfgs_ns.compact.format import read_container, write_container
from nrfgs_ns.errors import InputError

pytestmark = pytest.mark.usefixtures("no_cuda")


@pytest.mark.parametrize(
    "change, says",
    [
        (lambda header, streams: header["head"]["config"].update(latent_dim=9), "grid of latents is not 9 numbers"),
        (lambda header, streams: header["splats"].update(view=1), "view.means"),
        (lambda header, streams: streams.pop("diffuse.colors"), "diffuse.colors"),
        (lambda header, streams: streams.update({"view.quats_largest": 7 + streams["view.quats_largest"]}), "in range"),
        (lambda header, streams: header.update(quats_bits=0), "quats_bits"),
        (lambda header, streams: header.update(quats_bits=1), "quats_bits is 1"),
        (lambda header, streams: header.update(quats_bits=17), "quats_bits is 17"),
        (lambda header, streams: header.update(quats_bits=10**9), "quats_bits"),
        (lambda header, streams: header.update(quats_bits=2.5), "quats_bits"),
    ],
)
def test_files_that_describe_no_field_are_refused(change, says, tmp_path):
    header, streams = read_container(VERSION_1)
    change(header, streams)
    write_container(tmp_path / "f.nrf", header, streams)
    with pytest.raises(InputError, match=says):
        decode(tmp_path / "f.nrf")


def test_a_misleading_size_allocates_nothing(tmp_path):
    """Without view-dependent splats no latents are in the file; a header may not make gigabytes of zeros of them."""
    header, streams = read_container(VERSION_1)
    header["splats"]["view"] = 0
    streams |= {name: value[..., :0] for name, value in streams.items() if name.startswith("view.")}
    header["head"]["config"]["latent_dim"] = 10**9
    streams["view.latents"] = np.zeros((10**9, 0), dtype=np.uint8)
    header["grids"]["latents"] = {"low": [0.0], "step": [1.0]}
    write_container(tmp_path / "f.nrf", header, streams)
    with pytest.raises(InputError, match="head.low.0.weight"):
        decode(tmp_path / "f.nrf")
