# SPDX-License-Identifier: Apache-2.0
"""`nrfgs inspect`: parts left out are what their own definition says, and the command measures each."""

import json

import pytest
import torch
import tyro
from head_cases import assert_same, awake, random_field
from short_trainings import LOUD, command_line, trained
from torch.testing import assert_close

from nrfgs_lab import ablation
from nrfgs_ns.appearance.head import Field
from nrfgs_ns.appearance.nrf import NrfConfig, view_geometry
from nrfgs_ns.errors import InputError

pytestmark = pytest.mark.usefixtures("no_cuda")
SPLIT = NrfConfig(latent_dim=8, hidden_width=16)


def test_the_command(tiny_scene, tmp_path, capsys, monkeypatch):
    config = trained(command_line("nrfgs", tiny_scene, tmp_path, 4, LOUD))
    tyro.cli(ablation.Inspect, args=["--load-config", str(config), "--views", "2"]).main()
    result = json.loads((config.parent / "inspect.json").read_text())
    rows = {row["part"]: row for row in result["rows"]}
    assert {"high branch", "low branch", "opacity residual", "distance"} < set(rows)
    assert [row["part"][-1] for row in result["rows"] if row["group"] == "rank"] == list("123456")
    assert rows["latent rank 6"]["loss_db"] == pytest.approx(0.0, abs=1e-3)  # exact, but for float32
    assert rows["latent rank 1"]["bytes"] < rows["latent rank 2"]["bytes"] < rows["nothing"]["bytes"]
    assert rows["high branch"]["bytes"] < rows["nothing"]["bytes"]
    assert result["together"]["loss_db"] <= 0.05 + 1e-6 and result["together"]["bytes"] <= rows["nothing"]["bytes"]
    assert "can be left out together" in capsys.readouterr().out
    with pytest.raises(InputError, match="0 of 2 test views"):
        tyro.cli(ablation.Inspect, args=["--load-config", str(config), "--views", "0"]).main()
    with pytest.raises(InputError, match="--budget is nan"):
        tyro.cli(ablation.Inspect, args=["--load-config", str(config), "--budget", "nan"]).main()
    monkeypatch.setattr("nrfgs_ns.model.model.NrfgsModel.mask_of", lambda *_: torch.zeros(36, 48, 1, dtype=torch.bool))
    with pytest.raises(InputError, match="12 of 0 test views inside masks"):
        tyro.cli(ablation.Inspect, args=["--load-config", str(config)]).main()


def test_parts_left_out_are_what_their_definition_says():
    whole, visible, centers = random_field(SPLIT)
    small, shut = ablation.without_high_branch(whole), awake(SPLIT, torch.float32).requires_grad_(False)
    shut.load_state_dict(whole.head.state_dict())
    shut.high[2].weight[3], shut.high[2].bias[3] = 0.0, -1e4
    assert small.head.high is None
    assert_same(small, Field(shut, whole.splats), visible, centers)

    seen = whole.head(whole.splats, visible, centers)
    small = ablation.without_low_branch(whole)
    parts = small.head.components(whole.splats, visible, centers)
    assert (parts["low branch"].values == 0).all() and parts["high branch"].values.abs().max() > 1e-3
    assert (small.head(whole.splats, visible, centers).opacities == seen.opacities).all()

    found = ablation.without_opacity_residual(whole).head(whole.splats, visible, centers)
    assert (found.opacities == whole.head.base_appearance(whole.splats, visible).opacities).all()
    assert_close(found.colors, seen.colors, rtol=0, atol=2e-5)


@pytest.mark.parametrize("config", [SPLIT, NrfConfig(latent_dim=8, hidden_width=16, split_bands=False)])
def test_a_constant_distance_is_what_the_field_sees(config):
    field, visible, _ = random_field(config)
    # From cameras that are all as far away from their splats.
    torch.manual_seed(0)
    centers = field.splats["means"][visible] + 3.0 * torch.nn.functional.normalize(torch.randn(len(visible), 3), dim=-1)
    _, log_distance = view_geometry(field.splats["means"][visible], centers, 0.01)
    small = ablation.with_constant_distance(field, float(log_distance[0]))
    assert not small.head.config.use_distance
    assert_same(small, field, visible, centers)
