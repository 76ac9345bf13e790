# SPDX-License-Identifier: Apache-2.0
"""The model on one of several devices: a shard of the splats, rendered from the cameras of all.

What belongs to a splat is where it is: its row of each parameter, of Adam's two moments (`trainer.py`), and of
densification's statistics.
"""

from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from nrfgs_ns.appearance.head import ViewNoise
from nrfgs_ns.densification import Densification
from nrfgs_ns.distributed import comm
from nrfgs_ns.distributed.exchange import send_to_cameras
from nrfgs_ns.image.photograph import PhotographModel
from nrfgs_ns.model.loss import shrinkage
from nrfgs_ns.model.model import NrfgsModel
from nrfgs_ns.rasterizer import Pinhole, Projection, View, project, project_view

ROWS = "camera_ids", "gaussian_ids", "radii", "means2d", "depths", "n_cameras"
"""Columns of a projection that densification reads in `info`."""


def own_rows(table: Tensor) -> Tensor:
    """This device's rows of a whole table. They are dealt out in turn, because neighbours in a point cloud are
    neighbours in space, and each camera should see equally many splats of each device."""
    return table[comm.rank() :: comm.world()]


def map_model_rows(state: Mapping[str, Any], change: Callable[[Tensor], Any], prefix: str = "") -> dict[str, Any]:
    """A model's state, named after `prefix`, with each table of splats and of densification's statistics changed."""
    rows = f"{prefix}gauss_params."
    extra = state[f"{prefix}_extra_state"]
    strategy = {name: change(v) if isinstance(v, Tensor) else v for name, v in extra["strategy"].items()}
    changed = {name: change(value) if name.startswith(rows) else value for name, value in state.items()}
    return {**changed, f"{prefix}_extra_state": {**extra, "strategy": strategy}}


class ShardedModel(NrfgsModel):
    """NrfgsModel with the splats of one device.

    `gauss_params`, densification and `info` are about this device's shard; `counts` is about all. Every method that
    renders, computes losses or refines must be called on all devices, in the same order.
    """

    warms_up = False
    counts: list[int]
    """every device's splats, [W]"""

    def populate_modules(self):
        super().populate_modules()
        self.view_noise = ViewNoise(0.0, self.view_noise.seed + comm.rank())  # each device has other splats

    def _strategy(self) -> Densification:
        config = self.config.densification.share_of(comm.rank(), comm.world())
        strategy = config.build(self.num_train_data, self.num_views, self.scene_unit)
        strategy.verbose = comm.rank() == 0
        strategy.minimum_of_devices = lambda number: min(comm.gather(number))
        return strategy

    def _initial_splats(self) -> dict[str, Tensor]:
        own = {name: own_rows(value).clone() for name, value in super()._initial_splats().items()}
        self.counts = comm.gather(len(own["means"]))
        return own

    def start_from(self, seed_points: tuple[Tensor, Tensor]) -> None:
        """Start from the main device's points: others may round differently."""
        super().start_from(comm.gather(tuple(table.cpu() for table in seed_points))[0])

    def learn_photographs(self, photographs: PhotographModel | None) -> None:
        """Learn each photograph's exposure, starting from the main device's: others may round differently."""
        states = comm.gather(None if photographs is None else photographs.state_dict())
        super().learn_photographs(None if states[0] is None else PhotographModel.from_state(states[0]))

    @property
    def num_splats(self) -> int:
        return sum(self.counts)

    # Rendering.

    def get_outputs(self, camera: Cameras) -> dict[str, Tensor]:
        """Render one camera, the same on all devices."""
        return self.get_outputs_everywhere([camera] * comm.world())

    def get_outputs_everywhere(self, cameras: list[Cameras]) -> dict[str, Tensor]:
        """Render this device's camera (`get_outputs`), given those of all W devices in their order."""
        pinholes = [self.pinhole(camera) for camera in cameras]
        self.sizes = [(one.width, one.height) for one in pinholes]
        field = self.field
        own = comm.rank()
        projection = self._project_everywhere(field.splats, pinholes)
        centers = torch.stack([one.center for one in pinholes]).index_select(0, projection.camera_ids)
        appearance = self.noisy(field).seen_from(View(projection, centers))
        absgrad = self.densification.needs_absgrad(self.step)
        drawn, arrived = send_to_cameras(projection, appearance, *self.sizes[own], absgrad)
        look = self.look_of(self._photograph_of(cameras[own]))
        outputs, _ = self.composite(View(drawn, pinholes[own].center, pinhole=pinholes[own]), arrived, look=look)
        self.info = {name: getattr(projection, name) for name in ROWS}  # the image's rows are other devices' splats
        if self.training:
            self.densification.pre_backward(self.step, self.info, appearance.opacities, field.splats["opacities"])
            if len(arrived.colors) == 0:
                # All devices must go backward through the exchange, the one that sees nothing too.
                outputs["rgb"] = outputs["rgb"] + arrived.colors.sum()
        return outputs

    def _project_everywhere(self, splats: Mapping[str, Tensor], pinholes: list[Pinhole]) -> Projection:
        """This device's splats in all cameras; at once if they have the same size."""
        if len(set(self.sizes)) == 1:
            viewmats, Ks = (torch.cat([getattr(one, name) for one in pinholes]) for name in ("viewmat", "K"))
            geometry = splats["means"], splats["quats"], splats["scales"].exp()
            return project(*geometry, viewmats, Ks, *self.sizes[0], self.projection_options)
        parts = [project_view(splats, one, self.projection_options).projection for one in pinholes]
        for index, part in enumerate(parts):
            part.camera_ids = torch.full_like(part.camera_ids, index)
        names = ("camera_ids", "gaussian_ids", "radii", "means2d", "depths", "conics", "compensations")
        columns = {name: [getattr(part, name) for part in parts] for name in names}
        columns = {name: None if column[0] is None else torch.cat(column) for name, column in columns.items()}
        width, height = self.sizes[comm.rank()]
        return Projection(**columns, width=width, height=height, n_cameras=len(parts))

    # Training.

    def get_loss_dict(self, outputs, batch, metrics_dict=None) -> dict[str, Tensor]:
        """This device's losses. Means over splats are means over the shard here, and are weighted by the shard's share
        of the splats."""
        losses = super().get_loss_dict(outputs, batch, metrics_dict)
        if not self.training:
            return losses
        over_splats = {*self.densification.regularisation(self.gauss_params), *shrinkage(self, self.gauss_params)}
        share = self.num_points * comm.world() / self.num_splats
        for name in over_splats & losses.keys():
            if self.num_points == 0:
                del losses[name]
            else:
                losses[name] = losses[name] * share
        return losses

    def step_post_backward(self, step: int) -> None:
        self.densification.post_backward(step, self._screen_info(), self.gauss_params, self.optimizers)
        if step % self.config.densification.refine_every == 0:
            self.count()

    def count(self) -> None:
        """Update `counts` from all devices."""
        self.counts = comm.gather(self.num_points)

    @torch.no_grad()
    def _screen_info(self) -> dict[str, Any]:
        """`info` as densification reads it, for a step of W cameras.

        The statistics multiply gradients by the number of cameras, which undoes the mean of the losses: each (camera,
        splat) pair counts as in a step of its own. Where cameras differ in size, gradients and radii are brought to
        the first one's. Of a splat's radii all are the largest.
        """
        info = self.info
        width, height = self.sizes[0]
        means2d, rows, cameras = info["means2d"], info["gaussian_ids"], info["camera_ids"]
        grad = means2d.grad if means2d.retains_grad else None
        absgrad = getattr(means2d, "absgrad", None)
        radii = info["radii"].to(means2d.dtype)
        if len(set(self.sizes)) > 1:
            sides = radii.new_tensor(self.sizes)  # [W, 2]
            to_first = (sides / sides[0]).index_select(0, cameras)
            grad = None if grad is None else grad * to_first
            absgrad = None if absgrad is None else absgrad * to_first
            longest = sides.amax(dim=1)
            radii = radii * (longest[0] / longest).index_select(0, cameras)
        largest = radii.new_zeros(self.num_points).scatter_reduce_(0, rows, radii, "amax")
        return {
            **info,
            "means2d": SimpleNamespace(grad=grad, absgrad=absgrad),
            "radii": largest.index_select(0, rows),
            "width": width,
            "height": height,
            "n_cameras": comm.world(),
        }

    # Checkpoints.

    def load_state_dict(self, state: dict[str, Any], strict: bool = True, **kwargs):
        """Load this device's rows of a whole checkpoint. See `NrfgsModel.load_state_dict`."""
        result = super().load_state_dict(map_model_rows(state, own_rows), strict=strict, **kwargs)
        self.count()
        return result
