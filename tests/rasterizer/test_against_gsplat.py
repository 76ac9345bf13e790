# SPDX-License-Identifier: Apache-2.0
"""The CPU rasterizer, gsplat's recorded results and the float64 twin: any two agree up to rounding."""

from pathlib import Path

import pytest
from agreement import BOUNDS, assert_agrees, judge
from gsplat_call import rasterization
from make_gsplat_fixtures import CASES, evaluate, load, upstream

from nrfgs_ns.rasterizer.torch_cpu import projection

RECORDED = Path(__file__).resolve().parents[1] / "fixtures" / "gsplat.npz"
DENSE_FLOOR = 0.01
"""`MIN_DISCRIMINANT` of gsplat 1.4's dense kernel, which made the records."""


@pytest.fixture(scope="module", params=sorted(CASES))
def recorded(request):
    case, grads, gsplat = load(RECORDED, request.param)
    return case, grads, gsplat, judge(case, grads, floor=DENSE_FLOOR)


def test_gsplat_agrees_with_the_twin(recorded):
    """The twin is what the CPU rasterizer is tested by everywhere else: gsplat itself must satisfy it."""
    _, _, gsplat, verdict = recorded
    assert_agrees(verdict, gsplat)


def test_cpu_agrees_with_gsplat(recorded, monkeypatch):
    """Both lie within the twin's tolerance, so they are within twice of each other."""
    case, grads, gsplat, verdict = recorded
    monkeypatch.setattr(projection, "MIN_DISCRIMINANT", DENSE_FLOOR)
    ours = evaluate(rasterization, case, grads, "cpu", packed=False)
    assert_agrees(verdict, ours)
    for name, tolerance in verdict.tolerances.items():
        difference = (ours[name].double() - gsplat[name].double()).abs()
        seen = verdict.visible if name in ("means2d", "depths", "conics") else ...
        assert (difference <= 2 * tolerance)[seen].all(), name
    seen = verdict.visible
    assert (ours["radii"] - gsplat["radii"]).abs()[seen].le(1).all()


@pytest.mark.gpu
@pytest.mark.parametrize("name", sorted(CASES))
def test_gpu_back_end_agrees_with_the_twin(name):
    case, bounds = CASES[name](), BOUNDS["cuda"]
    grads = upstream(case, bounds=bounds)
    assert_agrees(judge(case, grads, bounds=bounds), evaluate(rasterization, case, grads, "cuda", packed=False))
