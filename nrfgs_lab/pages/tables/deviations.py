# SPDX-License-Identifier: Apache-2.0
"""The numbers of docs/deviations.md."""

from nrfgs_lab.pages.tables import bench_rows, mean_of, records, signed


def start(run: str) -> str:
    """PSNR of the small fox with one of the starts."""
    return f"{mean_of(bench_rows('warm-up')['fox', 'original', run], 'PSNR'):.2f}"


def bonsai(run: str) -> str:
    """PSNR of a whole training of bonsai under splatfacto's rules."""
    return f"{records('bonsai')[f'30k-fused/{run}-bonsai-42']['eval']['psnr']:.2f}"


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
    """Decibels between two trainings of one setting with one seed, of each head that has both."""
    twice = {"3DGS": "SH", "VDGS": "VDGS", "GSNB": "GSNB", "NRF": "NRF"}
    pairs = [
        (bench_rows("deviations")["bonsai", "original", a], bench_rows("heads")["bonsai", "original", b])
        for a, b in twice.items()
    ]
    apart = [
        abs(a.records[42]["measured"]["test"]["psnr"] - b.records[42]["measured"]["test"]["psnr"]) for a, b in pairs
    ]
    return f"{min(apart):.2f} to {max(apart):.2f} dB"
