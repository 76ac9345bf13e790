# SPDX-License-Identifier: Apache-2.0
"""What the noise on the head's view costs on a GPU: forward and backward of the fused field.

    python -m nrfgs_lab.timing.view_noise [results/noise-cost.json]

Without it; with moved means, as a training does it; and with a camera centre for each splat, the other way to say it.
"""

import json
import sys
from pathlib import Path
from time import perf_counter

import torch
from torch.profiler import ProfilerActivity, profile

from nrfgs_ns.appearance.nrf import NrfConfig
from nrfgs_ns.model.view_noise import ViewNoise

SPLATS = 150_000, 1_000_000
REPEATS = 100


def measure(call) -> dict[str, float]:
    """Milliseconds of one call: of its kernels, and of the clock on the wall."""
    for _ in range(5):
        call()
    torch.cuda.synchronize()
    with profile(activities=[ProfilerActivity.CUDA]) as kernels:
        for _ in range(REPEATS):
            call()
        torch.cuda.synchronize()
    started = perf_counter()
    for _ in range(REPEATS):
        call()
    torch.cuda.synchronize()
    wall = (perf_counter() - started) / REPEATS
    busy = sum(event.self_device_time_total for event in kernels.key_averages()) / REPEATS
    return {"gpu_ms": busy / 1e3, "wall_ms": wall * 1e3}


def costs(count: int) -> dict[str, dict[str, float]]:
    """What each way costs for this many visible splats."""
    head = NrfConfig(implementation="fused").setup().cuda()
    splats = {"means": torch.randn(count, 3), "opacities": torch.randn(count, 1)}
    splats |= head.splat_params(torch.rand(count, 3))
    splats = {name: value.cuda().requires_grad_() for name, value in splats.items()}
    visible, center = torch.arange(count, device="cuda"), torch.tensor([0.0, 0.0, 5.0], device="cuda")
    noise = ViewNoise(0.1, 42)

    def step(table, centers) -> None:
        seen = head(table, visible, centers)
        (seen.colors.sum() + seen.opacities.sum()).backward()
        for value in splats.values():
            value.grad = None

    return {
        "no noise": measure(lambda: step(splats, center)),
        "moved means": measure(lambda: step(noise.moved(splats, 1), center)),
        "a centre for each splat": measure(
            lambda: step(splats, center + 0.1 * torch.randn(count, 3, device=center.device))
        ),
        "the draw alone": measure(lambda: noise.moved(splats, 1)),
    }


if __name__ == "__main__":
    found = {str(count): costs(count) for count in SPLATS}
    for count, ways in found.items():
        print(count, *(f"{way}: {ms['gpu_ms']:.3f} ms" for way, ms in ways.items()), sep="; ")
    if len(sys.argv) > 1:
        content = {"study": Path(sys.argv[1]).stem, "records": found}
        Path(sys.argv[1]).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
