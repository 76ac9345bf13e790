# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/captures.md."""

from collections import defaultdict
from collections.abc import Iterable
from statistics import mean, median
from typing import Any

from nrfgs_lab.held_out import effects
from nrfgs_lab.pages.tables import bold, grid, records

VIEWS = {"bonsai": 255, "goldcape": 74, "caliterra": 65, "fox": 43, "castle": 26, "kitchen": 21, "fern": 17}
"""Training views of the captures, as shared/scenes has them."""


def gain(db: float, ssim: float) -> str:
    """A difference: dB / thousandths of SSIM."""
    return f"{db:+.2f} / {1000 * ssim:+.0f}"


def _held_out(**wanted: Any) -> list[dict[str, Any]]:
    """Records of the screening and of what followed it, with these entries."""
    found = [one for one in records("held-out").values() if "head" in one]
    return [one for one in found if all(one.get(name) == value for name, value in wanted.items())]


def screening() -> str:
    """What each factor does on held-out views of the captures with the fewest views."""
    body = []
    for head in ("field", "harmonics"):
        by_scene = {}
        for scene in ("fern", "castle"):
            runs = [one for one in _held_out(head=head, scene=scene, study="screening")]
            by_scene[scene] = (effects(runs), len(runs))
        for factor in sorted(set().union(*(found for found, _ in by_scene.values()))):
            cells = [gain(*found[factor]) if factor in found else "" for found, _ in by_scene.values()]
            body.append([head, factor, *cells])
    return grid(["", "factor", *(f"{scene}" for scene in by_scene)], body)


def together() -> str:
    """What the default gains over harmonics on held-out views, beside the field without it."""
    runs = defaultdict(list)
    base = {}
    for one in _held_out(study="together"):
        if one["trial"] == "harmonics: plain":
            base[one["scene"], one["offset"]] = {view[0]: view for view in one["per_image"]}
    for one in _held_out(study="together"):
        for name, psnr, ssim, *_ in one["per_image"]:
            truth = base.get((one["scene"], one["offset"]), {}).get(name)
            if truth and one["trial"] != "harmonics: plain":
                runs[one["trial"], one["scene"]].append((psnr - truth[1], ssim - truth[2]))
    scenes = [scene for scene in VIEWS if any(key[1] == scene for key in runs)]
    body = []
    for trial in sorted({trial for trial, _ in runs}):
        cells = [
            f"{gain(median(v[0] for v in runs[trial, scene]), mean(v[1] for v in runs[trial, scene]))}"
            if runs.get((trial, scene))
            else ""
            for scene in scenes
        ]
        body.append([trial, *cells])
    return grid(["", *scenes], body)


def _of(scene: str, name: str) -> list[dict[str, Any]]:
    return [one for one in records("captures").values() if one["scene"] == scene and one["name"] == name]


def _mean(runs: Iterable[dict[str, Any]], metric: str) -> float | None:
    values = [one[metric] for one in runs if one.get(metric) is not None]
    return mean(mean(v) if isinstance(v, list) else v for v in values) if values else None


def test_views() -> str:
    """PSNR / SSIM / FLIP and splats on test views."""
    names = ["nrfgs", "nrfgs-sh, nrfgs's steps", "nrfgs-sh", "splatfacto"]
    body = []
    for scene, views in VIEWS.items():
        found = {name: _of(scene, name) for name in names}
        best = {
            metric: max((_mean(runs, metric) or 0.0) * sign for runs in found.values() if runs)
            for metric, sign in (("psnr", 1), ("ssim", 1))
        }
        cells = []
        for runs in found.values():
            if not runs:
                cells.append("-")
                continue
            psnr, ssim, flip = (_mean(runs, metric) for metric in ("psnr", "ssim", "flip"))
            parts = [bold(f"{psnr:.2f}", psnr == best["psnr"]), bold(f"{ssim:.3f}", ssim == best["ssim"])]
            parts.append("-" if flip is None else f"{flip:.3f}")
            seeds = f" ({len(runs)})" if len(runs) > 1 else ""
            cells.append(f"{' / '.join(parts)}, {round(_mean(runs, 'splats') / 1000)}k{seeds}")
        body.append([scene, str(views), *cells])
    return grid(["", "views", "`nrfgs`", "harmonics, the same steps", "`nrfgs-sh`", "splatfacto"], body)
