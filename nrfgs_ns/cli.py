# SPDX-License-Identifier: Apache-2.0
"""NRF-GS for nerfstudio: what this project adds beside ns-train, ns-eval, ns-viewer and ns-render."""

import sys

import tyro

from nrfgs_ns.demo import Demo
from nrfgs_ns.errors import InputError


def entrypoint() -> None:
    """The console script `nrfgs VERB`."""
    verb = tyro.extras.subcommand_cli_from_dict({"demo": Demo}, description=__doc__)
    try:
        verb.main()
    except InputError as error:
        sys.exit(f"nrfgs: {error}")


if __name__ == "__main__":
    entrypoint()
