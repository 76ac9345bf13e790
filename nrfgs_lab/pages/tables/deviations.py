# SPDX-License-Identifier: Apache-2.0
"""The numbers of docs/deviations.md."""

from nrfgs_lab.pages.tables import bench_rows, mean_of, signed


def start(run: str) -> str:
    """PSNR of the small fox with one of the starts."""
    return f"{mean_of(bench_rows('warm-up')['fox', 'original', run], 'PSNR'):.2f}"


def rules() -> str:
    """Field and splats under splatfacto's rules and 3DGS's, on bonsai."""
    own = bench_rows("presets")["bonsai", "own", "default"]
    original = bench_rows("comparison")["bonsai", "original", "NRF-GS"]
    texts = [f"{mean_of(row, 'PSNR'):.2f} dB with {mean_of(row, 'splats') / 1000:.0f}k" for row in (own, original)]
    return f"{texts[0]} (splatfacto's), {texts[1]} (3DGS's)"


def worth(change: str, base: str, scene: str = "bonsai") -> str:
    """What a single change does on held-out views: decibels seed by seed, and splats in multiples."""
    rows = bench_rows("deviations")
    changed, plain = rows[scene, "original", change], rows[scene, "original", base]
    psnr = [{seed: one["measured"]["test"]["psnr"] for seed, one in row.records.items()} for row in (changed, plain)]
    gains = [signed(psnr[0][seed] - psnr[1][seed], 2) for seed in sorted(psnr[0].keys() & psnr[1].keys())]
    return f"{', '.join(gains)} dB, {mean_of(changed, 'splats') / mean_of(plain, 'splats'):.2f} times the splats"


def noise() -> str:
    """Decibels between two trainings of one setting with one seed: harmonics on bonsai's held-out views."""
    twice = bench_rows("deviations")["bonsai", "original", "3DGS"], bench_rows("heads")["bonsai", "original", "SH"]
    psnr = [mean_of(row, "PSNR") for row in twice]
    return f"{abs(psnr[0] - psnr[1]):.2f} dB"
