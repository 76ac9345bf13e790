# SPDX-License-Identifier: Apache-2.0
"""The numbers of docs/comparison.md."""

from statistics import fmean

from nrfgs_lab.bench.table import Row, ranks
from nrfgs_lab.pages.tables import BY_NAME, bench_rows, bold, grid, mean_of, records, signed

METHODS = ["3DGS", "VDGS", "GSNB", "SG", "NRF-GS"]
PARTS = {
    "no_split": "- its split",
    "no_opacity": "- its opacity residual",
    "no_distance": "- its distance",
    "NRF-GS_logit": "- residual on the logit instead",
}
RULES = {"original": "3DGS's rules", "mcmc@150000": "150,000 splats (MCMC)", "mcmc@300000": "300,000 splats (MCMC)"}
PSNR, SSIM = BY_NAME["PSNR"], BY_NAME["SSIM"]


def methods() -> str:
    """PSNR and SSIM of every method, and of the field without its parts."""
    rows = bench_rows("comparison")
    body = []
    for scene in ("bonsai", "goldcape"):
        best = {}
        for rule in RULES:
            compared = [rows[scene, rule, run] for run in METHODS]
            best[rule] = [
                {compared[n].run for n, rank in ranks(compared, one).items() if rank == 1} for one in (PSNR, SSIM)
            ]
        for run in [*METHODS, *PARTS]:
            cells = [_cell(rows.get((scene, rule, run)), *best[rule]) for rule in RULES]
            splats = mean_of(rows[scene, "original", run], "splats")
            body.append([scene, PARTS.get(run, run), f"{splats / 1000:.0f}k", *cells])
    return grid(["", "", "splats, 3DGS's rules", *RULES.values()], body)


def _cell(row: Row | None, best_psnr: set[str], best_ssim: set[str]) -> str:
    """PSNR with its deviation, and SSIM; the best method's bold."""
    if row is None:
        return "not run"
    psnr = bold(row.text(PSNR), row.run in best_psnr)
    ssim = bold(f"{mean_of(row, 'SSIM'):.4f}", row.run in best_ssim)
    return f"{psnr}, {ssim}" + (" (one seed)" if len(row.records) == 1 else "")


def gain(scene: str, rule: str, run: str, base: str) -> str:
    """Decibels by which a run is above another, in the mean of their seeds."""
    rows = bench_rows("comparison")
    return signed(mean_of(rows[scene, rule, run], "PSNR") - mean_of(rows[scene, rule, base], "PSNR"))


def gains(scene: str, rule: str, run: str, base: str, without: str = "") -> str:
    """The same, seed by seed.

    Args:
        without: name of a test view that is left out.
    """
    rows = bench_rows("comparison")

    def psnr(name: str, seed: int) -> float:
        views = rows[scene, rule, name].records[seed]["measured"]["test"]["per_image"]
        return fmean(view["psnr"] for view in views if not without or without not in view["image"])

    return " and ".join(signed(psnr(run, seed) - psnr(base, seed)) for seed in sorted(rows[scene, rule, run].records))


def view(scene: str, rule: str, run: str, image: str) -> str:
    """PSNR of one test view, seed by seed."""
    found = [
        next(one["psnr"] for one in record["measured"]["test"]["per_image"] if image in one["image"])
        for _, record in sorted(bench_rows("comparison")[scene, rule, run].records.items())
    ]
    return " and ".join(f"{psnr:.1f}" for psnr in found)


def ratio(scene: str, run: str, base: str) -> str:
    """Splats of a run over another's, under 3DGS's rules."""
    rows = bench_rows("comparison")
    return f"{mean_of(rows[scene, 'original', run], 'splats') / mean_of(rows[scene, 'original', base], 'splats'):.2f}"


def stored_opacity(splats: str) -> str:
    """PSNR of the field on bonsai where all of MCMC's rules go by the stored opacity."""
    record = records("comparison")[f"stored-opacity/NRF-GS-mcmc@{splats}-bonsai-42"]
    return f"{record['measured']['test']['psnr']:.1f}"
