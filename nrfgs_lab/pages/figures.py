# SPDX-License-Identifier: Apache-2.0
"""The figures of the pages, from the records in results/, as SVG that follows the reader's dark or light setting.

python -m nrfgs_lab.pages.figures            # writes docs/images/*.svg
"""

import math
from functools import partial
from statistics import median

from nrfgs_lab.pages.few_views import FIELD, SAME, sparse_runs, today
from nrfgs_lab.pages.methods import COUNTS, CURVES, HEADS_OF, RULES_OF, SEATS_OF, Labels, equal
from nrfgs_lab.pages.runs import ROOT, VIEWS, view_gains
from nrfgs_ns.files import write_whole

WIDTH, LEFT, ROW = 640, 130, 34
STYLE = """text { font: 15px sans-serif; fill: #1f2328 } .rule { stroke: #59636e } .faint { stroke: #d1d9e0 }
.better { fill: #0969da } .worse { fill: #bc4c00 }
@media (prefers-color-scheme: dark) { text { fill: #f0f6fc } .rule { stroke: #9198a1 } .faint { stroke: #3d444d }
.better { fill: #4493f8 } .worse { fill: #db6d28 } }"""


def views() -> str:
    """Gain of the field over harmonics with the same rules in each test view, a dot each; bars are medians."""
    rows = {(views, scene): (today(scene, FIELD), today(scene, SAME)) for scene, views in VIEWS.items()}
    rows[24, "bonsai"] = sparse_runs("24_views_bonsai")
    gains = {f"{scene}, {views}": view_gains(*rows[views, scene]) for views, scene in sorted(rows, reverse=True)}
    least, most = (math.floor(min(map(min, gains.values()))), math.ceil(max(map(max, gains.values()))))
    height = ROW * len(gains) + 50

    def x(gain: float) -> float:
        return round(LEFT + (gain - least) / (most - least) * (WIDTH - LEFT - 15), 1)

    parts = [f'<line class="faint" x1="{x(g)}" x2="{x(g)}" y1="8" y2="{height - 42}"/>' for g in range(least, most + 1)]
    for row, (label, values) in enumerate(gains.items()):
        y, middle = ROW * row + 25, x(median(values))
        parts.append(f'<text x="4" y="{y + 5}">{label}</text>')
        kinds = ((value, "better" if value > 0 else "worse") for value in values)
        parts += [f'<circle class="{kind}" cx="{x(v)}" cy="{y}" r="5" fill-opacity="0.55"/>' for v, kind in kinds]
        parts.append(f'<line class="rule" stroke-width="3" x1="{middle}" x2="{middle}" y1="{y - 12}" y2="{y + 12}"/>')
    parts.append(f'<line class="rule" x1="{x(0)}" x2="{x(0)}" y1="8" y2="{height - 42}"/>')
    ticks = [gain for gain in range(least, most + 1) if gain % 2 == 0]
    parts += [
        f'<text x="{x(g)}" y="{height - 25}" text-anchor="middle">{g:+d}</text>'.replace("+0", "0") for g in ticks
    ]
    parts.append(f'<text x="{(LEFT + WIDTH) / 2}" y="{height - 5}" text-anchor="middle">field - harmonics, dB</text>')
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}">\n<style>{STYLE}</style>'
    return "\n".join([head, *parts, "</svg>", ""])


LINES = "#0969da", "#bc4c00", "#1a7f37", "#8250df", "#bf3989", "#808890"
"""Colours that are seen on white and on black."""
PANEL, HIGH, SIDE = 210, 190, 40
"""Width of a panel with its numbers, height of its lines, and room beside them."""


def curves(labels: Labels, metrics: tuple[str, ...] = ("psnr",)) -> str:
    """Metrics over numbers of splats on three captures: a panel each, a line for each label's run and rule."""
    places = [
        (scene, metric, PANEL * x, (HIGH + 62) * y)
        for y, metric in enumerate(metrics)
        for x, scene in enumerate(CURVES)
    ]
    parts = [part for place in places for part in panel(labels, *place)]
    top = (HIGH + 62) * len(metrics) + 12
    for index, (colour, label) in enumerate(zip(LINES, labels, strict=False)):
        x, y = 12 + 315 * (index % 2), top + 22 * (index // 2)
        parts.append(f'<line stroke="{colour}" stroke-width="4" x1="{x}" x2="{x + 26}" y1="{y - 5}" y2="{y - 5}"/>')
        parts.append(f'<text x="{x + 34}" y="{y}">{label}</text>')
    height = top + 22 * -(-len(labels) // 2)
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}">\n<style>{STYLE}</style>'
    return "\n".join([head, *parts, "</svg>", ""])


def panel(labels: Labels, scene: str, metric: str, left: float, top: float) -> list[str]:
    """One capture's lines, with a logarithmic axis of splats."""
    found = [sum((equal(scene, run, count, rule) for count in COUNTS), []) for run, rule in labels.values()]
    lines = [[(one["splats"], one[metric]) for one in runs] for runs in found]
    values = [value for line in lines for _, value in line]
    step = next(step for step in (0.01, 0.02, 0.5, 1.0) if max(values) - min(values) < 6 * step)
    low, high = math.floor(min(values) / step) * step, math.ceil(max(values) / step) * step
    left, top, right = left + SIDE, top + 28, left + PANEL

    def at(count: int, value: float) -> tuple[float, float]:
        x = left + math.log(count / 65_000) / math.log(330_000 / 65_000) * (right - left)
        return round(x, 1), round(top + (high - value) / (high - low) * HIGH, 1)

    parts = [f'<text x="{left}" y="{top - 12}">{scene}, {"dB" if metric == "psnr" else "SSIM"}</text>']
    for tick in (low + step * index for index in range(round((high - low) / step) + 1)):
        y = at(65_000, tick)[1]
        parts.append(f'<line class="faint" x1="{left}" x2="{right}" y1="{y}" y2="{y}"/>')
        parts.append(f'<text x="{left - 5}" y="{y + 5}" text-anchor="end">{tick:.4g}</text>')
    for count in COUNTS:
        x = at(count, low)[0]
        parts.append(f'<text x="{x}" y="{top + HIGH + 20}" text-anchor="middle">{count // 1000}k</text>')
    for colour, points in zip(LINES, ([at(*one) for one in line] for line in lines), strict=False):
        joined = " ".join(f"{x},{y}" for x, y in points)
        parts.append(f'<polyline fill="none" stroke="{colour}" stroke-width="2.5" points="{joined}"/>')
        parts += [f'<circle fill="{colour}" cx="{x}" cy="{y}" r="4"/>' for x, y in points]
    return parts


FIGURES = {
    "views.svg": views,
    "heads.svg": partial(curves, HEADS_OF),
    "rules.svg": partial(curves, RULES_OF, ("psnr", "ssim")),
    "seats.svg": partial(curves, SEATS_OF),
}

if __name__ == "__main__":
    for name, draw in FIGURES.items():
        write_whole(ROOT / "docs" / "images" / name, draw())
