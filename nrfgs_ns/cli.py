# SPDX-License-Identifier: Apache-2.0
"""NRF-GS for nerfstudio: what this project adds beside ns-train, ns-eval, ns-viewer and ns-render."""

import sys
import warnings

import tyro

from nrfgs_ns.demo import Demo
from nrfgs_ns.errors import InputError
from nrfgs_ns.export import Export
from nrfgs_ns.prepare.verb import Prepare
from nrfgs_ns.studies.bench import Bench
from nrfgs_ns.studies.express.study import Express
from nrfgs_ns.studies.inspect.verb import Inspect
from nrfgs_ns.studies.tradeoff.verb import Tradeoff

VERBS = {
    "demo": Demo,
    "prepare": Prepare,
    "export": Export,
    "bench": Bench,
    "tradeoff": Tradeoff,
    "express": Express,
    "inspect": Inspect,
}
"""The verbs of `nrfgs`, and the dataclasses that hold their options."""


def entrypoint() -> None:
    """The console script `nrfgs VERB`."""
    # Deprecations inside nerfstudio, and a loss that it logs undetached: not the reader's business.
    warnings.simplefilter("ignore", FutureWarning)
    warnings.filterwarnings("ignore", "Converting a tensor with requires_grad=True to a scalar")
    verb = tyro.extras.subcommand_cli_from_dict(VERBS, description=__doc__)
    try:
        verb.main()
    except (InputError, FileExistsError) as error:
        sys.exit(f"nrfgs: {error}")
    except KeyboardInterrupt:
        print("nrfgs: stopped", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    entrypoint()
