# SPDX-License-Identifier: Apache-2.0
"""`python tests/attack/table.py [--examples N] [--record FILE NAME]`: attack, and print what came of it, as a table.

Every module area_*.py beside this one is an area: AREA (its name), CASES (a list of Case), and inputs(), a hypothesis
strategy of further ones. The installed `nrfgs_ns` is attacked, or another in PYTHONPATH.
"""

import argparse
import importlib
import itertools
import json
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent / "helpers")]

from attempt import GOOD, Case, Outcome, attempts  # noqa: E402
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
    """Modules of all areas."""
    return [importlib.import_module(path.stem) for path in sorted(HERE.glob("area_*.py"))]


def drawn(area, count: int) -> list[Case]:
    """Further inputs of an area, the same ones each time."""
    cases: list[Case] = []
    options = {"database": None, "phases": [Phase.generate], "suppress_health_check": list(HealthCheck)}
    settings(max_examples=count, derandomize=True, deadline=None, **options)(
        given(area.inputs())(lambda case: cases.append(case))
    )()
    return cases


def table(found: dict[str, list[tuple[str, Outcome]]]) -> str:
    """Markdown: a row for each area, and their sum."""
    lines = ["| area | " + " | ".join(COLUMNS) + " |", "|---" + "|---:" * len(COLUMNS) + "|"]
    for area, outcomes in (found | {"all": list(itertools.chain(*found.values()))}).items():
        numbers = [sum(outcome.kind in kinds for _, outcome in outcomes) for kinds in COLUMNS.values()]
        lines.append("| " + " | ".join(map(str, (area, len(outcomes), *numbers[1:]))) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--examples", type=int, default=100, help="random inputs in each area, beside the list")
    parser.add_argument("--record", nargs=2, help="a JSON file, and the name of the entry in it that is written")
    options = parser.parse_args()
    found: dict[str, list[tuple[str, Outcome]]] = {}
    bad: dict[str, list[list[str]]] = {}
    for area in areas():
        cases = [*area.CASES, *drawn(area, options.examples)]
        found[area.AREA] = [(case.name, outcome) for case, outcome in zip(cases, attempts(cases), strict=True)]
        bad[area.AREA] = [[n, o.kind, o.said[:200]] for n, o in found[area.AREA] if o.kind not in GOOD]
        for failure in bad[area.AREA]:
            print(area.AREA, *map(ascii, failure), sep=": ", file=sys.stderr)
    print(table(found))
    if options.record:
        path = Path(options.record[0])
        whole = json.loads(path.read_text()) if path.exists() else {}
        failures = {area: {"did not hold": failures} for area, failures in bad.items()}
        whole[options.record[1]] = {"examples": options.examples, "table": table(found), "areas": failures}
        path.write_text(json.dumps(whole, indent=1) + "\n")


if __name__ == "__main__":
    main()
