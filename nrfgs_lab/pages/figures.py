# SPDX-License-Identifier: Apache-2.0
"""The figures of the pages, from the records in results/, as SVG that follows the reader's dark or light setting.

python -m nrfgs_lab.pages.figures            # writes docs/images/*.svg
"""

import math
from collections.abc import Iterable
from functools import partial
from itertools import product
from statistics import median

from nrfgs_lab.pages.few_views import FIELD, HALF, MADE, SAME, sparse_runs, today
from nrfgs_lab.pages.files import reports
from nrfgs_lab.pages.methods import COUNTS, CURVES, HEADS_OF, RULES_OF, SEATS_OF, Labels, equal
from nrfgs_lab.pages.runs import ROOT, VIEWS, bench_rows, mean_of, records, signed, view_gains
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
    rows |= {(views, "bonsai"): sparse_runs(scene) for scene, views in HALF.items() if scene != "bonsai"}
    rows |= {(262, kind): sparse_runs(scene) for kind, scene in MADE.items()}
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
    ticks = {gain: signed(gain, 0) for gain in range(least, most + 1) if gain % 2 == 0}
    parts += [f'<text x="{x(g)}" y="{height - 25}" text-anchor="middle">{text}</text>' for g, text in ticks.items()]
    parts.append(f'<text x="{(LEFT + WIDTH) / 2}" y="{height - 5}" text-anchor="middle">field - harmonics, dB</text>')
    return svg(height, parts)


LINES = "#0969da", "#bc4c00", "#1a7f37", "#8250df", "#bf3989", "#808890"
"""Colours that are seen on white and on black."""
PANEL, HIGH, SIDE = 210, 190, 40
"""Width of a panel with its numbers, height of its lines, and room beside them."""
RUNS = "splatfacto", "nrfgs-sh", "nrfgs-fast", "nrfgs", "nrfgs-best"
FITTED = {
    "degree": "harmonics, degree 0 to 5, least squares",
    "latent_dim": "field, latents of 4 to 16",
    "width": "field, width 16 to 128",
    "bands": "field, bands 1 to 6",
}
"""Sweep in results/express.json -> its label."""


def axes(box: tuple[float, float, float], ticks: dict[float, str], values: list[float], title: str) -> tuple:
    """A logarithmic axis with ticks and one that holds values, in a box: `at`, which places a point, and the parts."""
    step = next(step for step in (0.01, 0.02, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0) if max(values) - min(values) < 7 * step)
    low, high = math.floor(min(values) / step + 1e-6) * step, math.ceil(max(values) / step - 1e-6) * step
    (left, top, right), least, most = box, min(ticks) / 1.3, max(ticks) * 1.1

    def at(x: float, y: float) -> tuple[float, float]:
        across = math.log(x / least) / math.log(most / least)
        return round(left + across * (right - left), 1), round(top + (high - y) / (high - low) * HIGH, 1)

    parts = [f'<text x="{left}" y="{top - 12}">{title}</text>']
    for tick in (low + step * index for index in range(round((high - low) / step) + 1)):
        y = at(least, tick)[1]
        parts.append(f'<line class="faint" x1="{left}" x2="{right}" y1="{y}" y2="{y}"/>')
        parts.append(f'<text x="{left - 5}" y="{y + 5}" text-anchor="end">{round(tick, 6):.4g}</text>')
    for x, label in ticks.items():
        parts.append(f'<text x="{at(x, low)[0]}" y="{top + HIGH + 20}" text-anchor="middle">{label}</text>')
    return at, parts


def line(points: list[tuple[float, float]], colour: str, dashed: bool = False) -> list[str]:
    """Dots, joined."""
    joined, dashes = " ".join(f"{x},{y}" for x, y in points), ' stroke-dasharray="5 4"' if dashed else ""
    dots = [f'<circle fill="{colour}" cx="{x}" cy="{y}" r="4"/>' for x, y in points]
    return [f'<polyline fill="none" stroke="{colour}" stroke-width="2.5"{dashes} points="{joined}"/>', *dots]


def with_legend(parts: list[str], labels: Iterable[str], top: float) -> str:
    """The figure, with a line of the legend for each label in two columns below."""
    for index, (colour, label) in enumerate(zip(LINES, labels, strict=False)):
        x, y = 12 + 315 * (index % 2), top + 22 * (index // 2)
        parts.append(f'<line stroke="{colour}" stroke-width="4" x1="{x}" x2="{x + 26}" y1="{y - 5}" y2="{y - 5}"/>')
        parts.append(f'<text x="{x + 34}" y="{y}">{label}</text>')
    return svg(y + 12, parts)


def curves(
    labels: Labels, metrics: tuple[str, ...] = ("psnr",), scenes: tuple[str, ...] = CURVES, columns: int = 3
) -> str:
    """Metrics over numbers of splats on captures: a panel each, a line for each label's run and rule."""
    parts, wide = [], 3 * PANEL // columns
    for index, (metric, scene) in enumerate(product(metrics, scenes)):
        x, y = index % columns, index // columns
        lines = [
            [(one["splats"], one[metric]) for count in COUNTS for one in equal(scene, run, count, rule)]
            for run, rule in labels.values()
        ]
        box = wide * x + SIDE, (HIGH + 62) * y + 28, wide * (x + 1)
        ticks, title = {count: f"{count // 1000}k" for count in COUNTS}, "dB" if metric == "psnr" else "SSIM"
        at, drawn = axes(box, ticks, [value for points in lines for _, value in points], f"{scene}, {title}")
        for colour, points in zip(LINES, lines, strict=False):
            drawn += line([at(*point) for point in points], colour)
        parts += drawn
    return with_legend(parts, labels, (HIGH + 62) * (y + 1) + 12)


def seconds() -> str:
    """PSNR over seconds of `bonsai`'s trainings, alone on a GPU: before growth by error, and today's, filled."""
    rows = {run: bench_rows("speed")["bonsai", "own", run] for run in RUNS}
    dots = {run: (median(row.values["time s"].values()), mean_of(row, "PSNR")) for run, row in rows.items()}
    one = records("trials")["one host: nrfgs/bonsai-42"]
    dots["today's nrfgs"] = one["seconds"], one["psnr"]
    ticks = {time: f"{time} s" for time in (15, 30, 60, 120, 300)}
    at, parts = axes((45, 28, WIDTH - 30), ticks, [value for _, value in dots.values()], "dB")
    for label, (time, value) in dots.items():
        (x, y), filled = at(time, value), 1 if label not in RUNS else 0.3
        beside, anchor = (-10, "end") if time > 150 else (10, "start")
        parts.append(f'<circle class="better" fill-opacity="{filled}" cx="{x}" cy="{y}" r="6"/>')
        parts.append(f'<text x="{x + beside}" y="{y + 5}" text-anchor="{anchor}">{label}</text>')
    return svg(HIGH + 60, parts)


def files() -> str:
    """What files of a model lose over their size: a line of fine-tunes for each capture, a square without one."""
    places = {
        scene: {name: (one["bytes"] / 1e6, -one["loss_db"]) for name, one in reports(scene).items() if "loss_db" in one}
        for scene in ("bonsai", "goldcape", "fox")
    }
    tuned = {scene: [p for name, p in of.items() if name.startswith("rate")] for scene, of in places.items()}
    ticks = {size: f"{size} MB" for size in (0.5, 1, 2, 4, 8)}
    losses = [loss for points in tuned.values() for _, loss in points]
    at, parts = axes((55, 28, WIDTH - 50), ticks, losses, "dB against the model")
    for colour, (scene, points) in zip(LINES, tuned.items(), strict=False):
        parts += line([at(*point) for point in points], colour)
        x, y = at(*places[scene]["version-2"])
        parts.append(f'<rect fill="{colour}" x="{x - 5}" y="{y - 5}" width="10" height="10"/>')
    return with_legend(parts, tuned, HIGH + 75)


def fitted() -> str:
    """PSNR of fitted colours over parameters, from 15 to 40 dB: training directions, and dashed ones held out."""
    parts, runs = [], records("express")["summary"]["sweep"]
    for side, (setup, title) in enumerate({"synthetic": "synthetic, dB", "pixels": "measured, dB"}.items()):
        sweeps = [[one for one in runs if (one["setup"], one["model"]) == (setup, model)] for model in FITTED]
        lines = [
            [sorted((r["parameters"], r[kind]["mean"]) for r in sweep if 15 < r[kind]["mean"] < 40) for sweep in sweeps]
            for kind in ("train_psnr", "held_out_psnr")
        ]
        values = [value for of in lines for points in of for _, value in points]
        ticks = {1000: "1k", 4000: "4k", 16_000: "16k", 40_000: "40k"}
        at, drawn = axes((320 * side + SIDE, 28, 320 * side + 310), ticks, values, title)
        for dashed, of in enumerate(lines):
            for colour, points in zip(LINES, of, strict=False):
                drawn += line([at(*point) for point in points], colour, bool(dashed))
        parts += drawn
    return with_legend(parts, FITTED.values(), HIGH + 75)


FIGURES = {
    "views.svg": views,
    "seconds.svg": seconds,
    "files.svg": files,
    "fitted.svg": fitted,
    "heads.svg": partial(curves, HEADS_OF),
    "rules.svg": partial(curves, RULES_OF, ("psnr", "ssim"), (*CURVES, "castle"), columns=2),
    "seats.svg": partial(curves, SEATS_OF),
}

if __name__ == "__main__":
    for name, draw in FIGURES.items():
        write_whole(ROOT / "docs" / "images" / name, draw())
