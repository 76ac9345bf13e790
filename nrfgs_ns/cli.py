# SPDX-License-Identifier: Apache-2.0
"""`nrfgs COMMAND`: commands beside nerfstudio's ns-train, ns-eval, ns-viewer and ns-render.

A command is an entry point of the group `nrfgs.commands`: its name, and a dataclass of options with a `main`. Only the
command that runs is imported; the list reads the others' docstrings from their source.
"""

import ast
import difflib
import errno
import sys
import warnings
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path

import tyro

from nrfgs_ns.errors import DEBUG, InputError, mind_the_reader

GROUP = "nrfgs.commands"
NO_ROOM = errno.ENOSPC, errno.EDQUOT, errno.EFBIG  # a full disk, a quota, a limit on the size of files


def commands() -> dict[str, EntryPoint]:
    """The commands of all installed packages, by name."""
    return {entry.name: entry for entry in sorted(entry_points(group=GROUP), key=lambda entry: entry.name)}


def summary(command: EntryPoint) -> str:
    """The first sentence of a command's docstring, read from its source."""
    tree = ast.parse(Path(find_spec(command.module).origin).read_text(encoding="utf-8"))
    classes = {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}
    return " ".join(ast.get_docstring(classes[command.attr]).split()).split(". ")[0].removesuffix(".")


def listing() -> str:
    """The help of `nrfgs` itself."""
    lines = [f"  {name:<10}{summary(entry)}" for name, entry in commands().items()]
    lines = ["usage: nrfgs COMMAND [OPTIONS]", "", *lines, "", "`nrfgs COMMAND --help` explains a command's options."]
    return "\n".join(lines)


def chosen(arguments: list[str]):
    """The named command with its options; InputError for an unknown name."""
    name, *options = arguments or ["--help"]
    if name in ("--help", "-h"):
        print(listing())
        sys.exit()
    known = commands()
    if name not in known:
        close = difflib.get_close_matches(name, known, n=1)
        hint = f"Did you mean `nrfgs {close[0]}`?" if close else f"There are {', '.join(known)}."
        raise InputError(f"no command {name!r}. {hint}")
    return tyro.cli(known[name].load(), prog=f"nrfgs {name}", args=options)


def entrypoint() -> None:
    """The console script `nrfgs COMMAND`."""
    mind_the_reader()
    # Deprecations in nerfstudio, and a loss that it logs undetached, do not concern the user.
    warnings.simplefilter("ignore", FutureWarning)
    warnings.filterwarnings("ignore", "Converting a tensor with requires_grad=True to a scalar")
    try:
        chosen(sys.argv[1:]).main()
    except (InputError, OSError) as error:
        no_room = getattr(error, "errno", None) in NO_ROOM
        if DEBUG or not (no_room or isinstance(error, (InputError, FileExistsError))):
            raise
        sys.exit(f"nrfgs: {error}" + ". Make room, or write elsewhere." * no_room)
    except KeyboardInterrupt:
        print("nrfgs: stopped", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    entrypoint()
