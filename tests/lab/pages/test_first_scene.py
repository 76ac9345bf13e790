# SPDX-License-Identifier: Apache-2.0
"""docs/first-scene.md shows the commands that were run, and its pictures are there."""

import json
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
DOCS = ROOT / "docs"


def test_the_page_has_the_commands_that_were_run():
    page = (DOCS / "first-scene.md").read_text(encoding="utf-8")
    shown = " ".join(re.sub(r" +#.*", "", page).replace("\\\n", " ").split())
    record = json.loads((ROOT / "results" / "newcomer.json").read_text(encoding="utf-8"))["records"]["newcomer"]
    assert [step["step"] for step in record["commands"]] == ["prepare", "train", "look", "eval", "export"]
    for step in record["commands"]:
        assert re.sub(r"\d{4}-\d\d-\d\d_\d{6}", "DATE", step["command"]) in shown
    assert f"{record['eval']['psnr']:.2f}" in page and f"{record['export']['loss_db']:.2f}" in page
    pictures = re.findall(r"\]\((images/\S+)\)", page)
    assert len(pictures) == 3 and all((DOCS / picture).is_file() for picture in pictures)
