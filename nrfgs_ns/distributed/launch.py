# SPDX-License-Identifier: Apache-2.0
"""Several processes for one training, and what is said when one of them is lost.

`ns-train METHOD --machine.num-devices N` starts one process for each GPU by itself. On CPUs it refuses to; there

    python -m nrfgs_ns.distributed.launch METHOD --machine.num-devices 2 --machine.device-type cpu ...

starts them, with gloo between them. It takes the same options, and works on GPUs too.

When a process dies, the others would wait for it. The parent, nerfstudio's or ours, sees it at once and ends them. On
other machines the connection breaks, or the time limit of `TIMEOUT` ends the wait.
"""

import re
import socket
import sys
from datetime import timedelta

import torch
import torch.distributed as dist
import torch.multiprocessing as mp
import tyro
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.scripts.train import train_loop
from nerfstudio.utils import comms, profiler
from torch.multiprocessing import ProcessExitedException

from nrfgs_ns.errors import ForTheUser, InputError
from nrfgs_ns.training.stopping import SIGNALS, StopRequest, heard_signals

TIMEOUT = timedelta(minutes=30)
"""Longest that a device waits for another: nerfstudio's. The main device may evaluate or write for a while."""


class DeviceLost(ForTheUser, RuntimeError):
    """A process of a training on several devices has ended before its time."""


def prepare(config: TrainerConfig) -> None:
    """Called by the parent process before it starts the others.

    Raises:
        InputError: this machine has fewer GPUs than the training asks for.
    """
    machine = config.machine
    if machine.device_type == "cpu":
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
    """Whether a process has ended because of a signal that it had heard, and has said so (`training.stopping`)."""
    return isinstance(error, ProcessExitedException) and error.exit_code in [128 + one for one in SIGNALS]


def check_devices(config: TrainerConfig) -> None:
    """Raise InputError where this machine has fewer GPUs than are asked for."""
    asked = config.machine.num_devices
    if config.machine.device_type == "cuda" and torch.cuda.device_count() < asked:
        raise InputError(f"machine.num_devices is {asked}, but this machine shows {torch.cuda.device_count()} GPUs.")


def explain(error: Exception, config: TrainerConfig) -> str:
    """What happened to a process, and how to go on."""
    machine = config.machine
    device = machine.machine_rank * machine.num_devices + error.error_index
    if isinstance(error, ProcessExitedException):
        what = f"was killed by {error.signal_name}." if error.signal_name else f"ended with code {error.exit_code}."
        why = " Out of memory on the host is a common reason." if error.signal_name == "SIGKILL" else ""
    else:
        what, why = "failed:", "\n" + _last_error(str(error))
    folder = config.get_checkpoint_dir()
    last = max(folder.glob("step-*.ckpt"), default=None)
    rest = (
        f"The last checkpoint is {last}, whole; with --load-dir {folder} training goes on from it, on any number of "
        "devices."
        if last
        else "This training has written no checkpoint."
    )
    total = machine.num_devices * machine.num_machines
    return f"Training stopped: the process of device {device} of {total} {what}{why}\nThe others were ended. {rest}"


def _last_error(report: str) -> str:
    """The exception and its message, without the traceback, of torch.multiprocessing's report."""
    lines = report.rstrip().splitlines()
    starts = [
        at for at, line in enumerate(lines) if re.match(r"[A-Za-z_][\w.]*(Error|Exception|Stopped|Interrupt)\b", line)
    ]
    return "\n".join(lines[starts[-1] :] if starts else lines[-1:])


def launch(config: TrainerConfig, timeout: timedelta = TIMEOUT) -> None:
    """Run a training as `ns-train` would, on `machine.num_devices` processes of this machine.

    Args:
        config: of the training, whose config.yml has been saved.

    Raises:
        InputError: this machine has fewer GPUs, or several machines have no address to meet at.
        DeviceLost: a process has ended before its time; the others have been ended.
        SystemExit: the training was asked to stop; its state has been written.
    """
    check_devices(config)
    machine = config.machine
    url = machine.dist_url
    if url == "auto":
        if machine.num_machines > 1:
            raise InputError("machine.dist_url is 'auto', but several machines need one address: tcp://HOST:PORT.")
        url = f"tcp://127.0.0.1:{free_port()}"
    context = mp.spawn(work, args=(config, url, timeout), nprocs=machine.num_devices, join=False)
    request, is_passed_on = StopRequest(quiet=True), False
    try:
        with heard_signals(request):
            while not context.join(timeout=0.2):
                if request.signal is not None and not is_passed_on:
                    for process in context.processes:  # those that have heard it from the terminal take no notice
                        process.terminate()
                    is_passed_on = True
    except (mp.ProcessExitedException, mp.ProcessRaisedException) as error:
        # What is passed on ends a process that has just stopped by itself, and listens no longer.
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


def work(local_rank: int, config: TrainerConfig, url: str, timeout: timedelta) -> None:
    """What one process does."""
    machine = config.machine
    world = machine.num_devices * machine.num_machines
    rank = machine.machine_rank * machine.num_devices + local_rank
    join_group(rank, world, url, machine.device_type, timeout, machine.num_devices)
    train_loop(local_rank, world, config, rank)
    comms.synchronize()
    dist.destroy_process_group()


def join_group(
    rank: int, world: int, url: str, device_type: str, timeout: timedelta = TIMEOUT, per_machine: int | None = None
) -> None:
    """Meet the other processes, `per_machine` on each machine (None: there is one): NCCL on "cuda", gloo on "cpu"."""
    per_machine = per_machine or world
    if device_type == "cuda":
        torch.cuda.set_device(rank % per_machine)
    backend = "nccl" if device_type == "cuda" else "gloo"
    dist.init_process_group(backend, init_method=url, world_size=world, rank=rank, timeout=timeout)
    for first in range(0, world, per_machine):
        group = dist.new_group(list(range(first, first + per_machine)))
        if first <= rank < first + per_machine:
            comms.LOCAL_PROCESS_GROUP = group


def free_port() -> int:
    """A port of this machine that nothing listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def main(args: list[str] | None = None) -> None:
    config = tyro.cli(AnnotatedBaseConfigUnion, args=args)
    if config.data:
        config.pipeline.datamanager.data = config.data
    config.set_timestamp()
    config.save_config()
    launch(config)


if __name__ == "__main__":
    main()
