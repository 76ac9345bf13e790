# SPDX-License-Identifier: Apache-2.0
"""The figures of the pages, from the records in results/, as SVG that follows the reader's dark or light setting.

python -m nrfgs_lab.pages.figures            # writes docs/images/*.svg
"""

import math
from functools import partial
from statistics import median

from nrfgs_lab.pages.few_views import FIELD, SAME, sparse_runs, today
from nrfgs_lab.pages.methods import COUNTS, CURVES, HEADS_OF, RULES_OF, SEATS_OF, equal
from nrfgs_lab.pages.runs import ROOT, VIEWS, mean, view_gains
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


def curves(labels: dict[str, tuple[str, str]], metric: str = "psnr") -> str:
    """A metric over numbers of splats on three captures: a line for each label's run and rule."""
    panel, top, bottom, side = (WIDTH - 10) / len(CURVES), 28, 218, 40
    parts = []
    for column, scene in enumerate(CURVES):
        runs = {label: [equal(scene, run, n, rule) for n in COUNTS] for label, (run, rule) in labels.items()}
        lines = {
            label: [(one["splats"], mean([one], metric)) for one in sum(found, [])] for label, found in runs.items()
        }
        values = [value for points in lines.values() for _, value in points]
        step = 1 if max(values) - min(values) > 2.5 else 0.5
        low, high = math.floor(min(values) / step) * step, math.ceil(max(values) / step) * step
        left = panel * column + side
        x = lambda n, left=left: round(left + math.log(n / 65_000) / math.log(330_000 / 65_000) * (panel - side), 1)  # noqa: E731
        y = lambda v, low=low, high=high: round(bottom - (v - low) / (high - low) * (bottom - top), 1)  # noqa: E731
        for tick in range(round((high - low) / step) + 1):
            at = y(low + tick * step)
            parts.append(f'<line class="faint" x1="{left}" x2="{left + panel - side}" y1="{at}" y2="{at}"/>')
            parts.append(f'<text x="{left - 5}" y="{at + 5}" text-anchor="end">{low + tick * step:g}</text>')
        parts.append(f'<text x="{left}" y="16">{scene}, dB</text>')
        parts += [f'<text x="{x(n)}" y="{bottom + 20}" text-anchor="middle">{n // 1000}k</text>' for n in COUNTS]
        for colour, points in zip(LINES, lines.values(), strict=False):
            places = " ".join(f"{x(n)},{y(v)}" for n, v in points)
            parts.append(f'<polyline fill="none" stroke="{colour}" stroke-width="2.5" points="{places}"/>')
            parts += [f'<circle fill="{colour}" cx="{x(n)}" cy="{y(v)}" r="4"/>' for n, v in points]
    for row, (colour, label) in enumerate(zip(LINES, labels, strict=False)):
        at, line = 12 + 315 * (row % 2), bottom + 46 + 22 * (row // 2)
        parts.append(
            f'<line stroke="{colour}" stroke-width="4" x1="{at}" x2="{at + 26}" y1="{line - 5}" y2="{line - 5}"/>'
        )
        parts.append(f'<text x="{at + 34}" y="{line}">{label}</text>')
    height = bottom + 34 + 22 * -(-len(labels) // 2)
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}">\n<style>{STYLE}</style>'
    return "\n".join([head, *parts, "</svg>", ""])


FIGURES = {
    "views.svg": views,
    "heads.svg": partial(curves, HEADS_OF),
    "rules.svg": partial(curves, RULES_OF),
    "seats.svg": partial(curves, SEATS_OF),
}

if __name__ == "__main__":
    for name, draw in FIGURES.items():
        write_whole(ROOT / "docs" / "images" / name, draw())
