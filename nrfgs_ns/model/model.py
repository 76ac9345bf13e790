# SPDX-License-Identifier: Apache-2.0
"""Splatfacto with an appearance head: what nerfstudio asks of a model, in the order of a training.

How a camera is rendered is in `renderer.py`, how splats come and go in `densification/`, what the splats start from in
`initial_splats.py`. Loss, schedules and crop are nerfstudio's. What differs: colours and opacities come from the head,
for the splats that the camera sees only; nothing needs CUDA; metrics respect masks; and loading a checkpoint keeps the
parameter objects that the optimisers hold, so that an interrupted training can go on.
"""

from collections.abc import Mapping
from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.model_components.lib_bilagrid import BilateralGrid
from nerfstudio.models.splatfacto import SplatfactoModel
from nerfstudio.utils.colors import get_color
from torch import Tensor
from torch.nn import Parameter, ParameterDict

from nrfgs_ns.appearance.field import DIFFUSE, Field
from nrfgs_ns.appearance.head import SplatAppearance, base_colors
from nrfgs_ns.densification import Densification
from nrfgs_ns.errors import InputError
from nrfgs_ns.image import robust
from nrfgs_ns.image.metrics import image_metrics
from nrfgs_ns.image.photograph import PhotographModel
from nrfgs_ns.model.checkpoint import check_compatible, differences, reduced_config
from nrfgs_ns.model.config import NrfgsModelConfig
from nrfgs_ns.model.harmonics_fit import DEGREE, Fit, fit_harmonics
from nrfgs_ns.model.harmonics_tune import fine_tune
from nrfgs_ns.model.initial_splats import initial_splats
from nrfgs_ns.model.look import look_asked_for, warn_if_asked
from nrfgs_ns.model.loss import loss_of, photometric
from nrfgs_ns.model.pinhole import Pinhole, Pinholes
from nrfgs_ns.model.renderer import View, composite_view, project_view, projection_options
from nrfgs_ns.model.training_views import TrainingPictures
from nrfgs_ns.model.view_noise import ViewNoise, camera_spacing
from nrfgs_ns.model.warmup import warm_up
from nrfgs_ns.rasterizer import ProjectionOptions

NEAR_SHARE = 0.5
"""Near plane of `near_plane` auto, in nearest depths."""
VISER_BACKGROUND = (0.1490, 0.1647, 0.2157)
"""What a training with random backgrounds is evaluated on: viser's default grey, as in splatfacto."""


class NrfgsModel(SplatfactoModel):
    """Gaussian splatting with an appearance head. Wherever it takes a camera, that is a batch of one, [1].

    Args:
        config: which head, and splatfacto's options.
        seed_points: points [P, 3] in world units and their colours [P, 3] in 0..255, to start from.
    """

    config: NrfgsModelConfig
    reduced_head: dict[str, Any] | None = None
    """options of the head that are not the configuration's: those that a checkpoint or the number of views decides"""
    camera_spacing: float = 0.0
    """world units between neighbouring training cameras; 0 until a training begins"""
    viewer_panel: Any = None
    """who says what a browser sees (`show_by`); None: there is no viewer"""
    _scheduled: int | None = None
    _fit_cameras: Cameras | None = None
    _fit_steps: int | None = None
    _fit: Fit | None = None

    def populate_modules(self):
        # Splatfacto's own populate_modules calls .cuda() and builds LPIPS, which downloads: it cannot be extended.
        config = self.config
        config.check()
        metadata = self.kwargs.get("metadata") or {}
        self.scene_unit: float = metadata.get("scene_unit", 1.0)
        """World units in a scene unit; lengths in the configuration are in scene units."""
        self.num_views: int = metadata.get("different_views", self.num_train_data)
        """Training views that differ (`data.views.different_views`), or as many as a checkpoint's training counted."""
        self.nearest_depth: float = metadata.get("nearest_depth", 0.0)
        """Depth at which training cameras see the nearest points (`data.views.nearest_depth`), or a checkpoint's."""
        config.appearance.validate()
        appearance = config.suited_appearance(self.num_views)
        self.reduced_head = differences(config.appearance, appearance) or None
        self.head = appearance.setup(self.scene_unit)
        config.sh_degree = self.head.sh_degree
        self._seed = torch.initial_seed()
        self.gauss_params = self._splats_to_start_from()
        self.camera_optimizer = config.camera_optimizer.setup(num_cameras=self.num_train_data, device="cpu")
        if config.use_bilateral_grid:
            self.bil_grids = BilateralGrid(self.num_train_data, *config.grid_shape)

        self.photograph: PhotographModel | None = None  # the pipeline knows the photographs
        self.trimming = robust.Trimming(config.robust_loss) if config.robust_loss > 0.0 else None
        self.step = 0
        self.crop_box = None
        self.pinholes = Pinholes()
        self.background_color = (
            torch.tensor(VISER_BACKGROUND)
            if config.background_color == "random"
            else get_color(config.background_color)
        )
        self.densification = self._strategy()
        self.view_noise = ViewNoise(0.0, torch.initial_seed())  # until the training cameras are known

    @property
    def trust(self) -> float:
        """How far the training views trust the head, in (0, 1]."""
        return self.config.trust(self.num_views)

    @property
    def noise_factor(self) -> float:
        """Length of the noise on where the head is asked from, in spacings of the training cameras."""
        return self.config.view_noise / self.trust

    def _initial_splats(self) -> dict[str, Tensor]:
        """The table of splats to start from."""
        return initial_splats(self.config, self.head, self.seed_points, self.scene_unit)

    def _splats_to_start_from(self) -> ParameterDict:
        return ParameterDict({name: Parameter(value) for name, value in self._initial_splats().items()})

    def start_from(self, seed_points: tuple[Tensor, Tensor]) -> None:
        """Before a training: start from other points, positions [P, 3] and colours [P, 3] in 0..255."""
        self.seed_points = seed_points
        with torch.random.fork_rng(devices=[]):  # as on a single device, whatever generators a device has by now
            torch.default_generator.manual_seed(self._seed)
            self.gauss_params = self._splats_to_start_from().to(self.device)

    def _strategy(self) -> Densification:
        """What makes splats come and go."""
        return self.config.densification.build(self.num_train_data, self.scene_unit)

    def learn_photographs(self, photographs: PhotographModel | None) -> None:
        """Let each photograph's look be learnt; None: all have one look."""
        self.photograph = None if photographs is None else photographs.to(self.device)
        if self.photograph is not None:
            look_asked_for(self.photograph)  # a name that is none is told before the first evaluation

    def get_gaussian_param_groups(self) -> dict[str, list[Parameter]]:
        return {name: [parameter] for name, parameter in self.gauss_params.items()}

    def get_param_groups(self) -> dict[str, list[Parameter]]:
        """One group for each per-splat tensor, "field" for the head's shared weights if it has any, "photograph" for
        the photographs' exposures if they are learnt."""
        groups = super().get_param_groups()
        others = {"field": list(self.head.parameters())}
        if self.photograph is not None:
            others["photograph"] = list(self.photograph.parameters())
        return {**groups, **{name: parameters for name, parameters in others.items() if parameters}}

    @property
    def parameter_bytes(self) -> int:
        """Bytes of all that a renderer needs: the head and the splats' parameters, of diffuse ones the base alone."""
        stored = [*self.gauss_params.values(), *self.head.parameters()]
        whole = sum(parameter.numel() * parameter.element_size() for parameter in stored)
        row = sum(self.gauss_params[name][:1].nbytes for name in self.head.residual_params)
        return whole - self.num_diffuse * row

    @property
    def num_diffuse(self) -> int:
        """How many splats have no residual."""
        diffuse = self.densification.diffuse
        return 0 if diffuse is None else int(diffuse.sum())

    # Rendering.

    @property
    def field(self) -> Field:
        """What is rendered: the head with all splats, or those in the crop box, and which of them are diffuse."""
        splats: dict[str, Tensor] = dict(self.gauss_params.items())
        if (diffuse := self.densification.diffuse) is not None:
            splats[DIFFUSE] = diffuse
        if self.crop_box is not None and not self.training:
            inside = self.crop_box.within(splats["means"]).reshape(-1)
            splats = {name: value[inside] for name, value in splats.items()}
        return Field(self.head, splats)

    @property
    def projection_options(self) -> ProjectionOptions:
        """How this model projects its splats."""
        near = NEAR_SHARE * self.nearest_depth if self.config.near_plane == "auto" else 0.0
        # In training the guard looks for what is not finite.
        return projection_options(self.config.rasterize_mode, self.scene_unit, near, assume_finite=self.training)

    def project(self, camera: Cameras, splats: Mapping[str, Tensor] | None = None) -> View:
        """Project splats into a camera (`project_view`): the field's, or another table."""
        splats = self.field.splats if splats is None else splats
        return project_view(splats, self.pinhole(camera), self.projection_options)

    def composite(
        self,
        view: View,
        appearance: SplatAppearance,
        background: Tensor | None = None,
        photograph: int | None = None,
    ) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Composite visible splats as this model is configured (`composite_view`).

        Args:
            background: a colour [3] instead of the configuration's.
            photograph: the picture has the look of this one; None: the mean look.
        """
        return composite_view(
            view,
            appearance,
            self._get_background_color() if background is None else background,
            with_depth=self.config.output_depth_during_training or not self.training,
            absgrad=self.training and self.densification.needs_absgrad(self.step),
            assume_finite=self.training,
            look=None if photograph is None else lambda rgb: self.photograph(rgb, photograph),
        )

    def pinhole(self, camera: Cameras) -> Pinhole:
        """The camera for the rasterizer; training cameras whose pose is not learnt are converted once."""
        if not self.training:
            return self.pinholes.fixed(camera, self.device)
        learnt = self.camera_optimizer if self.camera_optimizer.config.mode != "off" else None
        return self.pinholes.of_training(camera, self._get_downscale_factor(), learnt)

    def _get_downscale_factor(self) -> int:
        if not self.training:
            return 1
        risen = self.schedule_step // self.config.resolution_schedule
        return 2 ** max(self.config.num_downscales - risen, 0)

    def get_outputs(self, camera: Cameras) -> dict[str, Tensor]:
        """Render one camera.

        Returns:
            "rgb" [H, W, 3] in [0, 1], "accumulation" [H, W, 1], "background" [3] in training and [H, W, 3] otherwise,
            and "depth" [H, W, 1], which is left out of training unless `output_depth_during_training`.
        """
        field = self.field
        outputs, appearance = self.render(field, camera, self._as_learnt(field))
        if self.training:
            self.densification.pre_backward(self.step, self.info, appearance.opacities, self.gauss_params["opacities"])
        return outputs

    def render(self, field: Field, camera: Cameras, asked: Field) -> tuple[dict[str, Tensor], SplatAppearance]:
        """Render a field, which need not be the model's own, as `get_outputs` renders that.

        Args:
            field: what is drawn.
            asked: the same field as its head is asked about it, with or without noise.

        Returns:
            what `get_outputs` does, and what the visible splats look like.
        """
        view = self.project(camera, field.splats)
        appearance = asked.seen_from(view)
        outputs, self.info = self.picture(view, appearance, camera)
        return outputs, appearance

    def picture(
        self, view: View, appearance: SplatAppearance, camera: Cameras, background: Tensor | None = None
    ) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """What a camera sees, composited for `get_outputs`: in training with the look of its photograph."""
        background = self._get_background_color() if background is None else background
        outputs, info = self.composite(view, appearance, background, self._photograph_of(camera))
        if self.training:
            outputs["background"] = background
            if self.config.use_bilateral_grid and "cam_idx" in (camera.metadata or {}):
                rgb, index = outputs["rgb"], camera.metadata["cam_idx"]
                outputs["rgb"] = self._apply_bilateral_grid(rgb[None], index, *rgb.shape[:2])[0]
        return outputs, info

    def _photograph_of(self, camera: Cameras) -> int | None:
        """Which photograph's look a rendering has: in training, the one that the camera took; None: the mean look."""
        if self.photograph is None:
            return None
        return (camera.metadata or {}).get("cam_idx") if self.training else look_asked_for(self.photograph)

    def _as_learnt(self, field: Field) -> Field:
        """The field as its head is asked about it in this step: under noise (`view_noise.py`) in training."""
        if not self.training:
            return field
        return field._replace(splats=self.view_noise.moved(field.splats, self.step))

    @torch.no_grad()
    def get_base_color(self, camera: Cameras) -> Tensor:
        """The image [H, W, 3] of the base colours and opacities alone, without what depends on the view."""
        field = self.field
        view = self.project(camera, field.splats)
        return self.composite(view, field.base_of(view))[0]["rgb"]

    @torch.no_grad()
    def get_outputs_for_camera(self, camera: Cameras, obb_box: OrientedBox | None = None) -> dict[str, Tensor]:
        """Render one camera as it was trained; for a browser, as the viewer's panel says.

        Nerfstudio moves the camera to the GPU first, where the host must wait to learn its size.

        Args:
            obb_box: only splats with their centre inside are drawn, if given.
        """
        if self.viewer_panel is not None and self.viewer_panel.is_asking():
            return self.viewer_panel.render(camera, obb_box)
        self.set_crop(obb_box)
        return self.get_outputs(camera.to(self.device) if self.training else camera)

    # Training.

    def get_training_callbacks(self, attributes: TrainingCallbackAttributes) -> list[TrainingCallback]:
        cameras = attributes.pipeline.datamanager.train_dataset.cameras
        centers = cameras.camera_to_worlds[:, :3, 3]
        views = TrainingPictures(self, attributes.pipeline.datamanager)
        self.densification.begin(centers, views, self.num_points)
        self.camera_spacing = camera_spacing(centers)
        self.view_noise = ViewNoise.as_long_as(self.noise_factor * self.camera_spacing, self.view_noise.seed)

        def before_first_step(step: int) -> None:
            steps = len(cameras) if self.config.warmup_steps is None else self.config.warmup_steps
            warm_up(self, cameras, steps)

        callbacks = [
            TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], before_first_step, iters=(0,)),
            *super().get_training_callbacks(attributes),
        ]
        if self.photograph is not None:
            after = [TrainingCallbackLocation.AFTER_TRAIN_ITERATION]
            callbacks.append(TrainingCallback(after, lambda step: self.photograph.center_()))
        return callbacks

    def far_from_neutral(
        self, camera: Cameras, weights: list[Parameter]
    ) -> tuple[int, Tensor, tuple[Tensor, ...]] | None:
        """How far the head is from adding nothing to what a camera sees, for the warm-up.

        Args:
            weights: the head's shared weights.

        Returns:
            The number of visible splats; the head's neutral loss, NaN if that is 0; its gradients by the weights. None
            if there is nothing that could be taught.
        """
        with torch.no_grad():
            view = self.project(camera)
        loss = self.head.neutral_loss(self.field.splats, view.visible, view.center)
        if loss is None:
            return None
        # Only the shared weights learn: the splats' parameters keep no gradient from here.
        return len(view.visible), loss.detach(), torch.autograd.grad(loss, weights)

    def step_cb(self, optimizers, step: int) -> None:
        super().step_cb(optimizers, step)
        self.head.set_step(self.schedule_step)

    @property
    def schedule_step(self) -> int:
        """The step that the head and the resolution are scheduled by."""
        return self.step if self._scheduled is None else self._scheduled

    def schedule_at(self, step: int) -> None:
        """Look schedules up at another step than the training's, from now on: it walks through them at a pace."""
        self._scheduled = step

    def get_loss_dict(self, outputs, batch, metrics_dict=None) -> dict[str, Tensor]:
        """The terms of the loss by name (`loss.loss_of`)."""
        losses = loss_of(self, self.gauss_params, outputs, batch)
        if self.training:
            watched = {"the rendered image": outputs["rgb"], **{f"loss {name}": loss for name, loss in losses.items()}}
            self.watched = {name: value.detach() for name, value in watched.items()}  # by the training's guard
            self.watched_image = batch.get("image_idx")
        return losses

    def photometric_loss(self, outputs, batch) -> Tensor:
        """Splatfacto's loss of an image against its photograph (`loss.photometric`)."""
        return photometric(self, outputs, batch)

    def truth_of(self, batch: Mapping[str, Any], background: Tensor) -> Tensor:
        """The photograph at the rendered size, [H, W, 3]; where it is transparent, with what is behind the splats."""
        image = self.get_gt_img(batch["image"])
        if image.shape[-1] == 4 and self.training and self.photograph is not None:
            with torch.no_grad():
                background = self.photograph(background.expand(*image.shape[:2], 3), batch["image_idx"])
        return self.composite_with_background(image, background)

    def mask_of(self, batch: Mapping[str, Any]) -> Tensor | None:
        """The image's mask at the rendered size, bool [H, W, 1], or None. A pixel half covered counts as inside."""
        if "mask" not in batch:
            return None
        return self._downscale_if_required(batch["mask"]).to(self.device) >= 0.5

    def step_post_backward(self, step: int) -> None:
        assert step == self.step
        self.densification.post_backward(step, self.info, self.gauss_params, self.optimizers)

    # Metrics.

    @torch.no_grad()
    def get_metrics_dict(self, outputs, batch) -> dict[str, Any]:
        """What is logged while training: PSNR (inside the mask) and the number of splats. Nothing waits for the GPU."""
        truth = self.truth_of(batch, outputs["background"])
        error = (outputs["rgb"] - truth).square().mean(dim=-1, keepdim=True)
        mask = self.mask_of(batch)
        mse = error.mean() if mask is None else (error * mask).sum() / mask.sum()
        metrics = {"psnr": -10.0 * torch.log10(mse), "gaussian_count": self.num_points}
        self.camera_optimizer.get_metrics_dict(metrics)
        return metrics

    def get_image_metrics_and_images(self, outputs, batch) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Metrics of one image, inside the mask if there is one, and truth and rendering side by side.

        A metric that cannot be had (LPIPS without its weights, MS-SSIM of a small image) is left out.
        """
        truth = self.truth_of(batch, outputs["background"])
        rgb = outputs["rgb"]
        metrics = image_metrics(rgb, truth, self.mask_of(batch))
        return (
            {name: value for name, value in metrics.items() if value is not None},
            {"img": torch.cat([truth, rgb], dim=1)},
        )

    # Viewer and exporter. The exporter reads splats with spherical harmonics, whatever the head is. Where `fit_on` was
    # called, as neither a training nor a viewer does, they are harmonics fitted to the head (`harmonics_fit.py`).

    def show_by(self, panel: Any) -> None:
        """Let a viewer's panel (`viewer/panel.py`) say what its browsers see."""
        self.viewer_panel = panel

    def set_background(self, background_color: Tensor) -> None:
        """Take the viewer's background [3], for the viewer's pictures alone: what evaluation uses must not change."""
        if self.viewer_panel is not None:
            self.viewer_panel.set_background(background_color)

    def fit_on(self, cameras: Cameras, steps: int | None = None) -> None:
        """Let the properties below be fitted harmonics from now on, as seen from these cameras [V].

        The fit is made when one of them is first read, with so many steps of fine-tune (`harmonics_tune.py`; None: as
        many as suit the device), and kept until a checkpoint is loaded.
        """
        self._fit_cameras, self._fit_steps, self._fit = cameras, steps, None
        self.config.sh_degree = DEGREE

    @property
    def fit(self) -> Fit | None:
        """The fitted harmonics, or None where `fit_on` was not called."""
        if self._fit is None and self._fit_cameras is not None:
            self._fit = fit_harmonics(self, self._fit_cameras)
            if not self._fit.exact:
                self._fit = self._fit._replace(
                    splats=fine_tune(self, self._fit.splats, self._fit_cameras, self._fit_steps)
                )
        return self._fit

    def _exported(self, name: str) -> Tensor:
        """A table of the splats: the fit's if there is one, else the stored one."""
        fit = self.fit
        return self.gauss_params[name] if fit is None else getattr(fit.splats, name)

    @property
    def colors(self) -> Tensor:
        """Base colours [N, 3]."""
        return base_colors(self.shs_0)

    @property
    def opacities(self) -> Tensor:
        """Opacities' logits [N, 1]."""
        return self._exported("opacities")

    @property
    def quats(self) -> Tensor:
        """Rotations (w, x, y, z) [N, 4]; of unit length if fitted."""
        return self._exported("quats")

    @property
    def shs_0(self) -> Tensor:
        """Coefficients of the constant harmonic [N, 3]."""
        return self._exported("features_dc")

    @property
    def shs_rest(self) -> Tensor:
        """Coefficients of the higher harmonics [N, B, 3]; B = 0 for a head without any, unless they are fitted."""
        return self.features_rest if self.fit is None else self.fit.splats.features_rest

    @property
    def features_rest(self) -> Tensor:
        """The stored coefficients of the higher harmonics [N, B, 3]; B = 0 for a head without any."""
        if "features_rest" in self.gauss_params:
            return self.gauss_params["features_rest"]
        return self.features_dc.new_zeros(self.num_points, 0, 3)

    # Checkpoints.

    def update_to_step(self, step: int) -> None:
        self.step = step
        self.head.set_step(step)

    def get_extra_state(self) -> dict[str, Any]:
        """What a checkpoint holds beside tensors."""
        state = {
            "head": self.head.name,
            "densification": self.densification.name,
            "strategy": dict(self.densification.state),
        }
        if self.reduced_head is not None:
            state["capacity"] = {"head": self.reduced_head}
        if self.num_views != self.num_train_data:
            state["views"] = self.num_views
        if self.nearest_depth > 0:
            state["nearest_depth"] = self.nearest_depth
        return state if self._scheduled is None else {**state, "schedule_step": self._scheduled}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        if state["densification"] != self.densification.name:
            raise InputError(
                f"The checkpoint was trained with --pipeline.model.densification {state['densification']}, this model "
                f"with {self.densification.name}, which cannot go on from its statistics. Set it back, or train anew."
            )
        self.densification.load_state(state["strategy"], self.device)
        self.num_views = state.get("views", self.num_train_data)
        self.nearest_depth = state.get("nearest_depth", 0.0)
        if "schedule_step" in state:
            self.schedule_at(state["schedule_step"])
            self.head.set_step(self.schedule_step)

    def load_state_dict(self, state: dict[str, Any], strict: bool = True, **kwargs):
        """Load a checkpoint with any number of splats.

        The parameters are resized in place: the optimisers were built on these very objects before the checkpoint was
        read, and would go on training orphans if they were replaced.

        Raises:
            InputError: the checkpoint belongs to another head, or to another size of this one.
        """
        self._shape_head(state)
        self._take_photographs(state)
        check_compatible(self, state)
        self._fit = None
        for name, parameter in self.gauss_params.items():
            parameter.data = parameter.data.new_zeros(state[f"gauss_params.{name}"].shape)
        return super(SplatfactoModel, self).load_state_dict(state, strict=strict, **kwargs)

    def _take_photographs(self, state: dict[str, Any]) -> None:
        """Know the photographs that a checkpoint knows; a training, whose optimisers hold them, knows them already."""
        prefix = "photograph."
        known = {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}
        if not known:
            self.photograph = None
            warn_if_asked()
        elif self.photograph is None:
            self.photograph = PhotographModel.from_state(known).to(self.device)

    def _shape_head(self, state: dict[str, Any]) -> None:
        """Take the head of a checkpoint that has a smaller one than the configuration; its weights come later."""
        config = reduced_config(self.config.appearance, state)
        self.reduced_head = state.get("_extra_state", {}).get("capacity", {}).get("head")
        if config == self.head.config:
            return
        head = config.setup(self.scene_unit)
        self.head = head.to(self.device).train(self.training)
        for name, value in head.splat_params(self.gauss_params["means"]).items():
            # In place: the optimiser was built on this very parameter.
            self.gauss_params[name].data = value.to(self.device)
