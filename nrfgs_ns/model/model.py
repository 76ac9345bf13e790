# SPDX-License-Identifier: Apache-2.0
"""Splatfacto with an appearance head: nerfstudio's hooks, in the order of a training.

Drawing is in `rasterizer/`, the loss in `loss.py`, the initial splats in `initial_splats.py`, what the exporter reads
in `exported.py`, and strategies that add and remove splats in `densification/`. Unlike splatfacto's, colours and
opacities come from the head, nothing needs CUDA, metrics respect masks, and loading a checkpoint keeps the parameter
objects that the optimisers hold, so that an interrupted training can go on.
"""

import os
from collections.abc import Mapping
from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.models.splatfacto import SplatfactoModel
from nerfstudio.utils.colors import get_color
from torch import Tensor
from torch.nn import Parameter, ParameterDict

from nrfgs_ns.appearance.head import AppearanceHeadConfig, Field, SplatAppearance, ViewNoise, check_head, located_errors
from nrfgs_ns.data.checks import warn
from nrfgs_ns.data.views import camera_spacing
from nrfgs_ns.densification import Densification
from nrfgs_ns.errors import InputError, require
from nrfgs_ns.image import robust
from nrfgs_ns.image.metrics import image_metrics
from nrfgs_ns.image.photograph import PhotographModel
from nrfgs_ns.model.config import NrfgsModelConfig
from nrfgs_ns.model.exported import ExportedModel
from nrfgs_ns.model.initial_splats import initial_splats
from nrfgs_ns.model.loss import loss_of
from nrfgs_ns.model.pinholes import Pinholes, pinhole
from nrfgs_ns.model.saved_state import check_compatible, differences, photographs_of, reduced_config
from nrfgs_ns.model.warmup import warm_up
from nrfgs_ns.rasterizer import Look, Pinhole, ProjectionOptions, View, composite_view, project_view

NEAR_SHARE = 0.5
"""Near plane of `near_plane` auto, in the depth of the nearest points (`data.views.nearest_depth`)."""
LOOK = "NRFGS_LOOK"
"""Environment variable: a training photograph's file name; without it, renderings have the photographs' mean look."""
VISER_BACKGROUND = (0.1490, 0.1647, 0.2157)
"""Background in evaluation after training with random ones: viser's default grey, as in splatfacto."""


class NrfgsModel(ExportedModel):
    """Gaussian splatting with an appearance head. All cameras are batches of one, [1].

    Args:
        config: the head, and the options of `NrfgsModelConfig`.
        seed_points: initial points [P, 3] in world units and their colours [P, 3] in 0..255.
    """

    config: NrfgsModelConfig
    viewer_panel: Any = None
    """`ViewerPanel` that renders for browsers; None: no viewer"""
    warms_up: bool = True
    """whether the warm-up sees all splats"""
    _scheduled: int | None = None

    def populate_modules(self):
        # Splatfacto's own populate_modules calls .cuda() and builds LPIPS, which downloads: it cannot be extended.
        config = self.config
        config.check()
        metadata = self.kwargs.get("metadata") or {}
        self.scene_unit: float = metadata.get("scene_unit", 1.0)
        """World units in a scene unit; lengths in the configuration are in scene units."""
        self.num_views: int = metadata.get("different_views", self.num_train_data)
        """Different training views (`data.views.different_views`); a checkpoint keeps its training's number."""
        self.near: float = NEAR_SHARE * metadata.get("nearest_depth", 0.0)
        """Depth from which `near_plane` auto draws splats, in world units; a checkpoint keeps its training's."""
        config.appearance.validate()
        self._seed = torch.initial_seed()
        with located_errors(config.appearance):
            self.head = config.suited_appearance(self.num_views).setup(self.scene_unit)
            splats = self._initial_splats()
            check_head(self.head, splats)
        config.sh_degree = self.head.sh_degree
        self.gauss_params = ParameterDict(splats)
        self.camera_optimizer = config.camera_optimizer.setup(num_cameras=self.num_train_data, device="cpu")
        self.photograph: PhotographModel | None = None  # set by the pipeline, which knows the photographs
        self.trimming = robust.Trimming(config.robust_loss) if config.robust_loss > 0.0 else None
        self.step = 0
        self.crop_box = None
        self.pinholes = Pinholes()
        self._training_pinholes: dict[tuple[int, int], Pinhole] = {}  # training cameras by index and downscale
        is_random = config.background_color == "random"
        self.background_color = torch.tensor(VISER_BACKGROUND) if is_random else get_color(config.background_color)
        self.densification = self._strategy()
        self.view_noise = ViewNoise(0.0, self._seed)  # until the training cameras are known

    @property
    def trust(self) -> float:
        """Trust in the head with this number of views, in (0, 1]."""
        return self.config.trust(self.num_views)

    @property
    def noise_factor(self) -> float:
        """Length of the noise on the head's camera centre, in spacings of the training cameras."""
        return self.config.view_noise / self.trust

    def _initial_splats(self) -> dict[str, Tensor]:
        return initial_splats(self.config, self.head, self.seed_points, self.scene_unit)

    def start_from(self, seed_points: tuple[Tensor, Tensor]) -> None:
        """Start a new training from other points, positions [P, 3] and colours [P, 3] in 0..255."""
        self.seed_points = seed_points
        with torch.random.fork_rng(devices=[]):  # the same on each of several devices
            torch.default_generator.manual_seed(self._seed)
            self.gauss_params = ParameterDict(self._initial_splats()).to(self.device)

    def _strategy(self) -> Densification:
        return self.config.densification.build(self.num_train_data, self.num_views, self.scene_unit)

    def learn_photographs(self, photographs: PhotographModel | None) -> None:
        """Learn each photograph's exposure and colour; None: all are the same."""
        self.photograph = None if photographs is None else photographs.to(self.device)
        if self.photograph is not None:
            self._requested_photograph()  # report an unknown name now, not at the first evaluation

    def get_param_groups(self) -> dict[str, list[Parameter]]:
        """One group for each per-splat tensor, "field" for the head's weights, and "photograph" for exposures."""
        groups = {name: [parameter] for name, parameter in self.gauss_params.items()}
        self.camera_optimizer.get_param_groups(groups)
        if weights := list(self.head.parameters()):
            groups["field"] = weights
        if self.photograph is not None:
            groups["photograph"] = list(self.photograph.parameters())
        return groups

    @property
    def num_splats(self) -> int:
        """Splats on all devices; `num_points` are those on this one."""
        return self.num_points

    @property
    def parameter_bytes(self) -> int:
        """Bytes that a renderer of all splats needs."""
        row = sum(value.shape[1:].numel() * value.element_size() for value in self.gauss_params.values())
        return row * self.num_splats + sum(weight.nbytes for weight in self.head.parameters())

    # Rendering.

    @torch.no_grad()
    def get_outputs_for_camera(self, camera: Cameras, obb_box: OrientedBox | None = None) -> dict[str, Tensor]:
        """Render one camera, with splats centred in the box alone if one is given; in a viewer, as its panel says.

        Nerfstudio moves the camera to the GPU first, where the host must wait to learn its size.
        """
        if self.viewer_panel is not None and self.viewer_panel.is_asking():
            return self.viewer_panel.render(camera, obb_box)
        self.set_crop(obb_box)
        return self.get_outputs(camera.to(self.device) if self.training else camera)

    def get_outputs(self, camera: Cameras) -> dict[str, Tensor]:
        """Render one camera.

        Returns:
            "rgb" [H, W, 3] in [0, 1], "accumulation" [H, W, 1], "background" [H, W, 3], and, outside of training,
            "depth" [H, W, 1].
        """
        field = self.field
        look = self.look_of(self._photograph_of(camera))
        view, is_between = self.project(camera, field.splats), "between" in (camera.metadata or {})
        outputs, self.info = self.render_view(view, self.noisy(field), look, is_between)
        return outputs

    @property
    def field(self) -> Field:
        """The head with all splats, or, in evaluation, those in the crop box."""
        splats: dict[str, Tensor] = dict(self.gauss_params.items())
        if self.crop_box is not None and not self.training:
            inside = self.crop_box.within(splats["means"]).reshape(-1)
            splats = {name: value[inside] for name, value in splats.items()}
        return Field(self.head, splats)

    def project(self, camera: Cameras, splats: Mapping[str, Tensor] | None = None) -> View:
        """Project splats into a camera (`project_view`): the field's, or another table."""
        splats = self.field.splats if splats is None else splats
        return project_view(splats, self.pinhole(camera), self.projection_options)

    def pinhole(self, camera: Cameras) -> Pinhole:
        """The camera for the rasterizer; training cameras whose pose is not learnt are converted once."""
        if not self.training or "between" in (camera.metadata or {}):
            return self.pinholes.of_full_size(camera, self.device)
        index = (camera.metadata or {}).get("cam_idx")
        downscale = self._get_downscale_factor()
        if index is None or self.config.camera_optimizer.mode != "off":
            return pinhole(camera, self.camera_optimizer.apply_to_camera(camera), downscale)
        if (index, downscale) not in self._training_pinholes:
            self._training_pinholes[index, downscale] = pinhole(camera, camera.camera_to_worlds, downscale)
        return self._training_pinholes[index, downscale]

    def _get_downscale_factor(self) -> int:
        risen = self.schedule_step // self.config.resolution_schedule
        return 2 ** max(self.config.num_downscales - risen, 0) if self.training else 1

    @property
    def projection_options(self) -> ProjectionOptions:
        near, far = (self.scene_unit * plane for plane in (ProjectionOptions.near_plane, ProjectionOptions.far_plane))
        if self.config.near_plane == "auto":
            near = max(near, self.near)
        # In training the guard finds numbers that are not finite.
        return ProjectionOptions(self.config.rasterize_mode, near, far, assume_finite=self.training)

    def _photograph_of(self, camera: Cameras) -> int | None:
        """Index of the photograph whose look a rendering has: in training the camera's own; None: the mean of all."""
        if self.training:
            return (camera.metadata or {}).get("cam_idx")
        return None if self.photograph is None else self._requested_photograph()

    def _requested_photograph(self) -> int | None:
        """Index of the photograph that LOOK names; None, with a warning, if no exposures have been learnt.

        Raises:
            InputError: there is no such photograph.
        """
        name = os.environ.get(LOOK)
        if not name:
            return None
        if self.photograph is None:
            warn(f"{LOOK} is {name!r}, but this model has learnt no photograph's exposure: renderings have one look.")
            return None
        names = self.photograph.names
        if name not in names:
            raise InputError(f"{LOOK} is {name!r}, which is not a training photograph, such as {names[0]!r}.")
        return names.index(name)

    def look_of(self, index: int | None) -> Look | None:
        """The learnt exposure model of the photograph `index`, for `composite_view`; None: the mean of all."""
        return None if index is None or self.photograph is None else lambda rgb: self.photograph(rgb, index)

    def noisy(self, field: Field) -> Field:
        """A field as its head sees it: in training with means moved by `ViewNoise`."""
        noise = self.view_noise.generator(self.device, self.step) if self.training else None
        return field._replace(splats=self.view_noise.moved(field.splats, noise))

    def render_view(
        self, view: View, noisy: Field, look: Look | None, is_between: bool = False
    ) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """`composite_view` of a field as its head sees it (`noisy`), with a look (`look_of`): in evaluation, in the
        eager and in the recorded step. In training, densification looks at it. `is_between`: over what a twin's picture
        is over (`training/twin.py`)."""
        appearance = noisy.seen_from(view)
        black = torch.zeros(3, device=self.device) if is_between and self.photograph is not None else None
        outputs, info = self.composite(view, appearance, black, look)
        if self.training:
            shown = appearance.opacities
            stored = noisy.splats["opacities"]
            if view.every_row:  # splats that are not visible have their stored opacity
                shown = torch.where(info["radii"] > 0, shown, torch.sigmoid(stored).flatten())
            self.densification.pre_backward(self.step, info, shown, stored)
        return outputs, info

    def composite(
        self, view: View, appearance: SplatAppearance, background: Tensor | None = None, look: Look | None = None
    ) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """`composite_view` of any appearance as this model is configured, with a look (`look_of`), over a background
        [3] or the configured one."""
        background = self._get_background_color() if background is None else background
        image_of = self.head.image_of if self.head.at_pixel else None
        absgrad = self.training and self.densification.needs_absgrad(self.step)
        options = {"with_depth": not self.training, "absgrad": absgrad, "assume_finite": self.training}
        return composite_view(view, appearance, background, image_of=image_of, look=look, **options)

    def render(self, field: Field, camera: Cameras, noisy: Field) -> dict[str, Tensor]:
        """Render any field as `get_outputs` renders the model's own; `noisy`: as its head sees it, with or without
        noise."""
        view = self.project(camera, field.splats)
        return self.composite(view, noisy.seen_from(view), look=self.look_of(self._photograph_of(camera)))[0]

    @torch.no_grad()
    def get_base_color(self, camera: Cameras) -> Tensor:
        """The image [H, W, 3] of the base colours and opacities alone."""
        view = self.project(camera)
        return self.composite(view, self.field.base_of(view))[0]["rgb"]

    def picture(self, view: View, field: Field, look: Look | None) -> Tensor:
        """A rendering as a photograph for a twin (`training/twin.py`), uint8 [H, W, 4], transparent where nothing is
        drawn; [H, W, 3] over black where photographs' exposures are learnt, which are not of transparent ones."""
        outputs, _ = self.composite(view, field.seen_from(view), torch.zeros(3, device=self.device), look)
        rgb, alpha = outputs["rgb"], outputs["accumulation"]
        if self.photograph is None:
            rgb = torch.cat([rgb / alpha.clamp_min(1e-6), alpha], dim=-1)
        return (255 * rgb).round().clamp(0, 255).byte()

    def set_background(self, background_color: Tensor) -> None:
        """Set the background [3] of the viewer's pictures alone: evaluation keeps its own."""
        if self.viewer_panel is not None:
            self.viewer_panel.background = background_color

    # Training.

    def get_training_callbacks(self, attributes: TrainingCallbackAttributes) -> list[TrainingCallback]:
        cameras = attributes.pipeline.datamanager.train_dataset.cameras
        centers = cameras.camera_to_worlds[:, :3, 3]
        smallest, halvings = int(min(cameras.width.min(), cameras.height.min())), self.config.num_downscales
        left = f"so many that 2 of the smallest image's {smallest} pixels are left"
        require(smallest >> halvings > 1, "pipeline.model.num_downscales", halvings, left)
        self.densification.begin(centers, self.num_points, int((cameras.width * cameras.height).max()))
        self.view_noise = ViewNoise(self.noise_factor * camera_spacing(centers), self.view_noise.seed)

        steps = len(cameras) if self.config.warmup_steps is None else self.config.warmup_steps
        when = TrainingCallbackLocation
        callbacks = [
            TrainingCallback([when.BEFORE_TRAIN_ITERATION], lambda step: warm_up(self, cameras, steps), iters=(0,)),
            *super().get_training_callbacks(attributes),
        ]
        if self.photograph is not None:
            callbacks.append(TrainingCallback([when.AFTER_TRAIN_ITERATION], lambda step: self.photograph.center_()))
        return callbacks

    def step_cb(self, optimizers, step: int) -> None:
        super().step_cb(optimizers, step)
        self.head.set_step(self.schedule_step)

    @property
    def schedule_step(self) -> int:
        """The step at which the schedules of the head and the resolution are."""
        return self.step if self._scheduled is None else self._scheduled

    def schedule_at(self, step: int) -> None:
        """Set the schedules' step, which follows the training's pace, from now on."""
        self._scheduled = step

    def get_loss_dict(self, outputs, batch, metrics_dict=None) -> dict[str, Tensor]:
        """The terms of the loss by name (`loss_of`)."""
        losses = loss_of(self, self.gauss_params, outputs, batch)
        if self.training:
            self.watch(outputs, losses, batch)
        return losses

    def watch(self, outputs: Mapping[str, Tensor], losses: Mapping[str, Tensor], batch: Mapping[str, Any]) -> None:
        """Have the guard look at a step's image and losses."""
        watched = {"the rendered image": outputs["rgb"], **{f"loss {name}": loss for name, loss in losses.items()}}
        self.watched = {name: value.detach() for name, value in watched.items()}
        self.watched_image = batch.get("image_idx")

    def truth_of(self, batch: Mapping[str, Any], background: Tensor) -> Tensor:
        """The photograph at the rendered size, over the background where it is transparent. [H, W, 3]"""
        image = self.get_gt_img(batch["image"])
        if image.shape[-1] == 4 and self.training and self.photograph is not None:
            with torch.no_grad():
                background = self.photograph(background.expand(*image.shape[:2], 3), batch["image_idx"])
        return self.composite_with_background(image, background)

    def mask_of(self, batch: Mapping[str, Any]) -> Tensor | None:
        """The image's mask at the rendered size, bool [H, W, 1], or None. Half-covered pixels are inside."""
        if "mask" not in batch:
            return None
        return self._downscale_if_required(batch["mask"]).to(self.device) >= 0.5

    def step_post_backward(self, step: int) -> None:
        self.densification.post_backward(step, self.info, self.gauss_params, self.optimizers)

    # Metrics.

    @torch.no_grad()
    def get_metrics_dict(self, outputs, batch) -> dict[str, Any]:
        """PSNR inside the mask and the number of splats, for logs. Nothing waits for the GPU."""
        error = (outputs["rgb"] - self.truth_of(batch, outputs["background"])).square().mean(dim=-1, keepdim=True)
        mask = self.mask_of(batch)
        mse = error.mean() if mask is None else (error * mask).sum() / mask.sum()
        metrics = {"psnr": -10.0 * torch.log10(mse), "gaussian_count": self.num_splats}
        self.camera_optimizer.get_metrics_dict(metrics)
        return metrics

    def get_image_metrics_and_images(self, outputs, batch) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Metrics of one image, inside the mask if there is one, and truth and rendering side by side.

        A metric without a value (LPIPS without its weights, MS-SSIM of a small image) is left out.
        """
        rgb = outputs["rgb"]
        truth = self.truth_of(batch, outputs["background"])
        metrics = image_metrics(rgb, truth, self.mask_of(batch)).items()
        return {name: value for name, value in metrics if value is not None}, {"img": torch.cat([truth, rgb], dim=1)}

    # Checkpoints.

    def update_to_step(self, step: int) -> None:
        self.step = step
        self.head.set_step(step)

    def get_extra_state(self) -> dict[str, Any]:
        """A checkpoint's contents besides tensors."""
        state = {
            "head": self.head.name,
            "densification": self.densification.name,
            "strategy": dict(self.densification.state),
            "views": self.num_views,
            "near": self.near,
        }
        if suited := differences(self.config.appearance, self.head.config):
            state["capacity"] = {"head": suited}
        return state if self._scheduled is None else {**state, "schedule_step": self._scheduled}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        if state["densification"] != self.densification.name:
            fix = f"{self.densification.name} cannot go on from its statistics. Set it back, or train anew."
            raise InputError(f"The checkpoint has --pipeline.model.densification {state['densification']}; {fix}")
        self.densification.load_state(state["strategy"], self.device)
        self.num_views = state.get("views", self.num_train_data)
        self.near = state.get("near", 0.0)
        if "schedule_step" in state:
            self.schedule_at(state["schedule_step"])
            self.head.set_step(self.schedule_step)

    def load_state_dict(self, state: dict[str, Any], strict: bool = True, **kwargs):
        """Load a checkpoint with any number of splats.

        Parameters are resized in place: the optimisers, which are built before a checkpoint is read, hold these very
        objects.

        Raises:
            InputError: the checkpoint belongs to another head, or to another size of this one.
        """
        self._match_head(reduced_config(self.config.appearance, state))
        photographs = photographs_of(state)
        if photographs is None or self.photograph is None:  # a training's optimisers hold its own
            self.photograph = None if photographs is None else photographs.to(self.device)
        self._requested_photograph()
        check_compatible(self, state)
        for name, parameter in self.gauss_params.items():
            parameter.data = parameter.data.new_zeros(state[f"gauss_params.{name}"].shape)
        return super(SplatfactoModel, self).load_state_dict(state, strict=strict, **kwargs)

    def _match_head(self, config: AppearanceHeadConfig) -> None:
        """Build the head anew where a checkpoint's has another configuration; its weights come later."""
        if config == self.head.config:
            return
        self.head = config.setup(self.scene_unit).to(self.device).train(self.training)
        for name, value in self.head.splat_params(self.gauss_params["means"]).items():
            self.gauss_params[name].data = value.to(self.device)
