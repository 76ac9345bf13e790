# SPDX-License-Identifier: Apache-2.0
"""The trade of speed and size for accuracy: each setting of a plan with knobs against the default.

**Noise.** The spread over seeds is pooled over all settings of a scene, s^2 = sum (n_i - 1) s_i^2 / sum (n_i - 1). A
difference of means over n and m seeds is noise unless it exceeds

    t s sqrt(1 / n + 1 / m),    t = the 97.5 % quantile of Student's t with sum (n_i - 1) degrees of freedom.

Costs (time, frames, bytes) are compared as ratios, by their logarithms. Without a second seed everything is noise.

**Price.** dB of PSNR for each doubling of a cost, (PSNR - PSNR_0) / log2(cost / cost_0), where both go up or both go
down; otherwise a setting is better, worse, or within the noise.
"""

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from nrfgs_lab.bench.spec import DEFAULT
from nrfgs_lab.bench.table import BY_NAME, Column, Row, grid, notes, plain_markdown
from nrfgs_ns.files import whole, write_whole

LEVEL = 0.975
PSNR = BY_NAME["PSNR"]
COSTS = {"training time": ("time s", 1), "time for a frame": ("FPS", -1), "bytes": ("MB", 1)}
"""Cost -> column, and the power of the column that is the cost."""
RATIOS = ("time s", "FPS", "MB", "peak MB", "splats")
SHOWN = ("PSNR", "SSIM", "LPIPS", *RATIOS)
HEAD = ["", "seeds", "PSNR", "SSIM", "LPIPS", "training time", "FPS", "MB", "peak memory", "splats"]
LEGEND = (
    "Changes are against the default; times, frames, bytes, memory and splats as factors. (Round brackets): within the "
    "noise, estimated from the spread over seeds, pooled over all settings of the scene, at 95 %; one comparison in "
    "twenty is wrong. [Square brackets]: too few seeds to tell.",
    "dB per doubling: what PSNR a doubling of that cost buys, or a halving loses. Unclear: not distinguishable from "
    "the default. ★: on the Pareto front of the means, which ignores noise.",
)


@dataclass(frozen=True)
class Change:
    """The change of one quantity against the default."""

    value: float  # difference, or ratio where `is_ratio`
    noise: float  # largest difference, or ratio, that is noise; infinite if the spread is unknown
    is_ratio: bool = False

    @property
    def is_noise(self) -> bool:
        if self.is_ratio:
            return abs(math.log(self.value)) <= math.log(self.noise)
        return abs(self.value) <= self.noise


def pooled_deviation(samples: Sequence[Sequence[float]]) -> tuple[float | None, int]:
    """Pooled deviation of all samples, and its degrees of freedom; None and 0 if no sample has two values."""
    several = [sample for sample in samples if len(sample) > 1]
    freedom = sum(len(sample) - 1 for sample in several)
    if freedom == 0:
        return None, 0
    return math.sqrt(sum((len(sample) - 1) * statistics.variance(sample) for sample in several) / freedom), freedom


def noise_bound(deviation: float | None, freedom: int, n: int, m: int) -> float:
    """Largest difference of means over n and m values that is noise."""
    if deviation is None:
        return math.inf
    from scipy.stats import t

    return float(t.ppf(LEVEL, freedom)) * deviation * math.sqrt(1.0 / n + 1.0 / m)


def changes(rows: Sequence[Row], default: Row, column: Column, ratio: bool) -> dict[str, Change]:
    """Change of a column against the default by run, of a scene's rows with values in it; `ratio`: of positive ones."""
    samples = {row.run: list(row.values[column.name].values()) for row in rows}
    if ratio:
        samples = {run: [math.log(value) for value in values if value > 0] for run, values in samples.items()}
    deviation, freedom = pooled_deviation(list(samples.values()))
    base = samples[default.run]
    result = {}
    for name, sample in samples.items():
        if not sample or not base:
            continue
        difference = statistics.fmean(sample) - statistics.fmean(base)
        bound = noise_bound(deviation, freedom, len(sample), len(base))
        result[name] = Change(math.exp(difference), math.exp(bound), True) if ratio else Change(difference, bound)
    return result


def price(gain: Change | None, cost: Change | None, power: int = 1) -> str:
    """What a setting buys, from changes of PSNR and of the cost's column, a ratio, whose `power` is the cost: dB for
    each doubling of the cost, or in words what else it is."""
    if gain is None or cost is None:
        return "-"
    if gain.is_noise:
        return "unclear" if cost.is_noise else "PSNR unclear"
    if cost.is_noise:
        return f"{'gain' if gain.value > 0 else 'loss'}, cost unclear"
    doublings = power * math.log2(cost.value)
    if (gain.value > 0) == (doublings > 0):
        return f"{gain.value / doublings:.2f}"
    return "better and cheaper" if gain.value > 0 else "worse and more expensive"


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Indices of the points (cost, quality) on the Pareto front, by rising cost; equal points are both on it."""
    order = sorted(range(len(points)), key=lambda i: (points[i][0], -points[i][1]))
    front: list[int] = []
    for i in order:
        if not front or points[i][1] > points[front[-1]][1] or points[i] == points[front[-1]]:
            front.append(i)
    return front


def front_of(rows: Sequence[Row], cost: str) -> list[str]:
    """Runs on the front of PSNR against a cost, by rising cost."""
    column, power = COSTS[cost]
    points = {row.run: (row.mean(BY_NAME[column]), row.mean(PSNR)) for row in rows}
    known = {name: (paid**power, quality) for name, (paid, quality) in points.items() if None not in (paid, quality)}
    return [list(known)[i] for i in pareto_front(list(known.values()))]


def report(rows: list[Row], knobs: dict[str, str], out: Path) -> None:
    """Write OUT/tradeoff.{md,png} and print the table: rows with averages over scenes, and the knob of each run."""
    texts = []
    for scene in dict.fromkeys(row.scene for row in rows):
        of_scene = [row for row in rows if row.scene == scene]
        default = next((row for row in of_scene if row.run == DEFAULT), None)
        if default is not None:
            texts.append(f"### {plain_markdown(scene)}\n\n{table(of_scene, default)}")
    text = "\n".join([*texts, *(f"{note}\n" for note in [*LEGEND, *notes(rows)])])
    write_whole(out / "tradeoff.md", text)
    if any(row.records for row in rows):
        draw(rows, knobs, out / "tradeoff.png")
    print(text)
    print(f"Trade: {out / 'tradeoff.md'}, {out / 'tradeoff.png'}")


def table(rows: list[Row], default: Row) -> str:
    """Markdown table of one scene: the default in absolute numbers, the settings as changes."""
    changed = {name: changes(rows, default, BY_NAME[name], name in RATIOS) for name in SHOWN}
    fronts = {cost: front_of(rows, cost) for cost in COSTS}
    lines = []
    for row in rows:
        if row is default:
            cells = [row.text(BY_NAME[name]) for name in SHOWN]
            prices = [""] * len(COSTS)
        else:
            cells = [change_text(changed[name].get(row.run), name) for name in SHOWN]
            gain = changed["PSNR"].get(row.run)
            prices = [price(gain, changed[column].get(row.run), power) for column, power in COSTS.values()]
        stars = [" ★" if row.run in front else "" for front in fronts.values()]
        prices = [(text + star).strip() for text, star in zip(prices, stars, strict=True)]
        name = plain_markdown(row.run)
        lines.append([f"**{name}**" if row is default else name, row.seeds, *cells, *prices])
    return grid([*HEAD, *(f"dB per doubling of {cost}" for cost in COSTS)], lines, 2) + "\n"


def change_text(change: Change | None, name: str) -> str:
    """A change in a cell of the table."""
    if change is None:
        return "-"
    value = change.value
    text = f"x {value:.2f}" if name in RATIOS else f"{value:+.2f}" if name == "PSNR" else f"{value:+.4f}"
    if not change.is_noise:
        return text
    return f"[{text}]" if change.noise == math.inf else f"({text})"


def draw(rows: list[Row], knobs: dict[str, str], path: Path) -> None:
    """PSNR against each cost, a line of panels for each scene; the front as a staircase, with names."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    scenes, names = (list(dict.fromkeys(values)) for values in ((row.scene for row in rows), knobs.values()))
    # A `$` in a name begins no formula.
    with pyplot.rc_context({"font.size": 8, "text.parse_math": False}):
        size = 4.2 * len(COSTS), 3.2 * len(scenes) + 0.5
        figure, panels = pyplot.subplots(
            len(scenes), len(COSTS), figsize=size, dpi=110, squeeze=False, layout="constrained"
        )
        handles = {}
        for line, scene in zip(panels, scenes, strict=True):
            for panel, (cost, (column, _)) in zip(line, COSTS.items(), strict=True):
                of_scene = [row for row in rows if row.scene == scene]
                points = {row.run: (row.mean(BY_NAME[column]), row.mean(PSNR)) for row in of_scene}
                for row in of_scene:
                    if None not in points[row.run]:
                        number = names.index(knobs[row.run])
                        x_error, y_error = (row.deviation(one) or 0.0 for one in (BY_NAME[column], PSNR))
                        style = {"color": f"C{number % 10}", "marker": "*osD^v<>phX"[number % 11], "elinewidth": 0.6}
                        handles[knobs[row.run]] = panel.errorbar(
                            *points[row.run], y_error, x_error, linestyle="none", **style
                        )
                front = front_of(of_scene, cost)
                xs, ys = ([points[run][axis] for run in front] for axis in (0, 1))
                panel.step(xs, ys, where="post", color="grey")
                for run in front:
                    panel.annotate(run, points[run], (3, 4), textcoords="offset points", fontsize=6)
                panel.set(title=scene, xlabel=column, ylabel="PSNR", xscale="log")
                panel.grid(alpha=0.3, which="both", linewidth=0.4)
        figure.legend(list(handles.values()), list(handles), loc="outside lower center", ncols=8, fontsize=7)
        with whole(path) as aside:
            figure.savefig(aside, format="png", metadata={"Software": None})
        pyplot.close(figure)
