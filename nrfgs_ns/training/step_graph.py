# SPDX-License-Identifier: Apache-2.0
"""Rendering, loss and gradients of a training step as one CUDA graph.

A step launches a hundred kernels, and the host takes longer to launch them than a GPU takes to run them: 4 ms against
2 ms at 250,000 splats. Between two refinements each step does the same to the same tensors. So it is recorded once,
and launched as a whole from then on, with another camera, photograph and noise.

What makes steps differ in size must not be there: all splats have a row, visible or not, and the tiles' lists have room
for half as many pairs again as any view had lately. Should a view need more, which the host learns a step later, the
farthest splats were missing from that step, and there is more room from then on.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor
from torch.func import functional_call

from nrfgs_ns.data.checks import warn
from nrfgs_ns.image.ssim import photometric_loss
from nrfgs_ns.model.pinhole import Pinhole
from nrfgs_ns.model.renderer import composite_view, project_view

MORE_ROOM = 1.5
"""Room for pairs of splats and tiles, for each that the view with the most has."""
VIEWS_ASKED = 20
"""Views that are asked how many pairs they have."""
MOST_SIZES = 4
"""Sizes of photographs that are recorded; of others, steps are made one kernel after the other."""


class StepGraphs:
    """The graphs of one training, one for each size of photograph.

    Args:
        model: an NrfgsModel.
        datamanager: of its training.
    """

    def __init__(self, model, datamanager):
        self.model = model
        self.datamanager = datamanager
        self._graphs: dict[tuple[int, int], _StepGraph] = {}
        self._of: list[Any] = []
        self._how: list[Any] = []
        self._pairs_for_each = 0.0
        """the most pairs of a view, for each splat, at this resolution"""
        self._given_up = False

    def take(self, step: int, batch: Mapping[str, Any]) -> bool:
        """Whether this step can be a graph's."""
        model = self.model
        return (
            not self._given_up
            and model.device.type == "cuda"
            and step > 0  # in the first step PyTorch makes what the optimisers keep
            and model.densification.takes_all_rows
            and not (model.config.use_scale_regularization and step % 10 == 0)
            and not model.config.use_bilateral_grid
            and not model.config.output_depth_during_training
            and model.photograph is None
            and model.trimming is None
            and model.num_diffuse == 0
            and model.camera_optimizer.config.mode == "off"
            and "mask" not in batch
            and batch["image"].shape[-1] == 3
            and batch["image"].dtype == torch.uint8
            and (batch["image"].shape[:2] in self._graphs or len(self._graphs) < MOST_SIZES)
        )

    def losses(
        self, camera: Cameras, batch: Mapping[str, Any], step: int
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]] | None:
        """Outputs and losses as of the model, and the gradients of the losses' sum to all parameters, when that is
        differentiated. None: the step is the first of its kind, or cannot be recorded; then none is taken any more."""
        model = self.model
        if self._is_new():
            return None
        try:
            graph = self._graph_for(camera, batch)
        except Exception as error:
            self._given_up = True
            self._graphs.clear()
            torch.cuda.empty_cache()
            reason = next(iter(str(error).splitlines()), "")
            warn(f"Steps are made kernel by kernel: their graph failed ({type(error).__name__}: {reason}).")
            return None
        loss = graph.run(model.pinhole(camera), batch["image"], step)
        model.info = {**graph.info, "pairs": graph.last_pairs}
        model.watched = {"the rendered image": graph.outputs["rgb"], "loss main_loss": loss.detach()}
        model.watched_image = batch.get("image_idx")
        return dict(graph.outputs), {"main_loss": loss}

    def _is_new(self) -> bool:
        """Whether a step is another than the one before, and none that has been recorded: splats have come or gone,
        pixels are others, or the head or the densification does something else."""
        model = self.model
        now = [*model.gauss_params.values(), model.head, *model.head.parameters()]
        how = [model.head.phase, model.densification.rests_at(model.step), model._get_downscale_factor()]
        same = len(now) == len(self._of) and all(a is b for a, b in zip(now, self._of, strict=True))
        if same and how == self._how:
            return False
        self._see_pairs()
        if how[-1:] != self._how[-1:]:
            self._pairs_for_each = 0.0
        self._graphs.clear()
        self._of, self._how = now, how
        return True

    def _graph_for(self, camera: Cameras, batch: Mapping[str, Any]) -> _StepGraph:
        """The graph of a photograph's size, recorded if there is none."""
        model = self.model
        size = tuple(batch["image"].shape[:2])
        if size in self._graphs and not self._graphs[size].had_room():
            self._see_pairs()
            del self._graphs[size]
        if size not in self._graphs:
            if self._pairs_for_each == 0.0:
                self._pairs_for_each = self._most_pairs() / model.num_points
            room = int(MORE_ROOM * self._pairs_for_each * model.num_points) + 1
            self._graphs[size] = _StepGraph(model, model.pinhole(camera), batch["image"], room)
        return self._graphs[size]

    def _see_pairs(self) -> None:
        """Learn from the graphs that there are how many pairs views have."""
        for graph in self._graphs.values():
            self._pairs_for_each = max(self._pairs_for_each, graph.most_pairs() / graph.count)

    @torch.no_grad()
    def _most_pairs(self) -> int:
        """The most pairs of views that are evenly taken from all."""
        from nrfgs_ns.rasterizer.tile_lists import room_on

        model, most = self.model, 0
        count = len(self.datamanager.train_dataset)
        field = model.field
        for index in range(0, count, max(count // VIEWS_ASKED, 1)):
            camera, _ = self.datamanager.train_view(index)
            view = model.project(camera, field.splats)
            composite_view(view, field.seen_from(view), torch.zeros(3, device=model.device), with_depth=False)
            most = max(most, room_on(model.device).needed())
        return most


class _StepGraph:
    """One graph, and the tensors that it reads and writes.

    Args:
        model: an NrfgsModel in training.
        seen_from, photograph: some camera, and its photograph, bytes [H, W, 3].
        pairs: room for pairs.
    """

    def __init__(self, model, seen_from: Pinhole, photograph: Tensor, pairs: int):
        from nrfgs_ns.rasterizer.tile_lists import FixedRoom

        self.model, self.count = model, model.num_points
        self.parameters = {f"splats.{name}": value for name, value in model.gauss_params.items()}
        self.parameters |= {f"head.{name}": value for name, value in model.head.named_parameters()}
        self.device = device = photograph.device
        self.seen_from = seen_from._replace(
            viewmat=seen_from.viewmat.clone(), K=seen_from.K.clone(), center=seen_from.center.clone()
        )
        self.photograph = photograph.clone()
        self.room = FixedRoom(pairs, device)
        self._counted = torch.ones(2, dtype=torch.int64, pin_memory=True)
        self._arrived = torch.cuda.Event()
        self._arrived.record()
        self.last_pairs = 1
        """of the step before, as far as the host has learnt"""
        noise = model.view_noise
        self.noise = None if noise.sigma == 0.0 else noise.generator(device, 0)

        generators = [torch.cuda.default_generators[device.index], *([] if self.noise is None else [self.noise])]
        states = [generator.get_state() for generator in generators]
        self.graph = torch.cuda.CUDAGraph()
        if self.noise is not None:
            self.graph.register_generator_state(self.noise)
        now, aside = torch.cuda.current_stream(device), torch.cuda.Stream(device)
        aside.wait_stream(now)
        try:
            with torch.cuda.stream(aside):
                self._compute()  # what is made or compiled at a first call is there from here on
                for generator, state in zip(generators, states, strict=True):
                    generator.set_state(state)
                self.graph.capture_begin(capture_error_mode="thread_local")  # a viewer's thread may do as it likes
                try:
                    self._compute()
                finally:
                    self.graph.capture_end()
        except Exception:
            for generator, state in zip(generators, states, strict=True):  # they believe that they are recorded
                generator.graphsafe_set_state(torch.Generator(device).graphsafe_get_state())
                generator.set_state(state)
            raise
        now.wait_stream(aside)

    def _compute(self) -> None:
        """One step's rendering, loss and gradients, from and to tensors that stay where they are.

        Gradients go to leaves that share the parameters' numbers. The parameters themselves may be held by what an
        earlier step has left, and would be another stream's.
        """
        model = self.model
        leaves = {name: value.detach().requires_grad_() for name, value in self.parameters.items()}
        splats = {name: leaves[f"splats.{name}"] for name in model.gauss_params}
        weights = {name: leaves[f"head.{name}"] for name, _ in model.head.named_parameters()}
        with torch.enable_grad(), self.room.in_use():
            view = project_view(splats, self.seen_from, model.projecting._replace(every_row=True))
            asked = model.view_noise.moved_by(splats, self.noise)
            appearance = functional_call(model.head, weights, (asked, view.visible, view.center))
            background = model._get_background_color()
            outputs, info = composite_view(
                view,
                appearance,
                background,
                with_depth=False,
                absgrad=model.densification.needs_absgrad(model.step),
                assume_finite=True,
            )
            model.densification.pre_backward(model.step, info, appearance.opacities, splats["opacities"])
            truth = model.truth_of({"image": self.photograph}, background)
            loss = photometric_loss(outputs["rgb"], truth, model.config.ssim_lambda)
            loss.backward()
        self.gradients = {name: leaf.grad for name, leaf in leaves.items()}
        self.outputs = {name: outputs[name].detach() for name in ("rgb", "accumulation")}
        self.outputs["background"] = background
        self.loss = loss.detach()
        self.info = {name: value.detach() if isinstance(value, Tensor) else value for name, value in info.items()}
        for name in ("grad", "absgrad") if info["means2d"].retains_grad else ():
            gradient = getattr(info["means2d"], name, None)
            if gradient is not None:  # what is not finite counts as zero in densification's statistics
                setattr(self.info["means2d"], name, gradient.nan_to_num_(0.0, 0.0, 0.0))

    def had_room(self) -> bool:
        """Whether the step before had room for all pairs."""
        self._arrived.synchronize()
        self.last_pairs = int(self._counted[0])
        return self.last_pairs <= self.room.pairs

    def most_pairs(self) -> int:
        """The most pairs of any step."""
        self._arrived.synchronize()
        return int(self._counted[1])

    def run(self, seen_from: Pinhole, photograph: Tensor, step: int) -> Tensor:
        """The loss, whose gradients are ready to be handed out; `outputs` and `info` are this step's."""
        for name, parameter in self.parameters.items():
            if parameter.grad is not None and parameter.grad is self.gradients[name]:  # kept to be added to
                parameter.grad = parameter.grad.clone()
        for name in ("viewmat", "K", "center"):
            getattr(self.seen_from, name).copy_(getattr(seen_from, name))
        self.photograph.copy_(photograph)
        if self.noise is not None:
            self.model.view_noise.generator(self.device, step)
        self.graph.replay()
        self._counted.copy_(self.room.counted, non_blocking=True)
        self._arrived.record()
        return _Ready.apply(self.loss, self, self.parameters["splats.means"])


class _Ready(torch.autograd.Function):
    """A loss whose gradients have been computed with it. It is differentiated as it is: nothing else is in the sum."""

    @staticmethod
    def forward(ctx, loss: Tensor, graph: _StepGraph, _: Tensor) -> Tensor:
        ctx.graph = graph
        return loss.clone()

    @staticmethod
    def backward(ctx, d_loss: Tensor) -> tuple[None, None, None]:
        for name, parameter in ctx.graph.parameters.items():
            gradient = ctx.graph.gradients[name]
            if gradient is not None:
                parameter.grad = gradient if parameter.grad is None else parameter.grad + gradient
        return None, None, None
