# SPDX-License-Identifier: Apache-2.0
"""The hash grid's kernels on a CUDA device against PyTorch's grid in float64. `pytest -m gpu`."""

import pytest
import torch
from hash_grid_cases import assert_near_twin, grids, positions  # noqa: E402
from head_cases import awake, scene  # noqa: E402

from nrfgs_ns.appearance import hash_grid  # noqa: E402
from nrfgs_ns.appearance.vdgs import VdgsConfig  # noqa: E402

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]

PAPER = {"levels": 4, "log2_table_size": 15, "base_resolution": 16}
KERNELS = "InterpolationBackward"
"""What autograd calls the kernels' function."""


def interpolate(grid, x):
    features = grid(x)
    assert type(features.grad_fn).__name__ == KERNELS
    return features


@pytest.mark.parametrize("options", [{}, PAPER, {"levels": 7, "log2_table_size": 6}])
@pytest.mark.parametrize("features", [1, 2, 4, 8])
@pytest.mark.parametrize("count", [0, 1, 129, 100_000])
def test_values_and_gradients(count, features, options):
    assert_near_twin(*grids("cuda", features=features, **options), positions(count, "cuda"), interpolate)


def test_positions_that_start_anywhere():
    """Neither dense nor at a multiple of 16 bytes: another compiled kernel each time, and the usual one again."""
    case = grids("cuda", **PAPER)
    x = positions(3000, "cuda")
    for part in (x, x[1:], x[::2], x):
        assert_near_twin(*case, part, interpolate)


def test_what_is_no_lattice_coordinate():
    grid, _ = grids("cuda", **PAPER)
    wild = [[1e12, -1e12, 1e30], [-1e30] * 3, [0.1, torch.nan, 0.1], [0.1, 0.1, torch.inf], [0.3, -0.2, 0.1]]
    x = torch.tensor(wild, device="cuda", requires_grad=True)
    features = interpolate(grid, x)
    features.sum().backward()
    assert features[2:4].isnan().all()
    assert torch.isfinite(features[[0, 1, 4]]).all() and torch.isfinite(x.grad[[0, 1, 4]]).all()


@pytest.mark.parametrize("wanted", [0, 1])
def test_one_gradient_alone(wanted):
    """To the last bit: among so few positions no row is a corner of three cells, and two addends have no order."""
    grid, _ = grids("cuda", **PAPER)
    leaves = positions(60, "cuda")[::3].contiguous().requires_grad_(), grid.table  # the near ones
    cells = (leaves[0].detach()[:, None] * grid.resolutions[:, None]).floor().long()
    assert grid._rows(torch.stack([cells, cells + 1], dim=-1)).flatten().bincount().max() <= 2
    (expected,) = torch.autograd.grad(interpolate(grid, leaves[0]).square().sum(), leaves[wanted])
    leaves[1 - wanted].requires_grad_(False)
    before = leaves[1 - wanted].clone()
    for _ in range(2):  # Triton's own launch, and another one
        (found,) = torch.autograd.grad(interpolate(grid, leaves[0]).square().sum(), leaves[wanted])
        assert torch.equal(found, expected) and torch.equal(leaves[1 - wanted], before)


def test_float64_takes_torch():
    _, twin = grids("cuda")
    x = positions(100, "cuda")
    assert type(twin(x.double()).grad_fn).__name__ != KERNELS


def test_without_gradient():
    grid, _ = grids("cuda")
    x = positions(100, "cuda")
    expected = interpolate(grid, x)
    for mode in (torch.no_grad, torch.inference_mode):
        with mode():
            assert torch.equal(grid(x), expected)


def evaluate(head, case) -> tuple[str, dict[str, torch.Tensor]]:
    """Which function made the grid's features; values and gradients of a head, by name."""
    splats, visible, centers = case
    splats = {name: value.detach().requires_grad_() for name, value in splats.items()}
    head.zero_grad(set_to_none=True)
    made_by = []
    hook = head.grid.register_forward_hook(lambda module, inputs, output: made_by.append(type(output.grad_fn).__name__))
    colors, opacities = head(splats, visible, centers)
    hook.remove()
    generator = torch.Generator().manual_seed(7)
    upstream = [torch.randn(out.shape, generator=generator).to(out) for out in (colors, opacities)]
    torch.autograd.backward((colors, opacities), upstream)
    leaves = {**splats, **dict(head.named_parameters())}
    gradients = {f"d {name}": leaf.grad for name, leaf in leaves.items()}
    return made_by[0], {"colors": colors.detach(), "opacities": opacities.detach(), **gradients}


def test_the_head_takes_the_kernels(monkeypatch):
    """Beside the same head in PyTorch, in float32 both.

    Cells and distances are the same to the last bit. Features differ by 10 roundings, less than 2^-20, and the
    network's three layers of 19 to 32 terms with weights near 0.3, and the sigmoid's slope, leave that times
    (0.3 sqrt(32))^3 / 4 < 2: norms within 2^-18. Of the hidden units about 2^-20 are so near zero that they change
    sides, and one that does takes its whole gradient along: sqrt(2^-20) = 2^-10 of the norm, and for the first layers
    two layers of units, less than 2^-8 with all that follows.
    """
    head = awake(VdgsConfig(), torch.float32)
    splats, visible, centers = scene(head, 30_000, torch.float32)
    case = {name: value.cuda() for name, value in splats.items()}, visible.cuda(), centers.cuda()
    head = head.cuda()
    made_by, found = evaluate(head, case)
    assert made_by == KERNELS
    monkeypatch.setattr(hash_grid, "_kernels_run_on", lambda *_: False)
    made_by, expected = evaluate(head, case)
    assert made_by != KERNELS
    for name, value in expected.items():
        limit = 2.0**-8 if name.startswith("d ") else 2.0**-18
        assert (found[name] - value).norm() <= limit * value.norm(), name


def test_memory_is_that_of_features_and_gradients():
    """No rows, weights or corners' features: those of PyTorch's path are [M, 4, 8] and [M, 4, 8, 4]."""
    grid, _ = grids("cuda", **PAPER)
    x = torch.rand(500_000, 3, device="cuda", requires_grad=True)
    grid(x[:1])
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    interpolate(grid, x).sum().backward()
    # Features, and their gradient made dense; the gradients of positions and of the table; 4 MiB of crumbs.
    limit = 4 * (2 * len(x) * grid.width + x.numel() + grid.table.numel()) + 2**22
    assert torch.cuda.max_memory_allocated() - before <= limit
