# SPDX-License-Identifier: Apache-2.0
"""The mean over a training's last steps on one of several devices.

A mean is taken number by number: each device has that of its own splats and of the shared weights. All begin anew where
one of them must. The shared weights are the same on all devices and so must be their means; and a mean that a
checkpoint puts together has one number of steps.
"""

from collections.abc import Mapping
from typing import Any

from torch import Tensor
from torch.optim import Optimizer

from nrfgs_ns.distributed import comm
from nrfgs_ns.training.averaging import ParameterMean


class ShardedMean(ParameterMean):
    """`ParameterMean` of one device. All but `install` and `state` must be called on all devices."""

    def _is_of(self, parameters: Mapping[str, Tensor]) -> bool:
        """Whether on all devices these very objects are those that it is the mean of. The host waits for the answer."""
        here = super()._is_of(parameters)
        return all(comm.gather_counts(int(here), next(iter(parameters.values())).device))

    def whole_state(self, model, optimizers: Mapping[str, Optimizer]) -> dict[str, Any]:
        """What a checkpoint of the whole must hold.

        Args:
            model: a ShardedModel, whose splats have been counted.

        Returns:
            "parameter_mean", `state` with the rows of all devices on the main one, None for the splats' rows elsewhere.
            Nothing where any device has other splats than those that it is the mean of: the guard has taken some out.
        """
        if not self.is_current(model, optimizers):
            return {}
        state = self.state()
        for name, mean in state["means"].items():
            if _is_per_splat(name, model):
                state["means"][name] = comm.gather_rows(mean, model.counts)
        return {"parameter_mean": state}

    def load_state(self, state: Mapping[str, Any], model, optimizers: Mapping[str, Optimizer]) -> None:
        """Go on from this device's rows of a whole checkpoint's `state`; see `ParameterMean.load_state`."""
        means, total = dict(state["means"]), sum(model.counts)
        for name, mean in means.items():
            if _is_per_splat(name, model):
                if len(mean) != total:  # its rows could fit one device and not another
                    return
                means[name] = mean[model.loaded].contiguous()
        super().load_state({**state, "means": means}, model, optimizers)


def _is_per_splat(name: str, model) -> bool:
    """Whether a parameter, by its group and its place in it, has a row for each splat."""
    return name.rpartition(".")[0] in model.gauss_params
