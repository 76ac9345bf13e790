# SPDX-License-Identifier: Apache-2.0
"""The figure of a trade: PSNR against each cost, with names that keep clear of each other and of the frame."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nrfgs_lab.bench.report import plain_label
from nrfgs_lab.bench.table import Row
from nrfgs_lab.tradeoff.analysis import COSTS, PSNR, Cost, front_of
from nrfgs_lab.tradeoff.plan import DEFAULT, Setting
from nrfgs_ns.files import whole

MARKERS = "*osD^v<>phX"
MARGIN = 0.12
"""Free space on each side of the points, as a share of their extent."""
DISTANCES = (4, 10, 17, 25, 34, 44)
"""How far a name may lie from its point, in points of type; the nearest that is free is taken."""
DIRECTIONS = 16
"""Ways around its point in which a name is tried, upper right first."""
MARKER, DEFAULT_MARKER, LINE = 4.0, 6.0, 0.75
"""Half the width that names leave free around a point, the default's, and the front's line, in points of type."""
Box = tuple[float, float, float, float]
"""Left, lower, right, upper, in pixels."""


def draw(rows: list[Row], settings: list[Setting], path: Path) -> None:
    """PSNR against each cost, a line of panels for each scene; the front as a staircase.

    The settings on the front have their names, and of the others those for which there is room. The legend has the
    settings in their order, without knobs that have no point.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.ticker import LogLocator, NullFormatter

    scenes = list(dict.fromkeys(row.scene for row in rows))
    knobs = list(dict.fromkeys(setting.knob for setting in settings))
    knob_of = {setting.name: setting.knob for setting in settings}
    with pyplot.rc_context({"font.size": 8}):
        size = (4.2 * len(COSTS), 3.2 * len(scenes) + 0.5)
        figure, panels = pyplot.subplots(len(scenes), len(COSTS), figsize=size, dpi=110, squeeze=False)
        shown: dict[str, Any] = {}
        for line, scene in zip(panels, scenes, strict=True):
            for panel, cost in zip(line, COSTS, strict=True):
                for number, knob in enumerate(knobs):
                    of_knob = [row for row in rows if row.scene == scene and knob_of[row.run] == knob]
                    points = [row for row in of_knob if is_point(row, cost)]
                    if points:
                        shown[knob] = _points(panel, points, cost, knob, number)
                panel.set(title=plain_label(scene), xlabel=cost.column.name, ylabel="PSNR", xscale="log")
                panel.margins(MARGIN)
                panel.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
                panel.xaxis.set_major_formatter("{x:g}")
                panel.xaxis.set_minor_formatter(NullFormatter())
                panel.grid(alpha=0.3, which="both", linewidth=0.4)
        labels = [knob for knob in knobs if knob in shown]
        handles = [shown[knob] for knob in labels]
        figure.legend(
            handles, list(map(plain_label, labels)), loc="lower center", ncols=min(max(len(labels), 1), 8), fontsize=7
        )
        figure.tight_layout(rect=(0, 0.5 / size[1] * (1 + len(labels) // 9), 1, 1))
        # Names are placed in pixels, which are known only now.
        for line, scene in zip(panels, scenes, strict=True):
            for panel, cost in zip(line, COSTS, strict=True):
                _front(panel, [row for row in rows if row.scene == scene and is_point(row, cost)], cost)
        with whole(path) as aside:
            figure.savefig(aside, format="png", metadata={"Software": None})
        pyplot.close(figure)


def is_point(row: Row, cost: Cost) -> bool:
    """Whether a row has both coordinates."""
    return row.mean(PSNR) is not None and row.mean(cost.column) is not None


def _points(panel, rows: list[Row], cost: Cost, knob: str, number: int):
    """A knob's settings, with their deviation over seeds; returns what stands for them in the legend."""
    return panel.errorbar(
        [row.mean(cost.column) for row in rows],
        [row.mean(PSNR) for row in rows],
        xerr=[row.deviation(cost.column) or 0.0 for row in rows],
        yerr=[row.deviation(PSNR) or 0.0 for row in rows],
        color="black" if knob == DEFAULT else f"C{(number - 1) % 10}",
        marker=MARKERS[number % len(MARKERS)],
        markersize=10 if knob == DEFAULT else 4,
        elinewidth=0.6,
        linestyle="none",
        zorder=3 if knob == DEFAULT else 2,
    )


def _front(panel, rows: list[Row], cost: Cost) -> None:
    """The front, and the names: those on the front first, wherever they disturb least; others where there is room."""
    from matplotlib import patheffects

    by_name = {row.run: row for row in rows}
    on_front = front_of(rows, cost)
    points = {name: (row.mean(cost.column), row.mean(PSNR)) for name, row in by_name.items()}
    steps = [points[name] for name in on_front]
    panel.step([x for x, _ in steps], [y for _, y in steps], where="post", color="grey", linewidth=0.8, zorder=1)
    pixels = {name: tuple(panel.transData.transform(point)) for name, point in points.items()}
    scale = panel.figure.dpi / 72
    taken = [_around([pixels[name]], (DEFAULT_MARKER if name == DEFAULT else MARKER) * scale) for name in points]
    corners = [pixels[on_front[0]]] if on_front else []
    for name in on_front[1:]:  # first along, then up or down, as the line goes
        corners += [(pixels[name][0], corners[-1][1]), pixels[name]]
    taken += [_around(ends, LINE * scale) for ends in zip(corners, corners[1:], strict=False)]
    halo = [patheffects.withStroke(linewidth=1.5, foreground="white")]
    for name in [*on_front, *(name for name in by_name if name not in on_front)]:
        text = panel.annotate(
            plain_label(name),
            points[name],
            textcoords="offset points",
            xytext=(0, 0),
            fontsize=6,
            color="black" if name in on_front else "dimgrey",
            path_effects=halo,
            arrowprops={"arrowstyle": "-", "color": "grey", "linewidth": 0.4, "shrinkA": 0, "shrinkB": 2},
        )
        extent = text.get_window_extent()
        cost_of_place, (x, y), box = best_place(
            pixels[name], (extent.width, extent.height), panel.bbox.extents, taken, scale
        )
        if cost_of_place > 0 and name not in on_front:
            text.remove()
            continue
        text.set_position((x, y))
        taken.append(box)


def best_place(
    point: tuple[float, float], size: tuple[float, float], frame: Box, taken: list[Box], scale: float
) -> tuple[float, tuple[float, float], Box]:
    """Where a name disturbs least: the nearest place inside the frame that touches nothing, if there is one.

    Args:
        point: what is named, in pixels.
        size: width and height of the name, in pixels.
        frame: the panel.
        taken: what must stay free.
        scale: pixels of a point of type.

    Returns:
        the area that overlaps what is taken or lies outside of the frame, pixels^2; the lower left corner of the name
        from the point, in points of type; the name's box.
    """
    best = None
    width, height = size
    for distance in DISTANCES:
        for k in range(DIRECTIONS):
            angle = math.pi / 4 + 2 * math.pi * k / DIRECTIONS
            cos, sin = math.cos(angle), math.sin(angle)
            # The name's middle moves around an ellipse, so that the gap to the point is the distance on all sides.
            x = cos * (distance * scale + width / 2) - width / 2
            y = sin * (distance * scale + height / 2) - height / 2
            box = (point[0] + x, point[1] + y, point[0] + x + width, point[1] + y + height)
            outside = width * height - _overlap(box, frame)
            # Beyond the frame a name runs into the next panel: worse than over a line of its own.
            disturbed = sum(_overlap(box, other) for other in taken) + 10 * outside
            if best is None or disturbed < best[0] - 1e-6:
                best = (max(disturbed, 0.0) if disturbed > 1e-6 else 0.0, (x / scale, y / scale), box)
        if best[0] == 0:
            break
    return best


def _around(points: Sequence[tuple[float, float]], half: float) -> Box:
    """The box around points, wider by a half width."""
    xs, ys = zip(*points, strict=True)
    return min(xs) - half, min(ys) - half, max(xs) + half, max(ys) + half


def _overlap(a: Box, b: Box) -> float:
    """Area that two boxes share."""
    width, height = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    return max(width, 0.0) * max(height, 0.0)
