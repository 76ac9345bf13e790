# SPDX-License-Identifier: Apache-2.0
"""A training on several processes of one machine, as on several GPUs: on CPUs, where `ns-train` refuses to, with gloo
between them, or on GPUs.

    python -m nrfgs_lab.many_processes METHOD --machine.num-devices 2 --machine.device-type cpu ...

It takes the options of `ns-train`.
"""

import socket
import sys
from datetime import timedelta

import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.scripts.train import train_loop
from nerfstudio.utils import comms, profiler

from nrfgs_lab.training_run import parse
from nrfgs_ns.distributed.launch import check_devices, explain, was_asked_to
from nrfgs_ns.errors import ForTheUser, InputError
from nrfgs_ns.training.stopping import StopRequest, heard_signals

TIMEOUT = timedelta(minutes=30)
"""Longest that a device waits for another: nerfstudio's. The main device may evaluate or write for a while."""


class DeviceLost(ForTheUser, RuntimeError):
    """A process of a training on several devices has ended before its time."""


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
            raise SystemExit(128 + request.signal if request.signal else error.exit_code) from None
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
