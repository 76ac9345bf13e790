# SPDX-License-Identifier: Apache-2.0
"""Growth guided by the error: what it measures, draws, splits and replaces."""

import math

import pytest
import torch
from densification_cases import Table, rotations
from torch.testing import assert_close

from nrfgs_ns.densification import CHANGE, ErrorGuided
from nrfgs_ns.densification.error_guided import DECAY, ERROR, SHARE, WIDTH, draw, split
from nrfgs_ns.densification.strategy import GROWTH_LIMIT
from nrfgs_ns.errors import InputError
from nrfgs_ns.rasterizer import composite, project

pytestmark = pytest.mark.usefixtures("no_cuda")


def rules(**options):
    strategy = ErrorGuided(**options).build(0, 0, 1.0)
    strategy.verbose = False
    return strategy


def errors(size: int, scale: float = 1.0, views: int = 2, cameras_at_once: bool = False) -> torch.Tensor:
    """The statistic of twelve splats after so many views of `size` pixels of a scene that is `scale` times as large."""
    generator = torch.Generator().manual_seed(3)
    means = torch.rand(12, 3, generator=generator) - 0.5
    scales = 0.06 + 0.1 * torch.rand(12, 3, generator=generator)
    quats = torch.randn(12, 4, generator=generator)
    colors, opacities = torch.rand(12, 3, generator=generator), torch.rand(12, generator=generator)
    strategy, logits = rules(), torch.logit(opacities)[:, None]
    poses = torch.eye(4).repeat(views, 1, 1)
    poses[:, 2, 3] = 3.0 * scale
    poses[:, 0, 3] = 0.1 * scale * torch.arange(views)
    K = torch.tensor([[1.5 * size, 0.0, size / 2], [0.0, 1.5 * size, size / 2], [0.0, 0.0, 1.0]])
    y = (torch.arange(size) + 0.5) / size
    truth = torch.stack([y[None].expand(size, size), y[:, None].expand(size, size), 0 * y[None] + y[:, None]], -1)
    for group in [poses] if cameras_at_once else poses[:, None]:
        intrinsics = K.expand(len(group), 3, 3)
        projection = project((scale * means).requires_grad_(), quats, scale * scales, group, intrinsics, size, size)
        rows = projection.gaussian_ids
        image, _, info = composite(projection, colors[rows], opacities[rows], absgrad=True)
        strategy.pre_backward(0, info, opacities[rows], logits)
        (image - truth).abs().mean().backward()
        strategy._update_statistics(0, info, 12)
    assert strategy.state[ERROR].min() > 0
    return strategy.state[ERROR]


def test_the_error_is_the_largest_of_a_view_whatever_the_unit_and_the_size_and_number_of_images():
    assert_close(errors(96), errors(192), rtol=0.06, atol=1e-4)
    assert_close(errors(64, scale=2.0), errors(64), rtol=1e-3, atol=1e-6)
    assert (errors(64, views=4) >= errors(64, views=2) - 1e-7).all()
    assert_close(errors(64, views=2, cameras_at_once=True), errors(64, views=2), rtol=1e-4, atol=1e-7)


def test_many_different_views_raise_the_threshold():
    thresholds = [ErrorGuided(threshold=0.001).build(999, views, 1.0).threshold for views in (1, 30, 300, 600)]
    assert thresholds == pytest.approx([0.001, 0.00101, 0.002, 0.005], rel=1e-3)


def test_rows_that_no_camera_sees_change_nothing():
    """A recorded step gives a row to each splat, one kernel after the other only to those that are visible."""
    whole, visible = rules(), rules()
    table = Table(6)
    for strategy, rows in ((whole, torch.arange(6)), (visible, torch.tensor([1, 4]))):
        info = table.info(0.3)
        seen = torch.isin(rows, torch.tensor([1, 4]))
        info["means2d"].absgrad = torch.full((len(rows), 2), 0.3)
        info |= {"gaussian_ids": rows, "radii": torch.where(seen, 20, 0)}
        strategy.pre_backward(0, info, torch.full((len(rows),), 0.7), table.splats["opacities"])
        strategy._update_statistics(0, info, 6)
    for name in (ERROR, WIDTH, CHANGE):
        assert_close(whole.state[name], visible.state[name], rtol=0, atol=0)


def test_draws_are_different_rows_in_proportion_to_their_weights():
    torch.manual_seed(0)
    weights = torch.tensor([0.0, 1.0, 2.0, 0.0, 5.0, math.inf])
    assert draw(weights, 9).sort().values.tolist() == [1, 2, 4, 5]
    assert draw(weights, 1).tolist() == [5] and len(draw(weights, -3)) == 0 and len(draw(weights[:1], 2)) == 0
    firsts = torch.stack([draw(weights[:5], 1) for _ in range(4000)]).flatten()
    assert_close(torch.bincount(firsts, minlength=5) / 4000, torch.tensor([0, 1, 2, 0, 5]) / 8, atol=0.03, rtol=0)


@pytest.mark.parametrize("places", [[], [3], [3, 5]])
def test_halves_keep_each_axis_variance_and_the_opacity(places):
    """Each axis of both halves, written out one number after the other."""
    torch.manual_seed(1)
    table = Table(6, opacity=0.6)
    table.splats["scales"].data.copy_(torch.randn(6, 3) - 3)
    table.splats["quats"].data.copy_(torch.randn(6, 4))
    before = {name: value.detach().clone() for name, value in table.splats.items()}
    held, rows = dict(table.splats), torch.tensor([0, 2])
    split(table.splats, table.optimizers, rows, torch.tensor(places, dtype=torch.int64))
    table.check()
    assert len(table) == 8 - len(places)
    assert all(table.splats[name] is value for name, value in held.items()) == (len(places) == 2)
    for row, other in zip(rows.tolist(), [*places, *range(6, 8 - len(places))], strict=True):
        means = table.splats["means"].detach()
        assert_close((means[row] + means[other]) / 2, before["means"][row])
        offset = rotations(before["quats"])[row].T @ (means[row] - before["means"][row])
        scales = before["scales"][row].exp()
        for axis in range(3):
            k = 1 - (1 - 1 / math.sqrt(2)) * float(scales[axis] / scales.max()) ** 2
            for half in (row, other):
                new = table.splats["scales"][half, axis].exp().item()
                assert new == pytest.approx(k * scales[axis].item(), rel=1e-5)
            assert k * k * scales[axis] ** 2 + offset[axis] ** 2 == pytest.approx(scales[axis].item() ** 2, rel=1e-4)
        for half in (row, other):
            assert torch.sigmoid(table.splats["opacities"][half]).item() == pytest.approx(1 - 0.4 ** (1 / math.sqrt(2)))
            assert_close(table.splats["latents"][half], before["latents"][row])
            for name, value in table.splats.items():
                state = table.optimizers[name].state[value]
                assert not state["exp_avg"][half].any() and not state["exp_avg_sq"][half].any()
    assert table.optimizers["means"].state[table.splats["means"]]["exp_avg"][1].all()


def test_a_share_of_the_candidates_is_split_and_the_dead_are_replaced():
    table, strategy = Table(40), rules(threshold=0.01)
    table.set_opacity(slice(4), 0.001)
    stored = torch.sigmoid(table.splats["opacities"].detach()).flatten()
    table.step(strategy, 600, shown=stored, absgrad=(torch.arange(40) >= 20).float()[:, None].repeat(1, 2))
    table.check()
    assert len(table) == 40 + round(SHARE * 20) - 4
    assert set(table.splats["latents"][:4, 0].long().tolist()) <= set(range(4, 40))
    assert strategy.moved_at == 600, "rows denote other splats, and a mean over steps must know"
    assert all(len(value) == len(table) for name, value in strategy.state.items() if name != GROWTH_LIMIT)


def test_the_shown_opacity_decides_what_is_dead():
    table, strategy = Table(10), rules(threshold=10.0)
    table.set_opacity(slice(10), 0.001)
    shown = torch.full((10,), 0.3)
    shown[4:] = 0.001
    shown[9] = 0.9
    table.step(strategy, 600, shown=shown)
    assert table.splats["latents"][:4, 0].long().tolist() == [0, 1, 2, 3]
    assert set(table.splats["latents"][:, 0].long().tolist()) <= {0, 1, 2, 3, 9}


def test_wide_splats_are_split_whatever_their_error():
    table, strategy = Table(10), rules(threshold=10.0)
    table.step(strategy, 600, radii=torch.where(torch.arange(10) == 7, 80, 1))
    assert len(table) == 11
    assert table.splats["latents"][10, 0] == 7 and table.splats["scales"][7, 0].exp().item() < 0.001


@pytest.mark.parametrize("budget", [25, 70])
def test_a_budget_decides_how_many_splats_there_are_when_growth_ends(budget):
    """Splats without error grow, too, and none goes."""
    table, strategy = Table(40), rules(budget=budget)
    counts = []
    for step in range(0, 16_000, 200):
        table.step(strategy, step, absgrad=torch.rand(len(table), 2) * 1e-6)
        counts.append(len(table))
    assert counts == sorted(counts)
    assert counts[-1] == max(budget, 40)


def test_opacities_decay_less_and_less():
    """And no more once a paced training (`Pace.step_at`) is beyond the end."""
    taken, steps = [], (600, 15_000, 24_800, 40_000)
    for step in steps:
        table, strategy = Table(5), rules(stop_at=50_000)
        strategy.reschedule(lambda position, now=step: position if position > now else 0)
        strategy.state[WIDTH] = torch.full((5,), 0.5)
        table.step(strategy, step)
        taken.append(0.5 - torch.sigmoid(table.splats["opacities"][0]).item())
    assert taken == pytest.approx([DECAY * max(1 - step / 30_000, 0) for step in steps], abs=1e-6)


def test_growth_ends_at_the_cap_and_in_time():
    with pytest.raises(InputError, match="budget is 50; it must be at most most_splats, 40"):
        ErrorGuided(budget=50, most_splats=40).check()
    for step, options, count in ((600, {"most_splats": 43}, 43), (15_000, {}, 40), (25_000, {}, 40)):
        table, strategy = Table(40), rules(**options)
        table.step(strategy, step, gradient=1.0)
        assert len(table) == count


def test_a_budget_below_the_start_is_told(capsys):
    strategy = rules(budget=5)
    strategy.verbose = True
    for count, times in ((5, 0), (6, 1)):
        strategy.begin(torch.zeros(3, 3), count, 1)
        assert capsys.readouterr().out.count("budget of error-guided is 5") == times
