# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/necessity.md."""

from nrfgs_lab.pages.tables import grid, records

MODELS = {
    "inspect-gloss-0": "few views, matte",
    "inspect-gloss-1": "few views, glossy",
    "inspect-classic-gloss-0": "dense, matte",
    "inspect-classic-gloss-1": "dense, glossy",
    "inspect-antialiased-gloss-0": "dense, matte, antialiased",
}
PARTS = (
    *("high branch", "low branch", "opacity residual", "distance"),
    *("latent rank 2", "latent rank 8"),
    *("residuals below 8 steps", "all residuals"),
)


def parts() -> str:
    """What trained models lose without a part of the field, in dB."""
    found = {model: {row["part"]: row for row in records("necessity")[model]["rows"]} for model in MODELS}
    body = [["full model: PSNR", *(f"{found[model]['nothing']['psnr']:.2f}" for model in MODELS)]]
    for part in PARTS:
        cells = []
        for model in MODELS:
            row = found[model][part]
            share = f" ({100 * row['diffuse']:.0f}%)" if part.startswith("residuals") else ""
            cells.append(f"{row['loss_db']:.3f}{share}")
        body.append([part, *cells])
    return grid(["left out", *MODELS.values()], body)


def diffuse() -> str:
    """The head's time with a share of the splats diffuse."""
    found = {
        (one["visible"], one["diffuse"], one["variant"]): one["gpu_ms"]
        for one in records("head_gpu")["head_gpu_diffuse"]["diffuse"]
    }
    shares = sorted({share for _, share, _ in found})
    body = []
    for visible in sorted({visible for visible, _, _ in found}):
        whole = found[visible, 0.0, "no mask"]
        masked = (found[visible, share, "mask"] for share in shares)
        body.append([f"{visible:,}", f"{whole:.2f}", *(f"{100 * (ms / whole - 1):+.0f}%" for ms in masked)])
    return grid(["visible", "no mask (ms)", *(f"{100 * share:.0f}% diffuse" for share in shares)], body)
