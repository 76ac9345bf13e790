# SPDX-License-Identifier: Apache-2.0
"""Runs trainings in children of a process that has imported everything: nothing to wait for except the steps.

Each line of its input is JSON: the step in whose checkpoint the child kills itself, or null, and a command line. The
answer is the child's exit code.
"""

import json
import os
import signal
import sys
import traceback

import torch

from nrfgs_lab.training_run import train


def dying_at(step: int):
    """torch.save that dies halfway through the checkpoint after a step."""
    save = torch.save

    def dying(content, path):
        save(content, path)
        if content["step"] == step:
            os.truncate(path, os.path.getsize(path) // 2)
            os.kill(os.getpid(), signal.SIGKILL)

    return dying


def main() -> None:
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            try:
                step, words = json.loads(line)
                if step is not None:
                    torch.save = dying_at(step)
                train(words)
            except BaseException:
                traceback.print_exc()
                os._exit(1)
            os._exit(0)
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), file=answers, flush=True)


if __name__ == "__main__":
    main()
