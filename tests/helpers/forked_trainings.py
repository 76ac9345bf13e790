# SPDX-License-Identifier: Apache-2.0
"""Runs trainings in children of a process that has imported everything: nothing to wait for but the steps.

Each line of its input is the command line of one, as JSON; it answers with the child's process number, and, when that
has ended, with its exit code.
"""

import json
import os
import sys
import traceback

from nrfgs_ns.training.run import train


def main() -> None:
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    print("ready", file=answers, flush=True)
    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            try:
                train(json.loads(line))
            except BaseException:
                traceback.print_exc()
                os._exit(1)
            os._exit(0)
        print(child, file=answers, flush=True)
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), file=answers, flush=True)


if __name__ == "__main__":
    main()
