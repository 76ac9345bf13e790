# SPDX-License-Identifier: Apache-2.0
"""The table and the figure of docs/compact-format.md, from the records of `nrfgs_lab.compact` in results/compact.json.

python -m nrfgs_lab.pages.tables.compact_format        # writes docs/images/compact-trade.png
"""

import re
from statistics import median
from typing import Any

from nrfgs_lab.pages.tables import ROOT, grid, records, signed
from nrfgs_ns.files import whole

CAPTURES = "bonsai", "goldcape", "fox"
ROWS = {
    "version-2": "not trained for the file",
    "rate-0.0001": "rate 0.0001",
    "rate-0.0003": "rate 0.0003",
    "rate-0.001": "rate 0.001",
    "ply": "[3DGS's PLY](export.md)",
}
"""Files that the table has; the figure and the records have more."""


def reports(scene: str) -> dict[str, dict[str, Any]]:
    """The records of a scene's files, the largest file first."""
    found = {name.removeprefix(f"{scene}-"): one for name, one in records("compact").items() if name.startswith(scene)}
    return dict(sorted(((n, one) for n, one in found.items() if "bytes" in one), key=lambda pair: -pair[1]["bytes"]))


def captures() -> str:
    """A row for each kind of file, a column for each capture: MB, and decibels against the model."""
    every = {scene: reports(scene) for scene in CAPTURES}

    def cell(one: dict[str, Any]) -> str:
        return f"{one['bytes'] / 1e6:.{1 if one['bytes'] > 1e7 else 2}f}, {signed(-one['loss_db'], 2)}"

    rows = [[label, *(cell(every[scene][name]) for scene in CAPTURES)] for name, label in ROWS.items()]
    return grid(["", *(f"{scene}, {every[scene]['version-2']['splats']:,} splats" for scene in CAPTURES)], rows)


def at(scene: str, what: str, value: str) -> str:
    """Decibels that so many MB lose, or MB of a file that loses so many dB: on straight lines between fine-tunes."""
    import numpy as np

    tuned = [one for name, one in reports(scene).items() if name.startswith("rate")]
    size, loss = [one["bytes"] / 1e6 for one in tuned], [one["loss_db"] for one in tuned]
    if what == "loss":
        return f"{np.interp(-float(value), [-x for x in size], loss):.2f}"
    return f"{np.interp(float(value), loss, size):.1f}"


def steps() -> str:
    """Of the captures' fine-tunes."""
    (found,) = {one["finetune"] for scene in CAPTURES for one in reports(scene).values() if one.get("finetune")}
    return f"{found:,}"


def added(scene: str) -> str:
    """Per cent of a training's seconds that the longest of its fine-tunes takes."""
    longest = max(one["seconds"]["finetune"] for one in reports(scene).values() if one.get("finetune"))
    return f"{100 * longest / records('compact')[f'{scene}-model']['train']['seconds']:.0f} %"


def worth() -> str:
    """Files with other weights of a splat's bytes in pruning, on held-out views: MB, and dB in the median view."""
    found: dict[str, dict[str, str]] = {}
    for name, one in records("compact").items():
        if match := re.fullmatch(r"held-out-(\w+)-rate-0.0003-WORTH=([\d.]+)", name):
            lost = median(view["psnr_file"] - view["psnr_model"] for view in one["per_image"])
            found.setdefault(match[1], {})[match[2]] = f"{one['bytes'] / 1e6:.2f}, {signed(lost, 2)}"
    weights = sorted({weight for one in found.values() for weight in one}, key=float)
    return grid(["", *found], [[weight, *(one.get(weight, "-") for one in found.values())] for weight in weights])


def file(name: str, what: str) -> str:
    """A number of a file: its MB, decibels that it loses, seconds to write it or to read it in Python or Chromium."""
    one = records("compact")[name]
    if what in ("MB", "loss"):
        return f"{one['bytes'] / 1e6 if what == 'MB' else one['loss_db']:.2f}"
    return f"{one['seconds'][what]:.1f}"


def draw() -> None:
    """The figure: a line of fine-tunes for each scene, and what is written without one."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.ticker import LogLocator, NullFormatter

    with pyplot.rc_context({"font.size": 8}):
        figure, panel = pyplot.subplots(figsize=(5.6, 3.4), dpi=110)
        for number, scene in enumerate(CAPTURES):
            every, color = reports(scene), f"C{number}"
            tuned = {name: one for name, one in every.items() if name.startswith("rate")}
            x, y = [one["bytes"] / 1e6 for one in tuned.values()], [-one["loss_db"] for one in tuned.values()]
            panel.plot(x, y, "o-", color=color, markersize=4, label=scene)
            for name, place in zip(tuned, zip(x, y, strict=True), strict=True):
                text = name.removeprefix("rate-")
                panel.annotate(text, place, (4, -8), textcoords="offset points", fontsize=6, color=color)
            plain = every["version-2"]
            panel.plot(plain["bytes"] / 1e6, -plain["loss_db"], "s", color=color, markersize=4)
        panel.axhline(0.0, color="grey", linewidth=0.6)
        panel.set(xlabel="MB (squares: not trained for the file)", ylabel="dB against the model", xscale="log")
        panel.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        panel.xaxis.set_major_formatter("{x:g}")
        panel.xaxis.set_minor_formatter(NullFormatter())
        panel.grid(alpha=0.3, which="both", linewidth=0.4)
        panel.legend(loc="lower right")
        figure.tight_layout()
        with whole(ROOT / "docs" / "images" / "compact-trade.png") as aside:
            figure.savefig(aside, format="png", metadata={"Software": None})
        pyplot.close(figure)


if __name__ == "__main__":
    draw()
