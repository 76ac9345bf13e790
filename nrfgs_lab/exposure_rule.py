# SPDX-License-Identifier: Apache-2.0
"""Whether trainings on some captures would learn their photographs' exposure, and why; nothing is trained.

python -m nrfgs_lab.exposure_rule SCENES/bonsai SCENES/fox
"""

import sys
from pathlib import Path

from nrfgs_ns.data.datamanager import NrfgsDatamanagerConfig
from nrfgs_ns.data.dataparser import NrfgsDataParserConfig
from nrfgs_ns.model.model import NrfgsModelConfig
from nrfgs_ns.training.photographs import photograph_model


def main(folders: list[str]) -> None:
    for folder in folders:
        data = NrfgsDatamanagerConfig(dataparser=NrfgsDataParserConfig(data=Path(folder))).setup(device="cpu")
        print(f"{Path(folder).name}:", flush=True)
        photograph_model(NrfgsModelConfig(), data)


if __name__ == "__main__":
    main(sys.argv[1:])
