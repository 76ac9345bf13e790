# SPDX-License-Identifier: Apache-2.0
"""A second training beside the first one, with which it must agree between the cameras.

Two trainings of one capture from two seeds show the same where the photographs decide what is there. Elsewhere each
makes up its own (CoR-GS: Zhang et al. 2024). So every few steps each model also descends the photometric loss of a view
between two training cameras, with the other model's picture of that view as the photograph. Checkpoints hold both, for
the training to go on; commands read the first.
"""

import functools
import math
from copy import copy, deepcopy
from random import Random
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.engine.callbacks import TrainingCallbackAttributes, TrainingCallbackLocation
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from nrfgs_ns.data.views import camera_spacing
from nrfgs_ns.errors import InputError
from nrfgs_ns.model.loss import loss_of
from nrfgs_ns.training.guard import Guard
from nrfgs_ns.training.optimizers import LeanOptimizers, parameters_of
from nrfgs_ns.training.pipeline import Gradients, descend
from nrfgs_ns.training.step_graph import StepGraphs

START = 6_000
"""Step of the schedules from which trainings agree; the resolution must be full, too."""
EVERY = 2
"""Steps from one agreement to the next with few training views."""
VIEWS = 50.0
"""Training views with which agreements are e times as rare."""
RAREST = 6
"""Steps between agreements, with more than 50 training views, from which a twin is not worth its time."""
NEIGHBOURS = 4
"""Training cameras that count as neighbours of one."""
TURN = 3.0
"""Distances between neighbouring cameras that count as much as turning around by one radian."""
PULLED = "means", "scales", "quats", "opacities", "features_dc"
"""Tensors that agreements change where the head has a network. The head's own tensors learn from photographs alone,
since two networks would drift in colour together; harmonics do not (results/twin.json)."""
JITTER = 0.25
"""Standard deviation of a view's distance from the line between two cameras, in distances between neighbours."""


class Between:
    """Views between neighbouring training cameras.

    Args:
        cameras: the training's, in host memory, [V].
    """

    def __init__(self, cameras: Cameras):
        self.views = [cameras[index : index + 1] for index in range(len(cameras))]
        self.poses = cameras.camera_to_worlds.double().numpy()
        centers, backward = cameras.camera_to_worlds[..., 3], cameras.camera_to_worlds[..., 2]
        self.spacing = camera_spacing(centers)
        places = torch.cat([centers / max(self.spacing, 1e-12), TURN * backward], dim=1)
        distances = torch.cdist(places, places, compute_mode="donot_use_mm_for_euclid_dist").fill_diagonal_(math.inf)
        count = max(min(NEIGHBOURS, len(cameras) - 1), 1)
        self.neighbours = distances.topk(count, largest=False).indices.tolist()
        self._turn = functools.cache(lambda *pair: Slerp([0, 1], Rotation.from_matrix(self.poses[[*pair], :, :3])))

    def draw(self, random: Random) -> Cameras:
        """A view between a camera and one of its neighbours, with the first one's lens. [1], in host memory."""
        index = random.randrange(len(self.views))
        other = random.choice(self.neighbours[index])
        share = random.random()
        jitter = [random.gauss(0.0, JITTER * self.spacing) for _ in range(3)]
        center = (1 - share) * self.poses[index, :, 3] + share * self.poses[other, :, 3] + jitter
        view = copy(self.views[index])
        pose = np.column_stack([self._turn(index, other)(share).as_matrix(), center])
        view.camera_to_worlds = torch.from_numpy(pose[None]).float()
        view.metadata = {"cam_idx": index, "between": True}
        return view


class Twin:
    """The second training of a trainer. It draws photographs from the same datamanager.

    Attributes:
        every: steps from one agreement to the next.
        pipeline, guard, optimizers, graphs, world_size: as the trainer's, of the second model.
    """

    world_size = 1

    def __init__(self, trainer, every: int):
        self.trainer, self.every, model = trainer, every, trainer.pipeline.model
        self.between = Between(trainer.pipeline.datamanager.train_dataset.cameras)
        given = {"scene_box": model.scene_box, "num_train_data": model.num_train_data, **model.kwargs}
        with torch.random.fork_rng(devices=[]):
            torch.default_generator.manual_seed(model._seed + 1)
            second = model.config.setup(seed_points=model.seed_points, **given).to(model.device)
        second.learn_photographs(deepcopy(model.photograph))
        second.densification.verbose = False
        if model.device.type == "cuda":
            second.head.try_kernels(model.device)
        self.pipeline = copy(trainer.pipeline)
        self.pipeline._modules = {**trainer.pipeline._modules, "_model": second}
        self.guard = Guard(self.pipeline)
        configs = {name: {**parts, "scheduler": None} for name, parts in trainer.optimizer_configs().items()}
        self.optimizers = LeanOptimizers(configs, second.get_param_groups())
        self.graphs = StepGraphs(second, self.pipeline.datamanager, self.guard)

    def begin(self) -> None:
        """Prepare for the first step, once a checkpoint has been loaded."""
        for model in (self.trainer.pipeline.model, self.pipeline.model):
            model.densification.trainings = 2
        attributes = TrainingCallbackAttributes(self.optimizers, None, self.pipeline, None)
        self.callbacks = self.pipeline.model.get_training_callbacks(attributes)

    def make_step(self, step: int) -> Gradients:
        """Make the twin's step; returns what the first model's gradients are to be increased by."""
        model, first = self.pipeline.model, self.trainer.pipeline.model
        if (pace := self.trainer.pace) is not None:
            model.schedule_at(first.schedule_step)
            model.densification.reschedule(lambda position: pace.step_at(position, step))
        self._call_back(step, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
        pulls: list[Gradients] = [{}, {}]
        if step % self.every == 0 and first.schedule_step >= START and first._get_downscale_factor() == 1:
            view = self.between.draw(Random(f"{first._seed} {step}"))
            pictures = [picture(each, view, step) for each in (self, self.trainer)]
            pulls = [pull(each, view, seen, step) for each, seen in zip((self.trainer, self), pictures, strict=True)]
        for name, optimizer in self.optimizers.optimizers.items():
            optimizer.param_groups[0]["lr"] = self.trainer.optimizers.optimizers[name].param_groups[0]["lr"]
        descend(self, step, pulls[1])
        self._call_back(step, TrainingCallbackLocation.AFTER_TRAIN_ITERATION)
        return pulls[0]

    def _call_back(self, step: int, location: TrainingCallbackLocation) -> None:
        for callback in self.callbacks:
            callback.run_callback_at_location(step, location)

    def state(self) -> dict[str, Any]:
        """What a checkpoint needs to go on with both."""
        optimizers = {name: value.state_dict() for name, value in self.optimizers.optimizers.items()}
        return {"model": self.pipeline.model.state_dict(), "optimizers": optimizers}

    def load_state(self, state: dict[str, Any]) -> None:
        self.pipeline.model.load_state_dict(state["model"])
        self.optimizers.load_optimizers(state["optimizers"], list(self.pipeline.model.head.parameters()))


def twin_of(trainer) -> Twin | None:
    """The twin that a trainer's configuration asks for (`NrfgsModelConfig.twin`), if any."""
    model, config = trainer.pipeline.model, trainer.config
    every = min(round(EVERY * math.exp(min(model.num_views / VIEWS, 2.0) ** 2)), RAREST)
    agrees, is_timed = (config.schedule_steps or config.max_num_iterations) > START, config.time_budget is not None
    if model.config.twin == "on" and not agrees and not is_timed:
        fix = "Give --schedule-steps 30000, or leave it off."
        raise InputError(f"pipeline.model.twin is on, but trainings agree from step {START} of their schedules. {fix}")
    is_fixed = model.camera_optimizer.config.mode == "off"
    suits = every < RAREST and agrees and not is_timed and is_fixed and model.device.type == "cuda"
    is_wanted = model.config.twin == "on" or model.config.twin == "auto" and suits
    return Twin(trainer, every) if is_wanted else None


def pull(training, view: Cameras, seen: Tensor, step: int) -> Gradients:
    """Gradients of the photometric loss of a view against the other model's picture of it (`picture`)."""
    model, optimizers = training.pipeline.model, training.optimizers
    batch = {"image": seen, "image_idx": view.metadata["cam_idx"], "between": True}
    if training.graphs.prepare(view, batch, step):
        training.graphs.run(batch)
    else:
        optimizers.zero_grad_all()
        loss_of(model, model.gauss_params, model.get_outputs(view), batch, True)["main_loss"].backward()
    names = [name for name in optimizers.optimizers if name in PULLED or "field" not in optimizers.optimizers]
    parameters = [p for name in names for p in parameters_of(optimizers.optimizers[name])]
    # The next graph that runs writes where this one's gradients are.
    return {parameter: parameter.grad.clone() for parameter in parameters if parameter.grad is not None}


def picture(training, view: Cameras, step: int) -> Tensor:
    """A model's picture of a view (`NrfgsModel.picture`), recorded where steps are."""
    if (recorded := training.graphs.picture(view, step)) is not None:
        return recorded
    model = training.pipeline.model
    with torch.no_grad():
        field = model.field
        return model.picture(model.project(view, field.splats), field, model.look_of(view.metadata["cam_idx"]))
