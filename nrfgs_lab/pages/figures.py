# SPDX-License-Identifier: Apache-2.0
"""The figures of the pages, from the records in results/, as SVG that follows the reader's dark or light setting.

python -m nrfgs_lab.pages.figures            # writes docs/images/*.svg
"""

import math
from functools import partial
from statistics import median

from nrfgs_lab.pages.few_views import FEWER, FIELD, SAME, sparse_runs, today
from nrfgs_lab.pages.methods import COUNTS, CURVES, HEADS_OF, RULES_OF, SEATS_OF, Labels, equal
from nrfgs_lab.pages.runs import ROOT, VIEWS, bench_rows, mean_of, records, view_gains
from nrfgs_lab.pages.speed import PRESETS
from nrfgs_ns.files import write_whole

WIDTH, LEFT, ROW = 640, 130, 34
STYLE = """text { font: 15px sans-serif; fill: #1f2328 } .rule { stroke: #59636e } .faint { stroke: #d1d9e0 }
.better { fill: #0969da } .worse { fill: #bc4c00 }
@media (prefers-color-scheme: dark) { text { fill: #f0f6fc } .rule { stroke: #9198a1 } .faint { stroke: #3d444d }
.better { fill: #4493f8 } .worse { fill: #db6d28 } }"""


def svg(height: float, parts: list[str]) -> str:
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}">\n<style>{STYLE}</style>'
    return "\n".join([head, *parts, "</svg>", ""])


def views() -> str:
    """Gain of the field over harmonics with the same rules in each test view, a dot each; bars are medians."""
    rows = {(views, scene): (today(scene, FIELD), today(scene, SAME)) for scene, views in VIEWS.items()}
    rows |= {(views, "bonsai"): sparse_runs(f"{views}_views_bonsai") for views in FEWER}
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
    return svg(height, parts)


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
    return svg(height, parts)


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


def seconds() -> str:
    """PSNR over seconds of `bonsai`'s trainings, alone on a GPU: before growth by error, and today's, filled."""
    rows = {run: bench_rows("speed").get(("bonsai", "own", run)) for run in PRESETS}
    dots = {run: (median(row.values["time s"].values()), mean_of(row, "PSNR")) for run, row in rows.items() if row}
    one = records("trials")["one host: nrfgs/bonsai-42"]
    dots["today's nrfgs"] = one["seconds"], one["psnr"]

    def at(time: float, value: float) -> tuple[float, float]:
        x = 45 + math.log(time / 10) / math.log(40) * (WIDTH - 75)
        return round(x, 1), round(20 + (36 - value) * HIGH / 5, 1)

    parts = []
    for value in range(31, 37):
        (left, y), (right, _) = at(10, value), at(400, value)
        parts.append(f'<line class="faint" x1="{left}" x2="{right}" y1="{y}" y2="{y}"/>')
        parts.append(f'<text x="{left - 8}" y="{y + 5}" text-anchor="end">{value}</text>')
    for time in (10, 20, 50, 100, 200, 400):
        x, y = at(time, 31)
        parts.append(f'<text x="{x}" y="{y + 22}" text-anchor="middle">{time} s</text>')
    for label, (time, value) in dots.items():
        (x, y), filled = at(time, value), 1 if label not in PRESETS else 0.3
        beside, anchor = (-10, "end") if time > 150 else (10, "start")
        parts.append(f'<circle class="better" fill-opacity="{filled}" cx="{x}" cy="{y}" r="6"/>')
        parts.append(f'<text x="{x + beside}" y="{y + 5}" text-anchor="{anchor}">{label}</text>')
    return svg(HIGH + 50, parts)


FIGURES = {
    "views.svg": views,
    "seconds.svg": seconds,
    "heads.svg": partial(curves, HEADS_OF),
    "rules.svg": partial(curves, RULES_OF, ("psnr", "ssim")),
    "seats.svg": partial(curves, SEATS_OF),
}

if __name__ == "__main__":
    for name, draw in FIGURES.items():
        write_whole(ROOT / "docs" / "images" / name, draw())
