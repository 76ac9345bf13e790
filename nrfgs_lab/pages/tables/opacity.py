# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/opacity.md."""

from nrfgs_lab.pages.tables import grid, records
from nrfgs_lab.pages.tables.captures import gains_over

SEEN = {
    "base": ("the field", "stored"),
    "peak": ("the field", "shown"),
    "SH": ("3DGS", "stored"),
}
BOUNDS = "straight-through", "clamp", "smooth", "logit"
SCENES = "bonsai", "goldcape", "fox"
ADDED = "nrfgs, 150,000 splats, opacity added", "nrfgs, 150,000 splats"


def pruning() -> str:
    """What 3DGS's rules make of the field, by the opacity that they go by."""
    study = records("opacity-seen")
    body = []
    for part, scene, seeds in (("30k/", "bonsai", [42]), ("", "fox", [42, 43])):
        found = {one["run"]: one for one in study[f"{part}opacity"]}
        for run, (label, seen) in SEEN.items():
            rows = [found[name] for name in (f"{run}-original-{scene}-{seed}" for seed in seeds) if name in found]
            cells = ["/".join(form.format(row[key]) for row in rows) for key, form in FORMS.items()]
            body.append([scene if scene == "bonsai" else "fox, small", label, seen, *cells])
    return grid(["", "", "pruned by", "splats", "PSNR", "PSNR right after a reset"], body)


FORMS = {"splats": "{:,}", "psnr": "{:.2f}", "psnr_after_reset": "{:.2f}"}


def mcmc(run: str) -> str:
    """PSNR under MCMC's rules, of 3DGS or of the field by the opacity that the rules go by."""
    return f"{records('mcmc-opacity')[f'bonsai/{run}-mcmc@150000-bonsai-42']['measured']['test']['psnr']:.2f}"


def copies() -> str:
    """What the field gains over harmonics under MCMC, by where its opacity residual is added."""
    rows = {"added": "added", "on the logit": "logit", "the same, stored": "logit, base", "none": "no opacity residual"}
    return gains_over("mcmc: harmonics", {label: [f"mcmc: {name}"] for label, name in rows.items()})


def moved() -> str:
    """On how many captures MCMC is better on test views with the residual on the logit, and where not."""
    runs = records("captures").values()
    added, logit = ({one["scene"]: one for one in runs if one["name"] == name} for name in ADDED)
    worse = [scene for scene in added if logit[scene]["psnr"] < added[scene]["psnr"]]
    cells = [f"`{scene}`, {added[scene]['psnr']:.2f} to {logit[scene]['psnr']:.2f} dB" for scene in worse]
    return f"better on {len(added) - len(worse)} captures of {len(added)} (not on {', '.join(cells)})"


def bounds() -> str:
    """Four ways to keep an opacity in [0, 1]."""
    found = {one["run"]: one for one in records("opacity")["30k/opacity"]}

    def cell(bound: str, key: str, form: str, unit: float = 1.0) -> str:
        return ", ".join(form.format(found[f"{bound}-own-{scene}-42"][key] / unit) for scene in SCENES)

    body = [
        [
            bound,
            cell(bound, "psnr", "{:.2f}"),
            cell(bound, "ssim", "{:.4f}"),
            cell(bound, "splats", "{:.0f}k", 1000),
            cell(bound, "dead_share", "{:.0f}", 0.01),
            cell(bound, "opacity_change", "{:.1f}", 0.001),
        ]
        for bound in BOUNDS
    ]
    return grid(["", "PSNR", "SSIM", "splats", "dead gradients (%)", "flicker (1e-3)"], body)
