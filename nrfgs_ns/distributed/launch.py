# SPDX-License-Identifier: Apache-2.0
"""What is said when `ns-train` cannot start several processes for one training, or one of them is lost.

When a process dies, its parent sees it at once and ends the others. On other machines the connection breaks, or
nerfstudio's wait ends after half an hour.
"""

import re
import sys

import torch
import torch.multiprocessing as mp
from nerfstudio.engine.trainer import TrainerConfig

from nrfgs_ns.errors import InputError
from nrfgs_ns.training.stopping import SIGNALS


def prepare(config: TrainerConfig) -> None:
    """Raise InputError where `ns-train` cannot start the processes: on CPUs, or on fewer GPUs than are asked for."""
    if config.machine.device_type == "cpu":
        raise InputError("ns-train starts several processes on GPUs alone. On CPUs: python -m nrfgs_lab.many_processes")
    wanted = config.machine.num_devices
    if (present := torch.cuda.device_count()) < wanted:
        raise InputError(f"machine.num_devices is {wanted}, but this machine shows {present} GPUs.")
    explain_losses(config)


def explain_losses(config: TrainerConfig) -> None:
    """Let Python say in one message that a process was lost, instead of with its traceback and the parent's. A process
    that a signal asked to stop has said so itself (`training.stopping`)."""
    show = sys.excepthook

    def short(kind, error, trace):
        if isinstance(error, mp.ProcessExitedException) and error.exit_code in [128 + number for number in SIGNALS]:
            sys.exit(error.exit_code)
        if isinstance(error, mp.ProcessExitedException | mp.ProcessRaisedException):
            print(explain(error, config), file=sys.stderr)
        else:
            show(kind, error, trace)

    sys.excepthook = short


def explain(error: mp.ProcessExitedException | mp.ProcessRaisedException, config: TrainerConfig) -> str:
    """What happened to a process, and how to go on."""
    machine = config.machine
    device = machine.machine_rank * machine.num_devices + error.error_index
    total = machine.num_devices * machine.num_machines
    if isinstance(error, mp.ProcessRaisedException):
        what = "failed:\n" + re.split(r"\n  File .*\n(?:    .*\n)*", str(error).rstrip())[-1]  # without its traceback
    elif error.signal_name:
        why = " Out of memory on the host is a common reason." if error.signal_name == "SIGKILL" else ""
        what = f"was killed by {error.signal_name}.{why}"
    else:
        what = f"ended with code {error.exit_code}."
    folder = config.get_checkpoint_dir()
    last = max(folder.glob("step-*.ckpt"), default=None)
    rest = "This training has written no checkpoint."
    if last:
        rest = f"The last checkpoint is {last}; with --load-dir {folder} it goes on, on any number of devices."
    return f"Training stopped: the process of device {device} of {total} {what}\nThe others were ended. {rest}"
