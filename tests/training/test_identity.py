# SPDX-License-Identifier: Apache-2.0
"""Which training goes on from whose checkpoint."""

from copy import deepcopy
from types import SimpleNamespace

import pytest
import torch

from nrfgs_ns.errors import InputError
from nrfgs_ns.method_config import nrfgs, nrfgs_sh
from nrfgs_ns.training.identity import check_options, check_scene, options_of, scene_of


def scene(names=("a.png", "b.png", "c.png"), shift: float = 0.0) -> dict:
    poses = torch.eye(4)[None, :3].repeat(len(names), 1, 1)
    poses[:, 0, 3] = torch.arange(len(names))
    poses[1, 1, 3] += shift
    return scene_of(list(names), SimpleNamespace(camera_to_worlds=poses))


def test_the_same_scene_passes_whatever_its_folder_is_called():
    check_scene(scene(), scene(shift=1e-4), "elsewhere")


@pytest.mark.parametrize(
    ("here", "message"),
    [
        (scene(("a.png", "x.png", "c.png")), r"other images \(it had b.png, .*; it did not have x.png\)"),
        (scene(("a.png", "b.png")), r"other images \(it had c.png, which are not training images here\)"),
        (scene(shift=0.1), r"other poses \(b.png elsewhere\)"),
    ],
)
def test_another_scene_is_refused(here, message):
    with pytest.raises(InputError, match=message):
        check_scene(scene(), here, "data/fox")


def changed(**options):
    config = deepcopy(nrfgs.config)
    for name, value in options.items():
        *path, last = name.split("__")
        part = config
        for step in path:
            part = part[step] if isinstance(part, dict) else getattr(part, step)
        setattr(part, last, value)
    return options_of(config)


@pytest.mark.parametrize(
    "options",
    [
        {"pipeline__model__appearance__num_bands": 2},
        {"pipeline__model__appearance__color_scale": 0.3},
        {"pipeline__model__densification": "mcmc"},
        {"pipeline__model__rasterize_mode": "antialiased"},
        {"pipeline__datamanager__dataparser__orientation_method": "none"},
        {"pipeline__datamanager__dataparser__scale_factor": 2.0},
        {"pipeline__datamanager__camera_res_scale_factor": 0.5},
    ],
)
def test_an_option_that_changes_the_meaning_is_refused(options):
    (name,) = options
    with pytest.raises(InputError, match="--" + name.replace("__", ".").replace("_", "-") + " was .* and is "):
        check_options(options_of(nrfgs.config), changed(**options))


def test_another_method_is_refused():
    with pytest.raises(InputError, match="--pipeline.model.appearance"):
        check_options(options_of(nrfgs.config), options_of(nrfgs_sh.config))


def test_options_of_learning_may_change_and_are_named():
    here = changed(optimizers__means__optimizer__lr=1e-5, max_num_iterations=600, pipeline__model__refine_every=50)
    assert sorted(check_options(options_of(nrfgs.config), here)) == [
        "--max-num-iterations 0 -> 600",
        "--optimizers.means.optimizer.lr 0.00016 -> 1e-05",
        "--pipeline.model.refine-every 100 -> 50",
    ]


def test_what_changes_no_number_is_not_compared():
    here = changed(
        pipeline__datamanager__cache_images="cpu",
        pipeline__model__appearance__implementation="torch",
        pipeline__datamanager__dataparser__data="elsewhere",
        vis="tensorboard",
        output_dir="elsewhere",
    )
    assert check_options(options_of(nrfgs.config), here) == []


def test_options_that_another_version_has_are_let_be():
    here = options_of(nrfgs.config)
    assert check_options({**here, "pipeline.model.gone": "1"}, {**here, "pipeline.model.new": "2"}) == []


def test_options_are_plain_text():
    """A checkpoint is read with weights_only."""
    assert all(type(value) is str for value in options_of(nrfgs.config).values())
