# SPDX-License-Identifier: Apache-2.0
"""The table and the figure of docs/compact-format.md.

    python -m nrfgs_lab.pages.tables.compact_format        # writes docs/images/compact-trade.png

results/compact.json has the reports of `nrfgs export compact`: SCENE-version-1 of a writer of that format,
SCENE-version-2 without a fine-tune, and SCENE-rate-RATE with one; SCENE-rate-RATE-STEPS with more steps than the
others. Those of the captures, and SCENE-first-rate-RATE, are of the fine-tune's first settings.
"""

from typing import Any

from nrfgs_lab.pages.tables import ROOT, grid, records, signed
from nrfgs_ns.files import whole

CAPTURES = "bonsai", "goldcape", "fox"


def reports(scene: str) -> list[tuple[str, dict[str, Any]]]:
    """What a table names them, and the reports of a scene, the largest file first."""
    found = {name.removeprefix(f"{scene}-"): one for name, one in records("compact").items() if name.startswith(scene)}
    labelled = [(name.replace("version-", "version ").replace("rate-", "rate "), one) for name, one in found.items()]
    return sorted(labelled, key=lambda pair: -pair[1]["bytes"])


def captures() -> str:
    """A row for each file of the captures."""
    rows = []
    for scene in CAPTURES:
        for number, (label, one) in enumerate(reports(scene)):
            if number == 0:
                ply = f"{248 * one['splats'] / 1e6:.1f}"
                rows.append([scene, "3DGS's PLY", f"{one['splats']:,}", ply, "", "", "", ""])
            seconds, small = one["seconds"], one["bytes"] < 1e6
            measured = one["psnr_file"] is not None
            rows.append(
                [
                    "",
                    label.replace("-4000", ", 4,000 steps"),
                    f"{one['written']:,}",
                    f"{one['bytes'] / 1e6:.3f}" if small else f"{one['bytes'] / 1e6:.2f}",
                    f"{one['psnr_file']:.2f}" if measured else "",
                    signed(-one["loss_db"], 2) if measured else "",
                    f"{seconds['finetune']:.0f}" if one["finetune"] else "",
                    ", ".join(f"{seconds[name]:.1f}" for name in ("encode", "decode") if seconds[name] is not None),
                ]
            )
    head = ["", "", "splats", "MB", "PSNR", "against the model", "seconds of training", "of encoding, decoding"]
    return grid(head, rows)


def file(name: str, what: str) -> str:
    """A number of a file: MB, KB, PSNR, or dB that it loses."""
    one = records("compact")[name]
    return {
        "MB": f"{one['bytes'] / 1e6:.2f}",
        "KB": f"{one['bytes'] / 1e3:.0f}",
        "PSNR": f"{one['psnr_file']:.2f}",
        "loss": f"{one['loss_db']:.2f}",
    }[what]


def draw() -> None:
    """The figure: a line of fine-tunes for each scene, and what is written without one."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.ticker import LogLocator, NullFormatter

    with pyplot.rc_context({"font.size": 8}):
        figure, panel = pyplot.subplots(figsize=(5.6, 3.4), dpi=110)
        for number, scene in enumerate(CAPTURES):
            every = reports(scene)
            every = [(label, one) for label, one in every if one["loss_db"] is not None and one["rate"] != 0.01]
            tuned = [one for label, one in every if label.startswith("rate") and "-" not in label]
            color = f"C{number}"
            for ones, style in ((tuned, "o-"), ([one for label, one in every if label == "version 2"], "s")):
                x, y = [one["bytes"] / 1e6 for one in ones], [-one["loss_db"] for one in ones]
                panel.plot(x, y, style, color=color, markersize=4, label=scene if style == "o-" else None)
            for label, one in every:
                if label.startswith("rate") and "-" not in label:
                    place = one["bytes"] / 1e6, -one["loss_db"]
                    text = label.removeprefix("rate ")
                    panel.annotate(text, place, (4, -8), textcoords="offset points", fontsize=6, color=color)
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
