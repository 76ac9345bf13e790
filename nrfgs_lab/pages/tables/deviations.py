# SPDX-License-Identifier: Apache-2.0
"""The numbers of docs/deviations.md."""

from statistics import median

from nrfgs_lab.pages.tables import bench_rows, mean_of, records, signed
from nrfgs_lab.pages.tables.comparison import ORIGINAL
from nrfgs_lab.pages.tables.readme import trials_of, view_gains


def start() -> str:
    """PSNR of the small fox with the paper's start, and with ours."""
    runs = "paper_s_start", "no_warm-up", "zero_start"
    there, cold, here = (mean_of(bench_rows("warm-up")["fox", ORIGINAL, run], "PSNR") for run in runs)
    return f"with {there:.2f} dB, without {cold:.2f}; here {here:.2f}"


def rules() -> str:
    """Field and splats under splatfacto's rules and 3DGS's, on bonsai."""
    rows = [bench_rows("speed")["bonsai", "own", run] for run in ("nrfgs", "nrfgs-best")]
    texts = [f"{mean_of(row, 'PSNR'):.2f} dB with {mean_of(row, 'splats') / 1000:.0f}k" for row in rows]
    return f"{texts[0]} (splatfacto's), {texts[1]} (3DGS's)"


SCENES = "bonsai", "goldcape", "fox"
HEADS = {"3DGS": "SH", "VDGS": "VDGS", "GSNB": "GSNB", "NRF": "NRF"}
"""A run of docs/bench/deviations.yaml that changes nothing -> the same one of heads.yaml."""


def worth(change: str) -> str:
    """What a single change does on held-out views, capture by capture: dB in the median view, times the splats."""
    rows, told = bench_rows("deviations"), []
    for scene in SCENES:
        changed, plain = rows[scene, ORIGINAL, change], rows[scene, ORIGINAL, change.partition("_")[0]]
        gain = signed(median(view_gains(trials_of(changed), trials_of(plain))), 2)
        told.append(f"`{scene}` {gain} (x{mean_of(changed, 'splats') / mean_of(plain, 'splats'):.2f})")
    return ", ".join(told)


def noise() -> str:
    """Decibels between two trainings alike, in the median held-out view: the most of any method, for each capture."""
    ours, theirs, told = bench_rows("deviations"), bench_rows("heads"), []
    for scene in SCENES:
        pairs = [(ours[scene, ORIGINAL, run], theirs.get((scene, ORIGINAL, HEADS[run]))) for run in HEADS]
        gains = [abs(median(view_gains(*map(trials_of, pair)))) for pair in pairs if all(pair)]
        told.append(f"{max(gains):.2f} dB on `{scene}`")
    return ", ".join(told)


def resets() -> str:
    """VDGS's PSNR on bonsai in the paper's protocol, with and without resets of opacity, and its splats."""
    rows = [bench_rows("paper")["bonsai", ORIGINAL, run] for run in ("VDGS", "VDGS_no_resets")]
    return " to ".join(f"{mean_of(row, 'PSNR'):.2f} dB ({mean_of(row, 'splats') / 1000:.0f}k)" for row in rows)


def precisions() -> str:
    """PSNR of the field on bonsai in each precision: fp32 with two seeds, tf32, bf16."""
    names = "fp32-bonsai-42", "fp32-bonsai-43", "tf32-bonsai-42", "bf16-bonsai-42"
    return ", ".join(f"{records('precision')[name]['eval']['psnr']:.2f}" for name in names)
