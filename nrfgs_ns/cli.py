# SPDX-License-Identifier: Apache-2.0
"""NRF-GS for nerfstudio: what this project adds beside ns-train, ns-eval, ns-viewer and ns-render."""

import sys
import warnings
from importlib.metadata import EntryPoint, entry_points

import tyro

from nrfgs_ns.errors import InputError

GROUP = "nrfgs.commands"
"""Of entry points: a command's name, and the dataclass that holds its options and has a `main`."""


def commands() -> dict[str, EntryPoint]:
    """The commands of `nrfgs` by name, whichever installed package they come from.

    Raises:
        InputError: there are none.
    """
    found = {one.name: one for one in sorted(entry_points(group=GROUP), key=lambda one: one.name)}
    if not found:
        raise InputError(f"no package offers commands (entry points {GROUP}). Install this one again: pip install -e .")
    return found


def chosen(arguments: list[str]):
    """The command that the arguments ask for, with its options. Of all commands that one alone is imported."""
    found = commands()
    if arguments and arguments[0] in found:
        name, *options = arguments
        return tyro.cli(found[name].load(), prog=f"nrfgs {name}", args=options)
    # No command, or none of these: tyro lists them.
    every = {name: one.load() for name, one in found.items()}
    return tyro.extras.subcommand_cli_from_dict(every, prog="nrfgs", description=__doc__, args=arguments)


def entrypoint() -> None:
    """The console script `nrfgs COMMAND`."""
    # Deprecations inside nerfstudio, and a loss that it logs undetached: not the reader's business.
    warnings.simplefilter("ignore", FutureWarning)
    warnings.filterwarnings("ignore", "Converting a tensor with requires_grad=True to a scalar")
    try:
        chosen(sys.argv[1:]).main()
    except (InputError, FileExistsError) as error:
        sys.exit(f"nrfgs: {error}")
    except KeyboardInterrupt:
        print("nrfgs: stopped", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    entrypoint()
