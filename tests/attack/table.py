# SPDX-License-Identifier: Apache-2.0
"""`python tests/attack/table.py [--examples N] [--record FILE NAME]`: attack, and print what came of it, as a table.

Every module area_*.py beside this one is an area: AREA (its name), CASES (a list of Case), and inputs(), a hypothesis
strategy of further ones. The installed `nrfgs_ns` is attacked, or another in PYTHONPATH.
"""

import argparse
import importlib
import json
import sys
from collections import Counter
from pathlib import Path

HERE = Path(__file__).resolve().parent
for folder in (HERE, HERE.parent / "helpers"):
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))

from attempt import Case, Outcome, attempts  # noqa: E402
from hypothesis import HealthCheck, Phase, given, settings  # noqa: E402

COLUMNS = {
    "tried": (),
    "one clear sentence": ("refused",),
    "used": ("read",),
    "traceback": ("traceback", "unclear"),
    "silent wrong": ("silent",),
    "hang, or too much": ("hang", "slow", "large", "wrote", "broken case"),
}
"""Of the table, and the outcomes that each counts."""


def areas() -> list:
    """The modules of all areas."""
    return [importlib.import_module(path.stem) for path in sorted(HERE.glob("area_*.py"))]


def drawn(area, count: int) -> list[Case]:
    """Further inputs of an area, the same ones each time."""
    cases: list[Case] = []

    @settings(
        max_examples=count, derandomize=True, database=None, deadline=None, phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(area.inputs())
    def collect(case: Case) -> None:
        cases.append(case)

    if count:
        collect()
    return cases


def table(found: dict[str, list[tuple[str, Outcome]]]) -> str:
    """Markdown: a row for each area, and their sum."""
    rows = [["area", *COLUMNS]]
    total: Counter = Counter()
    for area, outcomes in found.items():
        kinds = Counter(outcome.kind for _, outcome in outcomes)
        numbers = Counter({column: sum(kinds[kind] for kind in counted) for column, counted in COLUMNS.items()})
        numbers["tried"] = len(outcomes)
        total += numbers
        rows.append([area, *(str(numbers[column]) for column in COLUMNS)])
    rows.append(["all", *(str(total[column]) for column in COLUMNS)])
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([lines[0], "|---" + "|---:" * len(COLUMNS) + "|", *lines[1:]]) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--examples", type=int, default=100, help="random inputs in each area, beside the list")
    parser.add_argument("--record", nargs=2, help="a JSON file, and the name of the entry in it that is written")
    parser.add_argument("--area", help="this area alone")
    options = parser.parse_args()
    found: dict[str, list[tuple[str, Outcome]]] = {}
    for area in areas():
        if options.area not in (None, area.AREA):
            continue
        cases = [*area.CASES, *drawn(area, options.examples)]
        found[area.AREA] = [(case.name, outcome) for case, outcome in zip(cases, attempts(cases), strict=True)]
        for name, outcome in found[area.AREA]:
            if outcome.kind not in ("refused", "read"):
                print(f"{area.AREA}: {ascii(name)}: {outcome.kind}: {ascii(outcome.said[:300])}", file=sys.stderr)
    print(table(found))
    if options.record:
        areas_held = {
            area: {
                "did not hold": [[n, o.kind, o.said[:200]] for n, o in outcomes if o.kind not in ("refused", "read")]
            }
            for area, outcomes in found.items()
        }
        path = Path(options.record[0])
        whole = json.loads(path.read_text()) if path.exists() else {}
        whole[options.record[1]] = {"examples": options.examples, "table": table(found), "areas": areas_held}
        path.write_text(json.dumps(whole, indent=1) + "\n")


if __name__ == "__main__":
    main()
