# SPDX-License-Identifier: Apache-2.0
"""The table and the figure of docs/compact-format.md.

    python -m nrfgs_lab.pages.tables.compact_format        # writes docs/images/compact-trade.png

results/compact.json has the reports of `nrfgs export compact`: SCENE-version-1 of the writer of that format,
SCENE-version-2 without, and SCENE-rate-RATE with a fine-tune.
"""

from typing import Any

from nrfgs_lab.pages.tables import ROOT, grid, records, signed
from nrfgs_ns.files import whole

SCENES = "bonsai", "goldcape", "fox"


def reports(scene: str) -> list[tuple[str, dict[str, Any]]]:
    """What a table names them, and the reports of a scene, the largest file first."""
    found = {name.removeprefix(f"{scene}-"): one for name, one in records("compact").items() if name.startswith(scene)}
    labelled = [(name.replace("version-", "version ").replace("rate-", "rate "), one) for name, one in found.items()]
    return sorted(labelled, key=lambda pair: -pair[1]["bytes"])


def trade() -> str:
    """Bytes and dB of every file."""
    rows = []
    for scene in SCENES:
        for number, (label, one) in enumerate(reports(scene)):
            if number == 0:
                ply = f"{248 * one['splats'] / 1e6:.1f}"
                rows.append([scene, "3DGS's PLY of as many splats", f"{one['splats']:,}", ply, "", "", "", ""])
            seconds = one["seconds"]
            rows.append(
                [
                    "",
                    label,
                    f"{one['written']:,}",
                    f"{one['bytes'] / 1e6:.2f}",
                    f"{one['psnr_file']:.2f}",
                    signed(-one["loss_db"], 2),
                    f"{seconds['finetune']:.0f}" if one["finetune"] else "",
                    f"{seconds['encode']:.1f}, {seconds['decode']:.1f}",
                ]
            )
    head = ["", "", "splats", "MB", "PSNR", "against the model", "seconds of training", "of encoding, decoding"]
    return grid(head, rows)


def bonsai(rate: str, what: str) -> str:
    """A number of bonsai's file at a rate: MB, or dB that it loses."""
    one = records("compact")[f"bonsai-rate-{rate}"]
    return f"{one['bytes'] / 1e6:.2f}" if what == "MB" else f"{one['loss_db']:.2f}"


def draw() -> None:
    """The figure: a line of fine-tunes for each scene, and what is written without one."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    with pyplot.rc_context({"font.size": 8}):
        figure, panel = pyplot.subplots(figsize=(5.6, 3.4), dpi=110)
        for number, scene in enumerate(SCENES):
            every = reports(scene)
            tuned = [one for label, one in every if "rate" in label]
            color = f"C{number}"
            for ones, style in ((tuned, "o-"), ([one for label, one in every if label == "version 2"], "s")):
                x, y = [one["bytes"] / 1e6 for one in ones], [-one["loss_db"] for one in ones]
                panel.plot(x, y, style, color=color, markersize=4, label=scene if style == "o-" else None)
            for label, one in every:
                if "rate" in label:
                    place = one["bytes"] / 1e6, -one["loss_db"]
                    text = label.removeprefix("rate ")
                    panel.annotate(text, place, (4, -8), textcoords="offset points", fontsize=6, color=color)
        panel.axhline(0.0, color="grey", linewidth=0.6)
        panel.set(xlabel="MB (squares: not trained for the file)", ylabel="dB against the model", xscale="log")
        panel.xaxis.set_major_formatter("{x:g}")
        panel.grid(alpha=0.3, which="both", linewidth=0.4)
        panel.legend(loc="lower right")
        figure.tight_layout()
        with whole(ROOT / "docs" / "images" / "compact-trade.png") as aside:
            figure.savefig(aside, format="png", metadata={"Software": None})
        pyplot.close(figure)


if __name__ == "__main__":
    draw()
