# SPDX-License-Identifier: Apache-2.0
"""A training on several processes of one machine, as on several GPUs: on CPUs, where `ns-train` refuses to, with gloo
between them, or on GPUs.

    python -m nrfgs_lab.many_processes METHOD --machine.num-devices 2 --machine.device-type cpu ...
"""

import contextlib
import sys
from tempfile import TemporaryDirectory

import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.scripts.train import DEFAULT_TIMEOUT, train_loop
from nerfstudio.utils import comms

from nrfgs_lab.training_run import parse
from nrfgs_ns.distributed.launch import explain_losses


def work(rank: int, config: TrainerConfig, url: str) -> None:
    """Train in one process."""
    join_group(rank, config.machine.num_devices, url, config.machine.device_type)
    train_loop(rank, config.machine.num_devices, config, rank)
    comms.synchronize()
    dist.destroy_process_group()


def join_group(rank: int, world: int, url: str, device_type: str) -> None:
    """Meet the other processes of this machine: NCCL on "cuda", gloo on "cpu"."""
    if device_type == "cuda":
        torch.cuda.set_device(rank)
    backend = "nccl" if device_type == "cuda" else "gloo"
    dist.init_process_group(backend, init_method=url, world_size=world, rank=rank, timeout=DEFAULT_TIMEOUT)
    comms.LOCAL_PROCESS_GROUP = dist.new_group()


if __name__ == "__main__":
    config = parse(sys.argv[1:])
    if config.machine.num_machines > 1:
        sys.exit("machine.num_machines must be 1 here: only ns-train trains on several machines.")
    config.save_config()
    explain_losses(config)
    # The processes hear Ctrl-C, too: Python waits for their last step.
    with contextlib.suppress(KeyboardInterrupt), TemporaryDirectory() as folder:
        mp.spawn(work, args=(config, f"file://{folder}/meeting"), nprocs=config.machine.num_devices)
