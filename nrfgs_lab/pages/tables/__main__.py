# SPDX-License-Identifier: Apache-2.0
"""Checks or writes the numbers of the pages; see the package."""

import sys

from nrfgs_lab.pages.tables import ROOT, pages, written

stale = []
for page in pages():
    old = page.read_text(encoding="utf-8")
    new = written(old)
    if new != old:
        stale.append(page.relative_to(ROOT))
        if "--write" in sys.argv[1:]:
            page.write_text(new, encoding="utf-8")
            print(f"{stale[-1]} written")
        else:
            print(f"{stale[-1]} differs from the records: python -m nrfgs_lab.pages.tables --write")
sys.exit(1 if stale and "--write" not in sys.argv[1:] else 0)
