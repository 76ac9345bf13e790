# SPDX-License-Identifier: Apache-2.0
"""Whether trainings on some captures would learn their photographs' exposure, and why; nothing is trained.

python -m nrfgs_lab.exposure_rule results/exposure-rule.json SCENES/bonsai SCENES/fox
"""

import sys
from pathlib import Path

import torch

from nrfgs_lab.results import write
from nrfgs_ns.data.datamanager import NrfgsDatamanagerConfig
from nrfgs_ns.data.dataparser import NrfgsDataParserConfig
from nrfgs_ns.image.overlap import slope
from nrfgs_ns.training.photographs import evidence, verdict


def main(out: Path, folders: list[Path]) -> None:
    found = {}
    for folder in folders:
        data = NrfgsDatamanagerConfig(dataparser=NrfgsDataParserConfig(data=folder)).setup(device="cpu")
        told = evidence(data)
        known = told.known[torch.isfinite(told.known)]
        found[folder.name] = {
            "photographs": len(told.known),
            "pairs": len(told.pairs.first),
            "random": list(told.seen.random),
            "exif": float(known.std(correction=0)) if len(known) else None,
            "explained": slope(told.pairs, told.known)[1] if len(known) else None,
            "learnt": told.learnt_by_itself,
            "why": verdict("auto", told)[1],
        }
        print(f"{folder.name}: {found[folder.name]['why']}.", flush=True)
    write(out, found)


if __name__ == "__main__":
    main(Path(sys.argv[1]), list(map(Path, sys.argv[2:])))
