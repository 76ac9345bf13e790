# SPDX-License-Identifier: Apache-2.0
"""Blocks of docs/compact-format.md, docs/export.md and docs/web.md: what files of a model cost and lose.

python -m nrfgs_lab.pages.files        # writes docs/images/compact-trade.png
"""

from typing import Any

from nrfgs_lab.pages.few_views import SHRUNK, runs_of
from nrfgs_lab.pages.runs import ROOT, grid, mean, records
from nrfgs_ns.files import whole

CAPTURES = "bonsai", "goldcape", "fox"
Report = dict[str, Any]


def reports(scene: str) -> dict[str, Report]:
    """The records of a scene's files, the largest file first."""
    every = {name.removeprefix(f"{scene}-"): one for name, one in records("compact").items() if name.startswith(scene)}
    return dict(sorted(((n, one) for n, one in every.items() if "bytes" in one), key=lambda pair: -pair[1]["bytes"]))


def draw() -> None:
    """The figure: a line of fine-tunes for each scene, and the file without one."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.ticker import LogLocator, NullFormatter

    with pyplot.rc_context({"font.size": 8}):
        figure, panel = pyplot.subplots(figsize=(5.6, 3.4), dpi=110)
        for number, scene in enumerate(CAPTURES):
            color, points = f"C{number}", {n: (r["bytes"] / 1e6, -r["loss_db"]) for n, r in reports(scene).items()}
            lines = {name: place for name, place in points.items() if name.startswith("rate")}  # fine-tuned
            panel.plot(*zip(*lines.values(), strict=True), "o-", color=color, markersize=4, label=scene)
            for name, place in lines.items():
                words = name.removeprefix("rate-")
                panel.annotate(words, place, (4, -8), textcoords="offset points", fontsize=6, color=color)
            panel.plot(*points["version-2"], "s", color=color, markersize=4)
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


# PLY files.


def plies() -> dict[str, Report]:
    """Capture -> the report of its PLY file."""
    return {scene: one for scene in ("bonsai", "caliterra", "fox", "goldcape") if (one := reports(scene).get("ply"))}


def losses() -> str:
    """Loss of a PLY file against each model; beside it, harmonics that were trained themselves."""
    body = []
    for scene, one in plies().items():
        cost = f"{one['splats']:,}", f"{one['bytes'] / 1e6:.1f}", f"{one['seconds']['fit']:.0f}"
        psnr = *(one[f"psnr_{part}"] for part in ("model", "file", "on_screen")), mean(runs_of(scene, SHRUNK), "psnr")
        body.append([scene, *cost, *map("{:.2f}".format, psnr)])
    return grid(["", "splats", "MB", "seconds", "model", "file", "in Spark", "harmonics, trained"], body)


BLOCKS = {
    "export.losses": losses,
    "export.worst": lambda: f"{max(one['loss_db'] for one in plies().values()):.1f}",
}

if __name__ == "__main__":
    draw()
