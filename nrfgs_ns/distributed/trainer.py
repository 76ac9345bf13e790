# SPDX-License-Identifier: Apache-2.0
"""The trainer on one of several devices: shared weights stay the same everywhere, all devices stop together, and the
main one writes checkpoints of the whole."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

import torch
import torch.distributed as dist
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.scripts.train import _set_random_seed
from nerfstudio.utils import comms
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Optimizer

from nrfgs_ns.distributed import comm
from nrfgs_ns.distributed.model import ShardedModel, map_model_rows, own_rows
from nrfgs_ns.training.averaging import ParameterMean
from nrfgs_ns.training.guard import MAX_GRADIENT, Guard, TrainingStopped, Verdict, Watched
from nrfgs_ns.training.optimizers import LeanOptimizers, parameters_of
from nrfgs_ns.training.pipeline import NrfgsPipeline, NrfgsPipelineConfig
from nrfgs_ns.training.stopping import StopRequest
from nrfgs_ns.training.trainer import NrfgsTrainer
from nrfgs_ns.training.trainer_config import NrfgsTrainerConfig


class ShardedPipeline(NrfgsPipeline):
    """NrfgsPipeline around a ShardedModel, without nerfstudio's DistributedDataParallel, which cannot hold parameters
    that come and go.

    All devices have the same seeds until the model is built. Python's and numpy's generators, which order the cameras,
    keep them; torch's, which draws splits, noise and backgrounds, then gets the run's seed + 1 + rank.
    """

    model: ShardedModel

    def __init__(self, config: NrfgsPipelineConfig, device: str, test_mode: str = "val", world_size: int = 1, **kwargs):
        config = replace(config, model=replace(config.model, _target=ShardedModel))
        super().__init__(config, device, test_mode, world_size=1, **kwargs)
        self.world_size = world_size
        torch.manual_seed(torch.initial_seed() + 1 + comm.rank())

    def get_train_loss_dict(self, step: int, graphs: None = None, with_metrics: bool = True):
        """One camera for each device; see `NrfgsPipeline.get_train_loss_dict`."""
        cameras, batch = self.datamanager.next_train_views(comm.world(), comm.rank())
        outputs = self.model.get_outputs_everywhere(cameras)
        losses = self.model.get_loss_dict(outputs, batch)
        return outputs, losses, self.model.get_metrics_dict(outputs, batch) if with_metrics else {}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore the order of the cameras; torch's generators differ between devices, and go on as they are."""
        self.datamanager.load_sampling_state(state["sampling"])


class ShardedMean(ParameterMean):
    """`ParameterMean` of one device's splats and of the shared weights. If one device must restart, all do, so that
    shared weights stay the same. A training that goes on averages its own steps."""

    def is_current(self, optimizers: Mapping[str, Optimizer]) -> bool:
        """Whether the rows of all devices still denote the splats that were averaged. The host waits for the answer."""
        return all(comm.gather(super().is_current(optimizers)))


class ShardedGuard(Guard):
    """The guard of one device. What stops one, a signal included, stops all, at the same step with one message."""

    def __init__(self, pipeline, request: StopRequest):
        super().__init__(pipeline)
        self.request = request
        self.signal = 0
        """a signal that any device had heard before the last verdict was read, the same on all; 0: none"""

    def _share(self, verdict: Verdict) -> Verdict:
        sizes = verdict.sizes
        bad = (~(sizes <= MAX_GRADIENT)).any().to(sizes.dtype)
        anywhere = torch.stack([bad, torch.full_like(bad, float(self.request.signal or 0))])
        dist.all_reduce(anywhere, dist.ReduceOp.MAX)
        elsewhere = torch.where(anywhere[0] > bad, math.inf, 0.0)
        watched = [*verdict.watched, Watched("a number on another device", "elsewhere", elsewhere)]
        watched.append(Watched("a signal", "elsewhere", anywhere[1]))
        return Verdict(verdict.step, watched, torch.cat([sizes, elsewhere[None], anywhere[1:]]))

    def _read(self, verdict: Verdict) -> list[float]:
        sizes = super()._read(verdict)
        self.signal = self.signal or int(sizes[-1])
        return sizes

    def _check_visibility(self) -> None:
        """Nothing: one device's shard may be out of sight."""

    def settle(self) -> None:
        try:
            super().settle()
        except TrainingStopped as stopped:  # on all devices
            self._stop_together(stopped)

    def check_parameters(self, optimizers: LeanOptimizers) -> None:
        stopped = None
        try:
            super().check_parameters(optimizers)
        except TrainingStopped as error:
            stopped = error
        self._stop_together(stopped)

    def _stop_together(self, stopped: TrainingStopped | None) -> None:
        """Raise one exception on all devices if any has one: from the first whose own image or loss is bad, which
        spreads to all gradients; otherwise of the first that found something itself."""
        mine = None if stopped is None else (str(stopped), stopped.step, stopped.origin, stopped.savable)
        stops = [(device, *stop) for device, stop in enumerate(comm.gather(mine)) if stop is not None]
        if not stops:
            return
        own = [stop for stop in stops if stop[3] != "elsewhere"]
        device, message, step, origin, _ = next((stop for stop in own if stop[3] == "rendering"), own[0])
        savable = all(stop[4] for stop in stops)
        raise TrainingStopped(f"On device {device} of {comm.world()}: {message}", step, origin, savable) from None


def map_moments(state: Mapping[str, Any], change: Callable[[Tensor], Any]) -> dict[str, Any]:
    """The state of one of the splats' optimisers with its moments changed; Adam's step counter, a scalar, stays."""
    moments = {
        index: {key: change(v) if isinstance(v, Tensor) and v.dim() > 0 else v for key, v in entry.items()}
        for index, entry in state["state"].items()
    }
    return {**state, "state": moments}


class ShardedOptimizers(LeanOptimizers):
    """The optimisers of one device: gradients of what all devices have are summed before the step."""

    def __init__(self, model, *args: Any):
        super().__init__(*args)
        self.model = model

    def step(self) -> None:
        shared = [name for name in self.optimizers if name not in self.model.gauss_params]
        gradients = [parameter.grad for name in shared for parameter in parameters_of(self.optimizers[name])]
        comm.sum_over_devices([gradient for gradient in gradients if gradient is not None])
        super().step()

    def load_optimizers(self, loaded_state: dict[str, Any], weights: Sequence[Parameter] = ()) -> None:
        """Load this device's rows of a whole checkpoint."""
        own = dict(loaded_state)
        for name in self.model.gauss_params:
            own[name] = map_moments(own[name], own_rows)
        super().load_optimizers(own, weights)


class ShardedTrainer(NrfgsTrainer):
    """The trainer of one device; InputError where an option is for one device only."""

    def __init__(self, config: NrfgsTrainerConfig, local_rank: int = 0, world_size: int = 1) -> None:
        if config.machine.device_type == "cuda":
            torch.cuda.set_device(local_rank)
        CONSOLE.quiet = comm.rank() > 0
        vis = config.vis.removeprefix("viewer+")
        vis = "tensorboard" if vis.startswith("viewer") else vis
        if vis != config.vis:  # the viewer renders when it likes, and a rendering takes all devices
            CONSOLE.print(f"No viewer while training on several devices: --vis {config.vis} is {vis} here.")
        config = replace(config, vis=vis, pipeline=replace(config.pipeline, _target=ShardedPipeline))
        super().__init__(config, local_rank, world_size)

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        # Nerfstudio seeds devices differently, but initial splats and the order of the cameras must be the same.
        _set_random_seed(self.config.machine.seed)
        super().setup(test_mode)
        if self.config.machine.device_type == "cuda":
            CONSOLE.print("Steps are not recorded as a CUDA graph, so they take longer: there are several devices.")

    @property
    def _signal(self) -> int:
        return self.guard.signal

    def _end(self, line: str, status: int) -> None:
        comms.synchronize()  # until the main device has written
        super()._end(line, status)

    def setup_optimizers(self) -> Optimizers:
        self.start_densely()
        self.guard = ShardedGuard(self.pipeline, self.request)
        self.mean = ShardedMean() if self.config.average_steps > 0 else None
        groups = self.pipeline.get_param_groups()
        every = self.config.logging.steps_per_log
        return ShardedOptimizers(self.pipeline.model, self.optimizer_configs(), groups, every)

    def _checkpoint(self, step: int) -> dict[str, Any]:
        """The whole, on the main device: what one device would write."""
        content = super()._checkpoint(step)
        model = self.pipeline.model
        model.count()

        def gathered(table: Tensor) -> Tensor | None:
            return comm.gather_rows(table, model.counts)

        content["pipeline"] = map_model_rows(content["pipeline"], gathered, "_model.")
        for name in model.gauss_params:
            content["optimizers"][name] = map_moments(content["optimizers"][name], gathered)
        return content
