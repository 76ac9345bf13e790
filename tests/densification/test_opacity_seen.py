# SPDX-License-Identifier: Apache-2.0
"""Which opacity decides that a splat is dead, how far noise moves it, and what the loss counts."""

import pytest
import torch
from densification_cases import REFINES, STRATEGIES, Table, arguments, strategy
from short_trainings import set_up
from torch.testing import assert_close

from nrfgs_ns.appearance.gsnb import GsnbConfig
from nrfgs_ns.appearance.nrf import NrfConfig
from nrfgs_ns.appearance.sg import SgConfig
from nrfgs_ns.appearance.sh import ShConfig
from nrfgs_ns.densification import CHANGE, UNSEEN
from nrfgs_ns.densification.strategy import change_of, shown_opacity

pytestmark = pytest.mark.usefixtures("no_cuda")


@pytest.mark.parametrize("name", STRATEGIES)
def test_a_splat_visible_through_its_residual_only(name):
    """Base below the threshold, effective opacity above: it dies if the base is seen, and lives if the peak is."""
    left = {}
    for seen in ("base", "peak"):
        table = Table(50)
        table.set_opacity(7, 0.001)
        rules = strategy(name, opacity_seen=seen)
        table.step(rules, REFINES - 2, shown=0.3)
        table.step(rules, REFINES - 1, shown=0.001)
        torch.manual_seed(0)
        table.step(rules, REFINES, shown=0.002)
        left[seen] = 7 in table.splats["latents"][:, 0].long()
    assert left == {"base": False, "peak": True}


@pytest.mark.parametrize("name", STRATEGIES)
def test_a_splat_that_its_residual_hides(name):
    """Base above the threshold, invisible in all views: the peak sees it. What no view shows is judged by its base."""
    table, rules = Table(50), strategy(name, opacity_seen="peak")
    torch.manual_seed(0)
    table.step(rules, REFINES, shown=0.001, seen=slice(0, 10))
    assert set(table.splats["latents"][:, 0].long().tolist()) == set(range(10, 50))


@pytest.mark.parametrize("name", STRATEGIES)
def test_the_peak_is_forgotten_at_refinement(name):
    table = Table(50)
    table.set_opacity(7, 0.001)
    rules = strategy(name, opacity_seen="peak")
    table.step(rules, REFINES, shown=0.3)
    assert 7 in table.splats["latents"][:, 0].long()
    torch.manual_seed(0)
    table.step(rules, REFINES + 100, shown=0.001, seen=slice(7, 8))
    assert 7 not in table.splats["latents"][:, 0].long()


@pytest.mark.parametrize("name", [*STRATEGIES, "error-guided"])
def test_an_opacity_that_is_nan_leaves_nothing_behind(name):
    """On a GPU the guard condemns a step after the strategy has seen it."""
    table, rules = Table(4), strategy(name, opacity_seen="peak")
    table.step(rules, 1, shown=torch.tensor([torch.nan, 0.7, 0.5, torch.nan]))
    assert rules.state[CHANGE].tolist() == pytest.approx([UNSEEN, 0.2, 0.0, UNSEEN], abs=1e-6)


# Heads whose opacity is the stored one.
@pytest.mark.parametrize("name", STRATEGIES)
def test_a_head_of_stored_opacity_cannot_tell_peak_from_base(name):
    """Bit for bit, over three refinements, with opacities that wander across the thresholds: 3DGS-MCMC stays itself."""
    ends = []
    budget = {"budget": 230} if name == "mcmc" else {}
    for seen in ("base", "peak"):
        torch.manual_seed(0)
        table = Table(203)
        rules = strategy(name, opacity_seen=seen, **budget)
        table.splats["opacities"].data.uniform_(-7.0, 0.0)
        for step in (998, 999, 1000, 1001, 1050, 1099, 1100, 1101, 1199, 1200, 1201):
            table.step(rules, step, shown=lambda stored: stored, seen=torch.randperm(len(table))[:150])
            table.splats["opacities"].data += torch.randn(len(table), 1)
        table.check()
        moments = [table.optimizers[key].state[value]["exp_avg"] for key, value in table.splats.items()]
        ends.append([*(value.detach() for value in table.splats.values()), *moments])
    assert len(torch.unique(ends[0][5][:, 0].long())) < 203, "nothing died: the test would prove nothing"
    for base, peak in zip(*ends, strict=True):
        assert torch.equal(base, peak)


@pytest.mark.parametrize("config", [ShConfig(), GsnbConfig(), SgConfig(), NrfConfig(opacity_residual=False)])
def test_heads_of_stored_opacity_change_nothing(config):
    """Exactly: 21 of 37 splats, so that they do not lie in the vectors and tails of a loop where the table has them."""
    torch.manual_seed(0)
    head, logits = config.setup(), 3 * torch.randn(37, 1)
    splats = {"means": torch.randn(37, 3), "opacities": logits, **head.splat_params(torch.rand(37, 3))}
    rows, rules = torch.randperm(37)[:21], strategy("mcmc")
    info = {"gaussian_ids": rows, "radii": torch.ones(21)}
    rules.pre_backward(0, info, head(splats, rows, torch.zeros(3)).opacities, logits)
    rules.take_changes(info, 37)
    assert (rules.state[CHANGE][rows] == 0.0).all() and (rules.state[CHANGE] == UNSEEN).sum() == 16


# Heads that change it.
def test_what_is_seen_is_what_was_shown():
    """By the change and the stored opacity from which it came; extremes included. A difference of two numbers up to 1,
    and a quotient below 1, are each rounded by up to 6e-8, three times in all."""
    stored = torch.cat([torch.rand(100), torch.tensor([0.0, 0.0, 1.0, 1.0, 1e-30, 1e-30, 0.2])])
    shown = torch.cat([torch.rand(100), torch.tensor([0.0, 0.2, 0.0, 1.0, 0.0, 0.3, 0.2])])
    change = change_of(stored, shown)
    assert change.abs().max() <= 1 and change[-1] == 0
    for nothing in (0 * stored, torch.full_like(stored, UNSEEN)):  # a head of stored opacity, and no view
        assert torch.equal(shown_opacity(stored, nothing), stored)
    assert_close(shown_opacity(stored, change), shown, rtol=0, atol=2e-7)


def test_what_is_seen_follows_the_stored_opacity():
    """A view's addition stays an amount, what it takes away stays a share; neither leads out of [0, 1]."""
    table = Table(4, opacity=0.3)
    table.set_opacity(2, 0.8)
    rules = strategy("mcmc")
    for shown, row in ((0.45, 0), (0.35, 0), (0.5, 1), (0.2, 2), (0.4, 2)):
        table.step(rules, 10, shown=shown, seen=slice(row, row + 1))
    assert_close(rules.seen_opacity(table.splats["opacities"]), torch.tensor([0.45, 0.5, 0.4, 0.3]))
    for row, stored in enumerate((0.001, 0.9, 0.1, 0.002)):
        table.set_opacity(row, stored)
    assert_close(rules.seen_opacity(table.splats["opacities"]), torch.tensor([0.001 + 0.15, 1.0, 0.1 / 2, 0.002]))


def test_noise_spares_what_views_have_lately_shown():
    """MCMC, a base at which the noise is at its largest: whoever was shown since the relocation before the last holds
    still, relocated rows included; with "base" all are shaken."""
    for seen in ("base", "peak"):
        table = Table(50, opacity=0.006)
        rules = strategy("mcmc", opacity_seen=seen, budget=60)
        torch.manual_seed(0)
        table.step(rules, REFINES, shown=0.4, seen=slice(0, 40))
        assert len(table) > 50
        before = table.splats["means"].detach().clone()
        parents = table.splats["latents"][:, 0].long()
        table.step(rules, REFINES + 1, shown=0.4, seen=slice(0, 1))
        moved = (table.splats["means"].detach() - before).abs().amax(dim=-1)
        assert moved[parents >= 40].min() > 0
        assert (moved[parents < 40].max() < 1e-15) == (seen == "peak")  # the gate at 0.4 is exp(-39.5)


@pytest.mark.parametrize("shown", [lambda stored: stored + 0.1, lambda stored: stored / 2])
def test_noise_spares_copies_as_their_source(shown):
    """MCMC: half of the splats, which views hide, move onto 25 others, whose stored opacity becomes smaller by it: from
    0.6 to 0.1 and more, for at most 8 in a place (1 - 0.4^(1/8) = 0.108). Halved, it is still far above the noise; if
    the 0.3 that a view took from the source were taken from its copies, they would count as invisible."""
    table = Table(50, opacity=0.6)
    table.set_opacity(slice(25, 50), 1e-4)
    rules = strategy("mcmc", budget=50)
    torch.manual_seed(0)
    table.step(rules, REFINES, shown=lambda stored: torch.where(stored > 0.5, shown(stored), 0.0))
    parents = table.splats["latents"][:, 0].long()
    assert parents.max() < 25 and torch.bincount(parents).max() <= 8  # in a place
    before = table.splats["means"].detach().clone()
    table.step(rules, REFINES + 1, seen=slice(0, 0))
    assert (table.splats["means"].detach() - before).abs().max() < 1e-12  # gate: below exp(-100 (0.054 - 0.005))


def test_what_views_have_shown_is_forgotten_after_the_last_relocation_too():
    """MCMC: noise goes on to the end of the training, and so must the windows of 100 steps that it looks back over."""
    table, rules = Table(50, opacity=0.001), strategy("mcmc", budget=50)
    moved = {}
    for step in (25_050, 25_100, 25_101, 25_199, 25_200, 25_201, 25_300, 30_000):
        before = table.splats["means"].detach().clone()
        table.step(rules, step, shown=0.4, seen=slice(0, 50 if step == 25_050 else 0))
        moved[step] = bool((table.splats["means"].detach() != before).any(dim=-1).all())
    assert moved == {step: step >= 25_200 for step in moved}


def test_mean_opacity_in_the_loss_is_that_of_what_is_shown():
    """MCMC: the cameras' mean of (what they show, else the stored opacity) over all splats, and its gradients."""
    rules = strategy("mcmc")
    stored = torch.tensor([0.1, 0.2, 0.3, 0.4], dtype=torch.float64)
    logits = torch.logit(stored)[:, None].requires_grad_()
    splats = {"opacities": logits, "scales": torch.zeros(4, 3, dtype=torch.float64)}
    assert_close(rules.regularisation(splats)["mcmc_opacity_reg"], 0.01 * stored.mean())
    shown = torch.tensor([0.5, 0.6, 0.7], dtype=torch.float64, requires_grad=True)
    info = {"gaussian_ids": torch.tensor([0, 2, 2]), "radii": torch.ones(3), "n_cameras": 2}
    rules.pre_backward(0, info, shown, logits)  # the first camera sees 0 and 2, the second 2
    term = rules.regularisation(splats)["mcmc_opacity_reg"]
    first, second = [0.5, 0.2, 0.6, 0.4], [0.1, 0.2, 0.7, 0.4]
    assert_close(term.item(), 0.01 * (sum(first) + sum(second)) / 8)
    by_logit, by_shown = torch.autograd.grad(term, (logits, shown))
    assert_close(by_shown, torch.full_like(shown, 0.01 / 8))
    kept = torch.tensor([1, 2, 0, 2], dtype=torch.float64)  # cameras that do not show it
    assert_close(by_logit[:, 0], 0.01 / 8 * kept * stored * (1 - stored))
    shown = torch.tensor([0.5, 0.6, 0.7, 0.8], dtype=torch.float64, requires_grad=True)
    info = {"gaussian_ids": torch.arange(4), "radii": torch.ones(4)}
    rules.pre_backward(0, info, shown, logits)  # one camera shows all
    term = rules.regularisation(splats)["mcmc_opacity_reg"]
    assert_close(term.item(), 0.01 * 0.65)
    assert_close(torch.autograd.grad(term, shown)[0], torch.full_like(shown, 0.01 / 4))


def test_the_peak_is_forgotten_at_reset():
    """Splatfacto does not refine at a reset: what was seen before it must not keep a splat alive after it."""
    table, rules = Table(50), strategy("splatfacto", opacity_seen="peak")
    table.step(rules, 2999, shown=0.9)
    assert_close(rules.state[CHANGE], torch.full((50,), 0.4))
    table.step(rules, 3000, shown=0.9)
    assert len(table) == 50 and (rules.state[CHANGE] == UNSEEN).all()


def test_the_peak_is_that_of_the_head(tiny_scene, tmp_path):
    trainer = set_up(arguments(tiny_scene, tmp_path, "splatfacto", 2, opacity_seen="peak"))
    model = trainer.pipeline.model
    model.head.low[-1].bias.data[3] = 100.0  # d_alpha = 0.2 tanh(100) = 0.2
    trainer.train()  # of its two steps the first one resets
    visible = torch.zeros(model.num_points, dtype=torch.bool)
    visible[model.info["gaussian_ids"]] = True
    assert visible.any() and not visible.all()
    change = model.densification.state[CHANGE]
    assert (change[~visible] == UNSEEN).all()
    assert_close(change[visible], torch.full_like(change[visible], 0.2))
