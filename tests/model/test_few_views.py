# SPDX-License-Identifier: Apache-2.0
"""What keeps a head from learning few views by heart: trust by their number, and shrinkage."""

import json
import shutil
from dataclasses import replace

import pytest
import torch
from short_trainings import REFINING, checkpoint_of, command_line, models_of, set_up, trained
from torch.testing import assert_close

from nrfgs_ns.appearance.nrf import NrfConfig
from nrfgs_ns.data.views import camera_spacing
from nrfgs_ns.densification import ErrorGuided, Mcmc, Splatfacto
from nrfgs_ns.model.loss import shrinkage


def ready(scene, out, steps, *options):
    return set_up(command_line("nrfgs", scene, out, steps, REFINING, *options))


@pytest.fixture
def twice(tiny_scene, tmp_path):
    """The tiny scene, which has a copy of each training photograph, too."""
    scene = shutil.copytree(tiny_scene, tmp_path / "twice")
    meta = json.loads((scene / "transforms.json").read_text())
    for frame in [frame for frame in meta["frames"] if frame["file_path"] in meta["train_filenames"]]:
        copy = frame["file_path"].replace("view", "copy")
        shutil.copy(scene / frame["file_path"], scene / copy)
        meta["frames"].append({**frame, "file_path": copy})
        meta["train_filenames"].append(copy)
    (scene / "transforms.json").write_text(json.dumps(meta))
    return scene


def test_copies_of_photographs_raise_no_trust(twice, tiny_scene, tmp_path, no_cuda, capsys):
    ours = ready(twice, tmp_path / "twice", 0)
    assert "8 different training views of 16: 10,000 steps" in capsys.readouterr().out
    model, single = ours.pipeline.model, ready(tiny_scene, tmp_path / "once", 0).pipeline.model
    assert model.num_train_data == 16 and model.num_views == single.num_views == 8
    assert (model.trust, model.head.config) == (single.trust, single.head.config)
    assert model.noise_factor == single.noise_factor
    assert_close(*(shrinkage(one, one.gauss_params)["shrink_opacities"] for one in (model, single)))


def test_a_training_goes_on_with_the_views_that_it_counted(twice, tmp_path, no_cuda):
    config = trained(command_line("nrfgs", twice, tmp_path / "new", 2, REFINING))
    pipeline = ready(twice, tmp_path / "again", 4, {"--load-dir": models_of(config)}).pipeline
    again, trust = pipeline.model, 8 / 28
    spacing = camera_spacing(pipeline.datamanager.train_dataset.cameras.camera_to_worlds[:, :3, 3])
    assert again.num_views == 8 and again.trust == trust
    by_error = ready(twice, tmp_path / "by error", 1, {"--pipeline.model.densification": "error-guided"}).pipeline.model
    assert by_error.densification.config == ErrorGuided().build(16, 8, 1.0).config
    assert again.head.config == NrfConfig(opacity_scale=trust * 0.2) and again.noise_factor == 0.5 / trust
    assert again.view_noise.sigma == again.noise_factor * spacing / 3**0.5


def test_nothing_is_drawn_before_half_the_nearest_depth(tiny_scene, tmp_path, no_cuda):
    """A checkpoint keeps the plane of its training."""
    config = trained(command_line("nrfgs", tiny_scene, tmp_path / "new", 2, REFINING))
    state = checkpoint_of(config)["pipeline"]["_model._extra_state"]
    model = ready(tiny_scene, tmp_path / "on", 4, {"--load-dir": models_of(config)}).pipeline.model
    assert model.projection_options.near_plane == model.near == state["near"] > 0.01 * model.scene_unit
    off = ready(tiny_scene, tmp_path / "off", 1, {"--pipeline.model.near-plane": "off"}).pipeline.model
    assert off.projection_options.near_plane == 0.01 * off.scene_unit


def test_residuals_are_on_the_logit_where_splats_share_their_opacity(tiny_scene, tmp_path, no_cuda, capsys):
    mcmc = {"--pipeline.model.densification": "mcmc,warmup_length=2,refine_every=4,budget=300"}
    config = trained(command_line("nrfgs", tiny_scene, tmp_path / "mcmc", 3, REFINING, mcmc))
    assert "view dependence reduced" in capsys.readouterr().out
    again = ready(tiny_scene, tmp_path / "again", 4, mcmc, {"--load-dir": models_of(config)}).pipeline.model
    assert again.head.config == NrfConfig(opacity_scale=2 * 8 / 28 * 0.2, opacity_bound="logit")
    once, twice = NrfConfig(opacity_scale=8 / 28 * 0.2), again.head.config
    for strategy, bound, expected in (
        ("error-guided", None, twice),
        ("error-guided", "logit", replace(once, opacity_bound="logit")),
        ("mcmc", "straight-through", replace(once, opacity_bound="straight-through")),
        ("splatfacto", None, once),
    ):
        options = {"--pipeline.model.densification": strategy}
        if bound is not None:
            options["--pipeline.model.appearance.opacity-bound"] = bound
        assert ready(tiny_scene, tmp_path / f"{strategy}-{bound}", 1, options).pipeline.model.head.config == expected
    alone = NrfConfig(opacity_residual=False)
    assert alone.for_copies() == alone.trusted(0.5) == alone


def test_a_checkpoint_keeps_its_head_whatever_the_number_of_views(tiny_scene, tmp_path, no_cuda):
    for kept, asked in (("auto", "off"), ("off", "auto")):
        state = ready(tiny_scene, tmp_path, 1, {"--pipeline.model.few-views": kept}).pipeline.model.state_dict()
        other = ready(tiny_scene, tmp_path, 1, {"--pipeline.model.few-views": asked}).pipeline.model
        other.load_state_dict(state)
        assert (other.head.config.opacity_scale == 0.2) == (kept == "off")
        assert_close(other.head.state_dict()["low.0.weight"], state["head.low.0.weight"])


def test_shrinkage_halves_with_every_twelve_views(tiny_scene, tmp_path, no_cuda):
    model = ready(tiny_scene, tmp_path, 1, {"--pipeline.model.shrinkage": 0.5}).pipeline.model
    model.config.densification = Splatfacto()
    assert model.num_views == 8
    table, weight = model.gauss_params, 0.005 * 0.5 ** (8 / 12)
    terms = shrinkage(model, model.gauss_params)
    assert_close(terms["shrink_opacities"], weight * torch.sigmoid(table["opacities"]).mean())
    assert_close(terms["shrink_scales"], weight * table["scales"].exp().mean() / model.scene_unit)
    model.num_views = 20
    for name, term in shrinkage(model, model.gauss_params).items():
        assert_close(term, terms[name] / 2)
    model.num_views = 148  # of which Adam would make whole steps
    assert shrinkage(model, model.gauss_params) == {}
    model.config.densification = ErrorGuided(shrinkage=0.2)  # which adds a constant
    constant = 0.002 * torch.sigmoid(table["opacities"]).mean()
    assert_close(shrinkage(model, table)["shrink_opacities"], constant, rtol=1e-3, atol=0.0)
    model.num_views = 8
    model.config.densification = Mcmc()  # which has terms of its own
    assert shrinkage(model, model.gauss_params) == {}
