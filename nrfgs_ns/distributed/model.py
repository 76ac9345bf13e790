# SPDX-License-Identifier: Apache-2.0
"""The model on one of several devices: a shard of the splats, seen from the cameras of all."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from nrfgs_ns.densification import Densification
from nrfgs_ns.distributed import comm
from nrfgs_ns.distributed.exchange import scale_gradient, send_to_cameras
from nrfgs_ns.distributed.schedules import fewer
from nrfgs_ns.distributed.shards import cut_model_state, rebalance, rows_of, shard_counts
from nrfgs_ns.errors import InputError
from nrfgs_ns.image.photograph import PhotographModel
from nrfgs_ns.model.loss import shrinkage
from nrfgs_ns.model.model import NrfgsModel
from nrfgs_ns.model.pinhole import Pinhole
from nrfgs_ns.model.renderer import View, project_splats, project_view
from nrfgs_ns.model.view_noise import ViewNoise
from nrfgs_ns.rasterizer import Projection
from nrfgs_ns.training.pipeline import ShardingConfig


@dataclass
class ScreenGradients:
    """What densification reads of `info["means2d"]`."""

    grad: Tensor
    """dL/dmean2d of the loss of all cameras, [M, 2]"""
    absgrad: Tensor | None
    """sum over pixels of |dL/dmean2d|, [M, 2], if it is measured"""


class ShardedModel(NrfgsModel):
    """NrfgsModel with the splats of one device.

    `gauss_params`, densification and `info` are about this device's shard; `counts` is about all. Every method that
    renders, computes losses or refines must be called on all devices, in the same order.
    """

    counts: list[int]
    """every device's splats, [W]"""
    loaded: slice | None = None
    """which rows of the checkpoint are this device's, once one has been loaded"""

    def populate_modules(self):
        self.sharding: ShardingConfig = self.kwargs["sharding"]
        self.images_per_step = comm.world() if self.sharding.schedules == "images" else 1
        """how many images a step counts for"""
        super().populate_modules()
        if self.trimming is not None:
            raise InputError("pipeline.model.robust_loss is for one device. Leave it out, or use one.")
        self.view_noise = ViewNoise(0.0, self.view_noise.seed + comm.rank())  # each device has other splats
        self.sizes: list[tuple[int, int]] = []

    def _strategy(self) -> Densification:
        """Of this device's share of the budget; after a reset it waits for as many images as on one device."""
        config = self.config.densification.share_of(comm.rank(), comm.world())
        strategy = config.build(fewer(self.num_train_data, self.images_per_step), self.scene_unit)
        strategy.verbose = comm.rank() == 0
        return strategy

    def _initial_splats(self) -> dict[str, Tensor]:
        whole = super()._initial_splats()
        total = len(whole["means"])
        self.counts = shard_counts(total, comm.world())
        rows = rows_of(comm.rank(), total, comm.world())
        return {name: value[rows].clone() for name, value in whole.items()}

    def start_from(self, seed_points: tuple[Tensor, Tensor]) -> None:
        """Start from other points, the main device's: others may round differently."""
        super().start_from(comm.gather_objects(tuple(table.cpu() for table in seed_points))[0])

    def learn_photographs(self, photographs: PhotographModel | None) -> None:
        """Let each photograph's look be learnt, from where the main device starts: others may round differently."""
        states = comm.gather_objects(None if photographs is None else photographs.state_dict())
        super().learn_photographs(None if states[0] is None else PhotographModel.from_state(states[0]))

    @property
    def parameter_bytes(self) -> int:
        """Bytes of what a renderer needs of the whole model."""
        row = sum(value[:1].numel() * value.element_size() for value in self.gauss_params.values())
        return row * sum(self.counts) + sum(weight.numel() * weight.element_size() for weight in self.head.parameters())

    # Rendering.

    def get_outputs(self, camera: Cameras) -> dict[str, Tensor]:
        """Render one camera, the same on all devices. See `NrfgsModel.get_outputs`."""
        return self.get_outputs_everywhere([camera] * comm.world())

    def get_outputs_everywhere(self, cameras: list[Cameras]) -> dict[str, Tensor]:
        """Render this device's camera (`get_outputs`), given those of all W devices in their order."""
        pinholes = [self.pinhole(camera) for camera in cameras]
        self.sizes = [(one.width, one.height) for one in pinholes]
        field = self.field
        projection = self._project_everywhere(field.splats, pinholes)
        centers = torch.stack([one.center for one in pinholes]).index_select(0, projection.camera_ids)
        appearance = self._as_learnt(field).seen_from(View(projection, centers))

        absgrad = self.training and self.densification.needs_absgrad(self.step)
        own, colored = send_to_cameras(projection, appearance, *self.sizes[comm.rank()], absgrad)
        outputs, _ = self.picture(View(own, pinholes[comm.rank()].center), colored, cameras[comm.rank()])
        if self.training:
            if len(own.depths) == 0:  # all devices must go backward through the exchange, the one that sees nothing too
                outputs["rgb"] = outputs["rgb"] + colored.colors.sum()
            self.info = {
                "camera_ids": projection.camera_ids,
                "gaussian_ids": projection.gaussian_ids,
                "radii": projection.radii,
                "means2d": projection.means2d,
                "depths": projection.depths,
                "n_cameras": len(pinholes),
            }
            self.densification.pre_backward(self.step, self.info, appearance.opacities, self.gauss_params["opacities"])
        return outputs

    def _project_everywhere(self, splats: Mapping[str, Tensor], pinholes: list[Pinhole]) -> Projection:
        """This device's splats in all cameras; at once if they have the same size."""
        if len(set(self.sizes)) == 1:
            viewmats, Ks = torch.cat([one.viewmat for one in pinholes]), torch.cat([one.K for one in pinholes])
            return project_splats(splats, viewmats, Ks, *self.sizes[0], self.projection_options)
        parts = [project_view(splats, one, self.projection_options).projection for one in pinholes]
        for index, part in enumerate(parts):
            part.camera_ids = torch.full_like(part.camera_ids, index)
        names = ("camera_ids", "gaussian_ids", "radii", "means2d", "depths", "conics")
        columns = {name: torch.cat([getattr(part, name) for part in parts]) for name in names}
        compensations = None
        if parts[0].compensations is not None:
            compensations = torch.cat([part.compensations for part in parts])
        width, height = self.sizes[comm.rank()]
        return Projection(**columns, compensations=compensations, width=width, height=height, n_cameras=len(parts))

    # Training.

    def far_from_neutral(self, camera, weights):
        """As for one device: the mean over all splats that the camera sees, whosever they are."""
        found = super().far_from_neutral(camera, weights)
        if found is None:
            return None
        visible, loss, gradients = found
        if visible == 0:  # means over nothing are NaN
            loss, gradients = torch.zeros_like(loss), [torch.zeros_like(gradient) for gradient in gradients]
        sums = [loss.new_tensor(float(visible)), *(visible * part for part in (loss, *gradients))]
        comm.sum_over_devices(sums)
        total, loss, *gradients = sums
        return int(total), loss / total, tuple(gradient / total for gradient in gradients)

    def get_loss_dict(self, outputs, batch, metrics_dict=None) -> dict[str, Tensor]:
        """This device's losses. Their gradients are divided by W: the sum over devices is that of the mean loss.

        Terms that are means over splats are means over the shard here: each counts by the shard's share of the splats.
        """
        losses = super().get_loss_dict(outputs, batch, metrics_dict)
        if not self.training:
            return losses
        devices = comm.world()
        over_splats = {
            "scale_reg",
            *self.densification.regularisation(self.gauss_params),
            *shrinkage(self, self.gauss_params),
        }
        share = self.num_points * devices / sum(self.counts)
        for name in over_splats & losses.keys():
            if self.num_points == 0:
                del losses[name]
            else:
                losses[name] = losses[name] * share
        return {name: scale_gradient(loss, 1.0 / devices) for name, loss in losses.items()}

    def step_post_backward(self, step: int) -> None:
        assert step == self.step
        self.densification.post_backward(step, self._screen_info(), self.gauss_params, self.optimizers)
        if step % self.config.densification.refine_every == 0:
            self.count()
            if max(self.counts) > self.sharding.rebalance_at * sum(self.counts) / len(self.counts):
                self.counts = rebalance(self.gauss_params, self.optimizers, self.densification.state, self.counts)

    def count(self) -> None:
        """Ask all devices how many splats they have."""
        self.counts = comm.gather_counts(self.num_points, self.device)

    @torch.no_grad()
    def _screen_info(self) -> dict[str, Any]:
        """`info` as densification reads it, for a step of W cameras.

        gsplat multiplies gradients by half the image's sides and by the number of cameras, which undoes the mean of the
        losses: each (camera, splat) pair counts as in a step of its own. Where cameras differ in size, gradients and
        radii are brought to that of the first here. Of several radii of a splat gsplat would keep any; here all are the
        largest.
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
            "means2d": ScreenGradients(grad, absgrad),
            "radii": largest.index_select(0, rows),
            "width": width,
            "height": height,
            "n_cameras": comm.world(),
        }

    @torch.no_grad()
    def get_metrics_dict(self, outputs, batch) -> dict[str, Any]:
        """As for one device, with the number of all splats."""
        return {**super().get_metrics_dict(outputs, batch), "gaussian_count": sum(self.counts)}

    # Checkpoints.

    def load_state_dict(self, state: dict[str, Any], strict: bool = True, **kwargs):
        """Load this device's rows of a whole checkpoint. See `NrfgsModel.load_state_dict`."""
        total, devices = len(state["gauss_params.means"]), comm.world()
        written = state.get("_extra_state", {}).get("shards")
        self.loaded = rows_of(comm.rank(), total, devices, written)
        known = written is not None and len(written) == devices and sum(written) == total
        self.counts = list(written) if known else shard_counts(total, devices)
        return super().load_state_dict(cut_model_state(state, self.loaded), strict=strict, **kwargs)
