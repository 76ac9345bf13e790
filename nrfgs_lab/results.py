# SPDX-License-Identifier: Apache-2.0
"""A study's records in one file of results/.

    python -m nrfgs_lab.results pack OUT results/NAME.json       # all records and tables of a study's folder
    python -m nrfgs_lab.results unpack results/NAME.json OUT     # the folder again: `nrfgs bench` reports from it

{"study": NAME, "records": {path without .json: record}, "texts": {path: lines}}, a line for each record. Numbers have
seven significant digits, like float32, and numbers of splats are those of every 500 steps. Left out are figures, and
each image's values but for `OF_IMAGES` of the test images.
"""

import json
from pathlib import Path
from typing import Any

import tyro

from nrfgs_ns.files import write_whole

TEXTS = ".md", ".yaml"
"""Endings of text files."""
OF_IMAGES = "image", "psnr", "ssim", "ms_ssim", "flip"
"""The values that are kept of each test image; means have all metrics."""


def slim(record: Any) -> Any:
    """A run's record with fewer values of each image and fewer numbers of splats."""
    if not (isinstance(record, dict) and isinstance(record.get("train"), dict)):
        return record
    train, record = record["train"], dict(record)
    if len(splats := train.get("splats") or []) > 1:
        kept = [pair for pair in splats[:-1] if pair[0] % 500 == 0]
        record["train"] = {**train, "splats": [*kept, splats[-1]]}
    if measured := record.get("measured"):
        test, train = measured["test"], measured["train"] or {}
        images = [{name: image[name] for name in OF_IMAGES if name in image} for image in test["per_image"]]
        train = {name: value for name, value in train.items() if name != "per_image"} or None
        record["measured"] = {**measured, "test": {**test, "per_image": images}, "train": train}
    if {"eval", "measured"} <= record.keys():
        record["eval"] = {name: value for name, value in record["eval"].items() if name != "per_image"}
    return record


def pack(folder: Path, file: Path) -> None:
    """Write all records and tables of a folder into a file."""
    records, texts = {}, {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder)
        if path.suffix == ".json":
            records[name.with_suffix("").as_posix()] = slim(json.loads(path.read_text(encoding="utf-8")))
        elif path.suffix in TEXTS:
            texts[name.as_posix()] = path.read_text(encoding="utf-8").splitlines()
    write(file, records, texts)


def write(file: Path, records: dict[str, Any], texts: dict[str, list[str]] | None = None) -> None:
    """Write a study's file, named after the study."""

    def line(name: str) -> str:
        rounded = json.loads(json.dumps(records[name]), parse_float=lambda digits: float(f"{float(digits):.7g}"))
        return f"  {json.dumps(name)}: {json.dumps(rounded, separators=(',', ':'))}"

    parts = [f'"study": {json.dumps(file.stem)}', '"records": {\n' + ",\n".join(map(line, records)) + "\n }"]
    parts += [f'"texts": {json.dumps(texts, indent=1, ensure_ascii=False)}'] if texts else []
    write_whole(file, "{" + ",\n ".join(parts) + "}\n")


def unpack(file: Path, folder: Path) -> None:
    """Write the folder of a study's file."""
    content = json.loads(file.read_text(encoding="utf-8"))
    for name, record in content["records"].items():
        write_whole(folder / f"{name}.json", json.dumps(record, indent=1) + "\n")
    for name, lines in content.get("texts", {}).items():
        write_whole(folder / name, "\n".join(lines) + "\n")


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict({"pack": pack, "unpack": unpack}, config=(tyro.conf.PositionalRequiredArgs,))
