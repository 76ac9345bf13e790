# SPDX-License-Identifier: Apache-2.0
"""What a field can do without: residuals' sizes are bounds, the smallest field is found."""

import pytest
import torch
from short_trainings import LOUD
from torch.testing import assert_close

from nrfgs_lab import residuals
from nrfgs_lab.residuals import EIGHT_BIT_STEP, FieldViews, dropped, look_over, slim
from nrfgs_ns.appearance.field import Field
from nrfgs_ns.appearance.head import base_colors
from nrfgs_ns.appearance.reduce import latent_basis, with_rank
from nrfgs_ns.model.harmonics_fit import observe
from nrfgs_ns.training.trainer_config import parse

pytestmark = pytest.mark.usefixtures("no_cuda")


@pytest.fixture(scope="module")
def loud(tiny_scene, tmp_path_factory):
    """A pipeline whose field says something, untrained, and its splats."""
    torch.manual_seed(0)
    words = [str(word) for option in LOUD.items() for word in option]
    config = parse(["nrfgs", "--data", str(tiny_scene), "--output-dir", str(tmp_path_factory.mktemp("x")), *words])
    pipeline = config.pipeline.setup(device="cpu", test_mode="test")
    pipeline.eval()
    model = pipeline.model
    model.head.requires_grad_(False)
    for branch in (model.head.low, model.head.high):
        branch[2].weight.mul_(4.0)
    model.gauss_params["opacities"].data.normal_(0.0, 2.0)
    # Far from round: where components are alike, one more can bring a tanh further from its value, not nearer.
    model.gauss_params["latents"].data.mul_(20.0 * 0.4 ** torch.arange(6))
    return pipeline


@pytest.fixture(scope="module")
def field(loud):
    return Field(loud.model.head, {name: value.detach() for name, value in loud.model.gauss_params.items()})


@pytest.fixture(scope="module")
def seen(loud):
    return look_over(loud.model, loud.datamanager.train_dataset.cameras)


def test_the_mean_appearance_is_weighted_by_contribution(loud, seen):
    model, cameras = loud.model, loud.datamanager.train_dataset.cameras
    sums = torch.zeros(model.num_points, 5)
    for index in range(len(cameras)):
        one = observe(model, cameras[index : index + 1])
        colors = one.residuals + base_colors(model.features_dc[one.rows])
        columns = torch.cat([torch.ones(len(one.rows), 1), colors, one.opacities[:, None]], dim=1)
        sums.index_add_(0, one.rows, one.weights[:, None] * columns)
    some = sums[:, 0] > 1e-3
    assert some.sum() > 100
    mean = sums[some, 1:] / sums[some, :1]
    assert_close(seen.weight[some], sums[some, 0], rtol=1e-5, atol=1e-6)
    assert_close(base_colors(seen.features_dc[some]), mean[:, :3], rtol=0, atol=1e-5)
    assert_close(seen.opacities[some].sigmoid(), mean[:, 3:], rtol=0, atol=1e-5)
    unseen = seen.weight == 0
    assert (seen.largest[unseen] == 0).all() and (seen.features_dc[unseen] == model.features_dc[unseen]).all()


def test_the_largest_change_bounds_what_a_pixel_can_change(loud, field, seen):
    """One splat made diffuse, all else as it is: no pixel of any training view moves further."""
    model, cameras = loud.model, loud.datamanager.train_dataset.cameras
    order = seen.largest.argsort(descending=True)[::37][:8]
    assert seen.largest[order[0]] > 5, "a bound on nothing would hold"
    views = [model.project(cameras[i : i + 1]) for i in range(len(cameras))]
    with torch.no_grad():
        before = [model.composite(v, field.seen_from(v))[0]["rgb"] for v in views]
        tightest = 0.0
        for row in order.tolist():
            lone = seen._replace(largest=torch.full_like(seen.largest, 1e9).index_fill(0, order.new_tensor([row]), 0.0))
            small = dropped(field, lone, 0.5)
            moved = 0.0
            for view, picture in zip(views, before, strict=True):
                now = model.composite(view, small.seen_from(view))[0]["rgb"]
                moved = max(moved, float((now - picture).abs().max()) / EIGHT_BIT_STEP)
            # Colours beyond [0, 1] can contrast by more than 1; opacity of a splat in front also dims what is behind.
            assert moved <= 1.5 * float(seen.largest[row]) + 1e-3
            tightest = max(tightest, moved / max(float(seen.largest[row]), 1e-6))
        assert tightest > 0.1, "a bound that is far from reached would tell nothing"


def test_loss_falls_with_the_rank(loud, field, seen, monkeypatch):
    model, views = loud.model, FieldViews(loud.model, loud.datamanager.fixed_indices_eval_dataloader)
    # The truth is the model's own picture: what is left out is an error, and nothing else is.
    views.views = [
        (view, model.composite(view, field.seen_from(view))[0]["rgb"].detach(), None) for view, _, _ in views.views
    ]
    basis = latent_basis(field, seen.weight)
    scores = [views.psnr(with_rank(field, basis, rank)) for rank in range(1, 7)]
    assert scores == sorted(scores) and scores[-1] > 80 > scores[0]
    assert slim(field, seen, views, -1e3).threshold == float("inf")
    # The smallest that reaches a score is found, and no smaller one would do.
    monkeypatch.setattr(residuals, "THRESHOLDS", ())
    for wanted in (scores[0] - 1, 0.5 * (scores[1] + scores[2]), scores[4]):
        slimmed = slim(field, seen, views, wanted)
        assert views.psnr(slimmed.field) >= wanted
        assert slimmed.rank == 1 or scores[slimmed.rank - 2] < wanted
