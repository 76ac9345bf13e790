# SPDX-License-Identifier: Apache-2.0
"""The numbers of docs/measurements.md."""

from statistics import fmean, stdev

from nrfgs_lab.pages.tables import records


def _psnr(name: str) -> float:
    return records("bonsai")[name]["eval"]["psnr"]


def host(method: str) -> str:
    """PSNR on bonsai over seeds."""
    found = [_psnr(name) for name in records("bonsai") if name.startswith(f"30k/runs/{method}-bonsai-")]
    return f"{fmean(found):.2f} ± {stdev(found):.2f}"


def rate(trial: str) -> str:
    """PSNR of one of the shorter trainings."""
    found = [_psnr(name) for name in records("bonsai") if name.startswith(f"15k-levers/{trial}-bonsai-")]
    return " and ".join(f"{psnr:.2f}" for psnr in found)


def precisions() -> str:
    """PSNR of the field in each precision."""
    names = "nrfgs-bonsai-42", "nrfgs-bonsai-43", "tf32-bonsai-42", "bf16-bonsai-42"
    return ", ".join(f"{_psnr(f'30k-fused/{name}'):.2f}" for name in names)
