# SPDX-License-Identifier: Apache-2.0
"""Growth ends before a GPU's memory does: by fake readings, and with `-m gpu` in a process that may take little."""

from types import SimpleNamespace

import pytest
import torch
from densification_cases import REFINES, Table, arguments, strategy
from short_trainings import set_up

from nrfgs_ns.densification import STRATEGIES, memory
from nrfgs_ns.densification.strategy import GROWTH_LIMIT

GB = 10**9
OPTIONS = {"error-guided": {"threshold": 1e-4}}


class Rows(SimpleNamespace):
    """A table's tensor, or moment, of a card."""

    device, dim, __hash__ = torch.device("cuda"), lambda self: 2, object.__hash__

    def __len__(self) -> int:
        return 1000


def card(monkeypatch, share: float, free: float, reserved: float, allocated: float) -> None:
    """Let torch tell this of a card of 24 GB; sizes in GB."""
    readings = {
        "memory_reserved": int(reserved * GB),
        "memory_allocated": int(allocated * GB),
        "mem_get_info": (int(free * GB), 24 * GB),
        "get_per_process_memory_fraction": share,
        "get_device_properties": SimpleNamespace(total_memory=24 * GB),
    }
    for name, value in readings.items():
        monkeypatch.setattr(torch.cuda, name, lambda device, value=value: value, raising=False)


@pytest.mark.parametrize("share, free, limit", [(1.0, 17, 24), (0.5, 17, 12), (1.0, 2, 9)])
def test_the_estimate(share, free, limit, monkeypatch):
    """1,000 splats, with parameters and gradients of 1 GB each and moments of 2, and photographs of 1 GB, hold 7 GB."""
    card(monkeypatch, share, free, reserved=7, allocated=5)
    splats = {"means": Rows(nbytes=GB)}
    moments = {"exp_avg": Rows(nbytes=GB), "exp_avg_sq": Rows(nbytes=GB), "step": torch.ones(())}
    optimizers = {"means": SimpleNamespace(state={splats["means"]: moments})}
    # Each takes 6 MB in a step, and 3 MB twice while others are added.
    most = memory.most_splats(splats, optimizers, 0)
    assert most == pytest.approx((0.9 * limit - 1) / 0.009, abs=1)
    assert memory.most_splats(splats, optimizers, 10**7) == pytest.approx((0.9 * limit - 3) / 0.009, abs=1)
    assert most * 0.009 + 1 <= limit


@pytest.mark.parametrize("reserved, times", [(2, 0), (4, 1)])
def test_memory_is_given_back_where_it_may_be_short(reserved, times, monkeypatch):
    calls = []
    card(monkeypatch, 0.5, 10, reserved, reserved)
    monkeypatch.setattr(torch.cuda, "empty_cache", lambda: calls.append(1))
    memory.give_back(torch.device("cuda"))
    assert len(calls) == times


@pytest.mark.parametrize("name", STRATEGIES)
def test_growth_ends_where_memory_does(name, monkeypatch, capsys):
    """And for good, in a continued training too, unless that has another memory."""
    monkeypatch.setattr(memory, "most_splats", lambda *_: 41)
    table, rules = Table(40), strategy(name, opacity_seen="base", **OPTIONS.get(name, {}))
    torch.manual_seed(0)
    table.step(rules, REFINES, gradient=1.0)
    held = 40 if name in ("splatfacto", "original") else 41  # of equal gradients all grow, or none
    assert len(table) == held
    monkeypatch.setattr(memory, "most_splats", lambda *_: 1000)
    resumed = strategy(name, opacity_seen="base", **OPTIONS.get(name, {}))
    resumed.load_state(rules.state, torch.device("cpu"))
    for followed in (rules, resumed):
        table.step(followed, REFINES + 200, gradient=1.0)
        table.check()
        assert len(table) == held
    assert capsys.readouterr().out.count("growth is held at 41 splats") == 1
    monkeypatch.setattr(memory, "allowed", lambda device: 24 * GB)
    table.step(resumed, REFINES + 400, gradient=1.0)
    assert len(table) > 41


def test_a_far_estimate_bounds_a_refinement_alone(monkeypatch, capsys):
    """Of several devices the one with the most splats says whether the limit is near."""
    table, rules = Table(40), strategy("error-guided")
    monkeypatch.setattr(memory, "most_splats", lambda *_: 50)
    for trainings in (2, 1):
        rules.trainings = trainings
        assert rules.room_for(REFINES, table.info(), table.splats, table.optimizers, 30) == 10 // trainings
    assert rules.state[GROWTH_LIMIT] is None and not capsys.readouterr().out
    monkeypatch.setattr(rules, "minimum_of_devices", lambda n: n - 8 if n < 0 else n)  # another has 48
    assert rules.room_for(REFINES, table.info(), table.splats, table.optimizers, 30) == 10
    assert rules.state[GROWTH_LIMIT] == (50, 0)


@pytest.mark.parametrize("name", ["error-guided", "mcmc"])
def test_what_does_not_grow_does_not_end_growth(name, monkeypatch, capsys):
    """A card has memory for 600 splats beside images that take as much as 400, which the estimate counts as growing."""

    def most(splats, *_):
        count = len(splats["means"])
        return 1000 * count // (count + 400)

    monkeypatch.setattr(memory, "most_splats", most)
    table, rules = Table(40), strategy(name, **{**OPTIONS.get(name, {}), "budget": 900})
    torch.manual_seed(0)
    for step in range(REFINES, REFINES + 200 * 70, 200):
        table.step(rules, step, gradient=1.0)
        assert len(table) <= 600
    assert len(table) > 0.9 * 600
    assert capsys.readouterr().out.count("growth is held") == 1


@pytest.mark.parametrize("name", ["splatfacto", "original"])
def test_the_largest_gradients_grow(name, monkeypatch):
    """Splats that are wide in the image, but not by gradient, do not."""
    monkeypatch.setattr(memory, "most_splats", lambda *_: 43)
    table, rules = Table(40), strategy(name)
    table.step(rules, REFINES, torch.arange(40.0), radii=torch.where(torch.arange(40) < 20, 9, 1))
    table.check()
    assert table.splats["latents"][:, 0].round().sort().values.tolist() == sorted([*range(40), 37, 38, 39])


@pytest.mark.gpu
@pytest.mark.skipif(not hasattr(torch.cuda, "get_per_process_memory_fraction"), reason="torch < 2.8 tells no share")
@pytest.mark.parametrize("name", STRATEGIES)
def test_growth_is_held_in_a_small_share_of_a_card(name, tiny_scene, tmp_path, capsys):
    """A training that would grow without end ends well."""
    options = {
        "splatfacto": {"densify_grad_thresh": 0.0},
        "mcmc": {"budget": 2**24, "refine_every": 2},  # grows by 5 % at most
        "error-guided": {"budget": 10**7, "most_splats": 10**7, "warmup_length": 0, "refine_every": 30},
    }
    trainer = set_up(arguments(tiny_scene, tmp_path, name, 800, **options.get(name, {})))
    if name == "original":
        trainer.pipeline.model.densification.threshold = 0.0
    torch.cuda.empty_cache()
    total = torch.cuda.get_device_properties(0).total_memory
    torch.cuda.set_per_process_memory_fraction((torch.cuda.memory_reserved() + 300e6) / total)
    try:
        trainer.train()
        held, within = trainer.pipeline.model.densification.state[GROWTH_LIMIT]
        assert within < total and held > 10_000
    finally:
        torch.cuda.set_per_process_memory_fraction(1.0)
    assert trainer.pipeline.model.num_points <= held
    assert capsys.readouterr().out.count(f"growth is held at {held:,} splats") == 1
