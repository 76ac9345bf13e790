# SPDX-License-Identifier: Apache-2.0
"""Plans that need no second device: who has which rows, who sends how many, what a step number becomes."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nrfgs_ns.densification import build_densification
from nrfgs_ns.distributed.schedules import forget_faster, with_fewer_steps
from nrfgs_ns.distributed.shards import rows_of, shard_counts, transfers
from nrfgs_ns.errors import InputError
from nrfgs_ns.method_config import nrfgs
from nrfgs_ns.training.pipeline import NrfgsPipeline


@given(st.integers(0, 50), st.integers(1, 8))
def test_every_row_has_one_device(total, devices):
    parts = [list(range(total))[rows_of(rank, total, devices)] for rank in range(devices)]
    assert sorted(row for part in parts for row in part) == list(range(total))
    assert [len(part) for part in parts] == shard_counts(total, devices)


def test_a_checkpoint_is_cut_where_as_many_devices_put_it_together():
    parts = [rows_of(rank, 10, 3, written=[5, 1, 4]) for rank in range(3)]
    assert [list(range(10))[part] for part in parts] == [[0, 1, 2, 3, 4], [5], [6, 7, 8, 9]]
    assert rows_of(1, 10, 2, written=[5, 1, 4]) == slice(1, 10, 2)
    assert rows_of(1, 10, 3, written=[5, 1, 3]) == slice(1, 10, 3), "counts of another table"


@given(st.lists(st.integers(0, 1000), min_size=1, max_size=8))
def test_transfers_end_in_balance_and_lose_nobody(counts):
    plan = transfers(counts)
    after = [count - sum(plan[rank]) + sum(row[rank] for row in plan) for rank, count in enumerate(counts)]
    assert after == shard_counts(sum(counts), len(counts))
    for rank, row in enumerate(plan):
        assert not (sum(row) and sum(other[rank] for other in plan)), "somebody sends and receives"
        assert row[rank] == 0 and min(row) >= 0 and sum(row) <= counts[rank]


@pytest.mark.parametrize("written, now", [(2, 1), (1, 2), (2, 4)])
def test_a_step_that_counts_for_other_images_is_not_gone_on_from(written, now):
    training = SimpleNamespace(images_per_step=now)
    with pytest.raises(InputError, match=f"count for {written} images .* for {now}"):
        NrfgsPipeline.check_schedules(training, {"images_per_step": written})
    NrfgsPipeline.check_schedules(training, {"images_per_step": now})
    NrfgsPipeline.check_schedules(SimpleNamespace(images_per_step=1), {})  # older checkpoints do not say


def test_schedules_counted_in_images():
    config = with_fewer_steps(replace(nrfgs.config, max_num_iterations=30_000, average_steps=200), 2)
    model, before = config.pipeline.model, nrfgs.config.pipeline.model
    assert (config.max_num_iterations, model.refine_every, model.stop_split_at) == (15_000, 50, 7_500)
    assert config.average_steps == 100
    assert model.reset_alpha_every == before.reset_alpha_every, "resets are counted in refinements"
    assert (before.refine_every, nrfgs.config.average_steps) == (100, None), "the configuration was changed"
    means, field = config.optimizers["means"], config.optimizers["field"]
    assert means["optimizer"].lr == pytest.approx(1.6e-4 * math.sqrt(2))
    assert (means["scheduler"].max_steps, means["scheduler"].lr_final) == (15_000, pytest.approx(1.6e-6 * math.sqrt(2)))
    assert field["optimizer"].eps == pytest.approx(1e-15 / math.sqrt(2))
    adam = torch.optim.Adam([torch.zeros(1, requires_grad=True)])
    forget_faster({"means": adam}, 2)
    assert adam.param_groups[0]["betas"] == pytest.approx((0.8, 0.998))
    forget_faster({"means": adam}, 16)
    assert adam.param_groups[0]["betas"][0] == 0.0


@pytest.mark.parametrize("strategy", ["splatfacto", "original", "mcmc"])
def test_no_step_number_is_divided_that_the_densification_refuses(strategy):
    pipeline = replace(nrfgs.config.pipeline, model=replace(nrfgs.config.pipeline.model, densification=strategy))
    model = with_fewer_steps(replace(nrfgs.config, pipeline=pipeline), 2).pipeline.model
    assert build_densification(model, num_train_images=10).name == strategy
    assert (model.refine_every, model.mcmc.stop_at) == (50, 12_500 if strategy == "mcmc" else 25_000)
