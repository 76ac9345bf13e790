# SPDX-License-Identifier: Apache-2.0
"""The pipeline on one of several devices."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from nerfstudio.utils import profiler

from nrfgs_ns.distributed import comm
from nrfgs_ns.distributed.model import ShardedModel
from nrfgs_ns.training.pipeline import NrfgsPipeline, NrfgsPipelineConfig


class ShardedPipeline(NrfgsPipeline):
    """NrfgsPipeline around a ShardedModel, without nerfstudio's DistributedDataParallel, which cannot hold parameters
    that come and go.

    Everything is seeded alike on all devices until the model is built, and so are Python's and numpy's generators
    afterwards, from which the order of the cameras comes. torch's, from which splits, noise and backgrounds come, is
    then seeded with the run's seed + 1 + rank.
    """

    model: ShardedModel

    def __init__(self, config: NrfgsPipelineConfig, device: str, test_mode: str = "val", world_size: int = 1, **kwargs):
        sharded = partial(ShardedModel, sharding=config.sharding)
        config = replace(config, model=replace(config.model, _target=sharded))
        super().__init__(config, device, test_mode, world_size=1, **kwargs)
        self.world_size, self.images_per_step = world_size, self.model.images_per_step
        torch.manual_seed(torch.initial_seed() + 1 + comm.rank())

    @profiler.time_function
    def get_train_loss_dict(self, step: int):
        """One camera for each device; see `NrfgsPipeline.get_train_loss_dict`."""
        cameras, batch = self.datamanager.next_train_views(comm.world(), comm.rank())
        outputs = self.model.get_outputs_everywhere(cameras)
        metrics = self.model.get_metrics_dict(outputs, batch) if step % self.steps_per_log == 0 else {}
        return outputs, self.model.get_loss_dict(outputs, batch, metrics), metrics

    def get_average_eval_image_metrics(
        self, step: int | None = None, output_path: Path | None = None, get_std: bool = False
    ) -> dict[str, Any]:
        """Every device renders every test image, each from its splats and those of the others: the same numbers."""
        result = super().get_average_eval_image_metrics(step, output_path if comm.rank() == 0 else None, get_std)
        return {**result, "splats": sum(self.model.counts)}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore the order of the cameras, and this device's generators if as many devices wrote the checkpoint."""
        devices = state.get("devices", ())
        if len(devices) == comm.world():
            super().set_extra_state({**state, **devices[comm.rank()]})
        else:
            self.check_schedules(state)
            self.datamanager.load_sampling_state(state["sampling"])
