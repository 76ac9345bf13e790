# SPDX-License-Identifier: Apache-2.0
"""Several processes for one training, and what is said when one of them is lost.

`ns-train METHOD --machine.num-devices N` starts a process for each GPU, but refuses to on CPUs. There

    python -m nrfgs_ns.distributed.launch METHOD --machine.num-devices 2 --machine.device-type cpu ...

starts them, with gloo between them. It takes the same options, and works on the GPUs of one machine, too.

When a process dies, its parent, nerfstudio's or ours, sees it at once and ends the others. On other machines the
connection breaks, or the wait ends after `TIMEOUT`.
"""

import re
import socket
import sys
from datetime import timedelta

import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.scripts.train import train_loop
from nerfstudio.utils import comms, profiler

from nrfgs_ns.errors import ForTheUser, InputError
from nrfgs_ns.training.stopping import SIGNALS, StopRequest, heard_signals
from nrfgs_ns.training.trainer_config import parse

TIMEOUT = timedelta(minutes=30)
"""Longest that a device waits for another: nerfstudio's. The main device may evaluate or write for a while."""


class DeviceLost(ForTheUser, RuntimeError):
    """A process of a training on several devices has ended before its time."""


def prepare(config: TrainerConfig) -> None:
    """Called by `ns-train` before it starts the processes, whose errors it would print with two tracebacks.

    Raises:
        InputError: the devices are CPUs, or this machine has fewer GPUs than the training asks for.
    """
    if config.machine.device_type == "cpu":
        raise InputError(
            "ns-train starts several processes on GPUs only. On CPUs use python -m nrfgs_ns.distributed.launch with "
            "the same options."
        )
    check_devices(config)
    show = sys.excepthook

    def short(kind, error, trace):
        if was_asked_to(error):
            sys.exit(error.exit_code)
        if isinstance(error, mp.ProcessExitedException | mp.ProcessRaisedException):
            print(explain(error, config), file=sys.stderr)
        else:
            show(kind, error, trace)

    sys.excepthook = short


def was_asked_to(error: BaseException) -> bool:
    """Whether a process ended because of a signal that it heard, and said so (`training.stopping`)."""
    return isinstance(error, mp.ProcessExitedException) and error.exit_code in [128 + number for number in SIGNALS]


def check_devices(config: TrainerConfig) -> None:
    wanted, present = config.machine.num_devices, torch.cuda.device_count()
    if config.machine.device_type == "cuda" and present < wanted:
        raise InputError(f"machine.num_devices is {wanted}, but this machine shows {present} GPUs.")


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


def launch(config: TrainerConfig) -> None:
    """Run a training as `ns-train` would, on `machine.num_devices` processes of this machine.

    Args:
        config: of the training, whose config.yml has been saved.

    Raises:
        InputError: this machine has fewer GPUs, or several machines are asked for.
        DeviceLost: a process has ended before its time; the others have been ended.
        SystemExit: the training was asked to stop; its state has been written.
    """
    check_devices(config)
    machine = config.machine
    if machine.num_machines > 1:
        raise InputError(f"machine.num_machines is {machine.num_machines}; only ns-train trains on several machines.")
    url = f"tcp://127.0.0.1:{free_port()}"
    context = mp.spawn(work, args=(config, url), nprocs=machine.num_devices, join=False)
    request, is_passed_on = StopRequest(quiet=True), False
    try:
        with heard_signals(request):
            while not context.join(timeout=0.2):
                if request.signal is not None and not is_passed_on:
                    for process in context.processes:  # one that has heard it from the terminal ignores a second
                        process.terminate()
                    is_passed_on = True
    except (mp.ProcessExitedException, mp.ProcessRaisedException) as error:
        # A process that has just stopped by itself no longer listens, and the signal that is passed on ends it.
        is_ours = is_passed_on and getattr(error, "signal_name", None) == "SIGTERM"
        if was_asked_to(error) or is_ours:
            raise SystemExit(request.exit_status or error.exit_code) from None
        raise DeviceLost(explain(error, config)) from None
    finally:
        for process in context.processes:
            if process.is_alive():
                process.terminate()
            process.join()
        profiler.flush_profiler(config.logging)


def work(rank: int, config: TrainerConfig, url: str) -> None:
    """What one process does."""
    machine = config.machine
    join_group(rank, machine.num_devices, url, machine.device_type)
    train_loop(rank, machine.num_devices, config, rank)
    comms.synchronize()
    dist.destroy_process_group()


def join_group(rank: int, world: int, url: str, device_type: str) -> None:
    """Meet the other processes of this machine: NCCL on "cuda", gloo on "cpu"."""
    if device_type == "cuda":
        torch.cuda.set_device(rank)
    backend = "nccl" if device_type == "cuda" else "gloo"
    dist.init_process_group(backend, init_method=url, world_size=world, rank=rank, timeout=TIMEOUT)
    comms.LOCAL_PROCESS_GROUP = dist.new_group()


def free_port() -> int:
    """A port of this machine that nothing listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def main() -> None:
    config = parse(sys.argv[1:])
    config.save_config()
    launch(config)


if __name__ == "__main__":
    main()
