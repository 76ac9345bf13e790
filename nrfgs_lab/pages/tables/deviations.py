# SPDX-License-Identifier: Apache-2.0
"""The numbers of docs/deviations.md."""

from statistics import median

from nrfgs_lab.pages.tables import bench_rows, mean_of, records, signed
from nrfgs_lab.pages.tables.readme import TRAINING_VIEWS, trials_of, view_gains


def start() -> str:
    """PSNR of the small fox with the paper's start, and with ours."""
    runs = "paper_s_start", "no_warm-up", "zero_start"
    there, cold, here = (mean_of(bench_rows("warm-up")["fox", "original", run], "PSNR") for run in runs)
    return f"{there:.2f} dB, without warm-up {cold:.2f}; here {here:.2f}"


def rules() -> str:
    """Field and splats under splatfacto's rules and 3DGS's, on bonsai."""
    rows = [bench_rows("speed")["bonsai", "own", run] for run in ("nrfgs", "nrfgs-best")]
    texts = [f"{mean_of(row, 'PSNR'):.2f} dB with {mean_of(row, 'splats') / 1000:.0f}k" for row in rows]
    return f"{texts[0]} (splatfacto's), {texts[1]} (3DGS's)"


BASES = {"3DGS": "SH", "VDGS": "VDGS", "GSNB": "GSNB", "NRF": "NRF"}
"""First word of a run of docs/bench/deviations.yaml -> the run of heads.yaml that it changes."""


def worth(change: str) -> str:
    """What a single change does on held-out views, capture by capture: dB in the median view, times the splats."""
    changed, plain = bench_rows("deviations"), bench_rows("heads")
    told = []
    for scene in TRAINING_VIEWS:
        row, base = (
            changed.get((scene, "original", change)),
            plain.get((scene, "original", BASES[change.split("_")[0]])),
        )
        if row and base:
            gain = signed(median(view_gains(trials_of(row), trials_of(base))), 2)
            told.append(f"{scene} {gain} dB (x{mean_of(row, 'splats') / mean_of(base, 'splats'):.2f})")
    return "; ".join(told) or "not measured"


def noise() -> str:
    """Decibels between two trainings of one setting with one seed: harmonics on bonsai's held-out views."""
    twice = bench_rows("deviations")["bonsai", "original", "3DGS"], bench_rows("heads")["bonsai", "original", "SH"]
    return f"{abs(median(view_gains(*map(trials_of, twice)))):.2f} dB"


def precisions() -> str:
    """PSNR of the field on bonsai in each precision: fp32 with two seeds, tf32, bf16."""
    names = "fp32-bonsai-42", "fp32-bonsai-43", "tf32-bonsai-42", "bf16-bonsai-42"
    return ", ".join(f"{records('precision')[name]['eval']['psnr']:.2f}" for name in names)
