# SPDX-License-Identifier: Apache-2.0
"""What the study of view-dependent opacities says of a model."""

import json

import pytest
import torch
from nerfstudio.utils.eval_utils import eval_setup
from short_trainings import command_line, trained

from nrfgs_ns.studies.opacity import OpacityStudy, after_reset, as_table, flicker

pytestmark = pytest.mark.usefixtures("no_cuda")


@pytest.fixture(scope="module")
def config(tiny_scene, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.cuda, "is_available", lambda: False)
        return trained(command_line("nrfgs", tiny_scene, tmp_path_factory.mktemp("opacity"), 2))


def shows(pipeline, d_alpha: float) -> None:
    """Let the field add the same residual everywhere, from every direction: s tanh(d_alpha)."""
    head = pipeline.model.head
    for branch in (head.low, head.high):
        torch.nn.init.zeros_(branch[-1].weight)
        torch.nn.init.zeros_(branch[-1].bias)
    with torch.no_grad():
        head.low[-1].bias[3] = d_alpha


def test_a_reset_hides_what_is_stored_and_not_what_is_added(config):
    _, pipeline, _, _ = eval_setup(config)
    model = pipeline.model.eval()
    stored = model.gauss_params["opacities"].clone()
    shows(pipeline, 0.0)
    hidden = after_reset(pipeline)
    shows(pipeline, 10.0)
    added = after_reset(pipeline)
    assert torch.equal(model.gauss_params["opacities"], stored)
    # With nothing added it is what opacities of 0.01 show, and logits of almost nothing make no difference to that.
    shows(pipeline, 0.0)
    with torch.no_grad():
        model.gauss_params["opacities"].fill_(torch.tensor(0.01).logit())
    assert after_reset(pipeline) == pytest.approx(hidden, abs=1e-4)
    with torch.no_grad():
        model.gauss_params["opacities"].fill_(torch.tensor(0.01 + model.config.appearance.opacity_scale).logit())
    whole = pipeline.get_average_eval_image_metrics()["psnr"]
    assert added == pytest.approx(whole, abs=1e-3) and abs(added - hidden) > 0.1


def test_opacities_that_do_not_depend_on_the_view_do_not_flicker(config):
    _, pipeline, _, _ = eval_setup(config)
    cameras = pipeline.datamanager.train_dataset.cameras
    views = [cameras[i : i + 1] for i in range(3)]
    shows(pipeline, 0.3)
    assert flicker(pipeline.model.eval(), views)["opacity_change"] == 0.0


def test_study_of_a_benchmarks_checkpoints(config, tmp_path):
    """Records as the bench leaves them; a method without latents has no dead gradients."""
    (tmp_path / "runs").mkdir()
    test = {"psnr": 20.0, "ssim": 0.5}
    record = {
        "identity": {"scene": "tiny"},
        "measured": {"test": test, "splats": 7},
        "train": {"config_path": str(config)},
    }
    (tmp_path / "runs" / "base-own-tiny-42.json").write_text(json.dumps(record))
    OpacityStudy(records=tmp_path, work=tmp_path, views=1, cameras=2, frames=4).main()
    (row,) = json.loads((tmp_path / "opacity.json").read_text())
    assert row["run"] == "base-own-tiny-42" and row["psnr"] == 20.0 and 0 <= row["dead_share"] <= 1
    assert row["psnr_after_reset"] > 0 and (tmp_path / "opacity.md").read_text() == as_table([row])
    assert "| 7 | - |" in as_table([{**row, "dead_share": None}])
