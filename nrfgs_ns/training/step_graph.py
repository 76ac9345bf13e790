# SPDX-License-Identifier: Apache-2.0
"""Rendering, loss and gradients of a training step as one CUDA graph, and a twin's picture as another.

A step launches a hundred kernels, and the host takes longer to launch them than a GPU takes to run them: 4 ms against
2 ms at 250,000 splats. Between two refinements each step does the same to the same tensors. So it is recorded once,
and launched as a whole from then on, with another camera, photograph and noise.

Sizes must not differ between steps: all splats have a row, visible or not, and the tiles' lists have room for 1.5 times
the (splat, tile) pairs of recent views. If a view has more pairs, its farthest splats are left out of that step; the
host learns it a step later and makes more room.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor
from torch.func import functional_call

from nrfgs_ns.appearance.head import Field
from nrfgs_ns.data.checks import warn
from nrfgs_ns.densification import memory
from nrfgs_ns.image.metrics import WINDOW_SIZE
from nrfgs_ns.model.loss import loss_of
from nrfgs_ns.rasterizer import Pinhole, View, composite_view, project_view

MORE_ROOM = 1.5
"""Room for (splat, tile) pairs, relative to the view that has most."""
VIEWS_COUNTED = 20
"""Views in which pairs are counted."""
MOST_SIZES = 4
"""Sizes of photographs that are recorded while densification goes on, after each refinement anew. Afterwards further
sizes are recorded unless more than half of the GPU's memory is in use. Steps of other sizes run kernel by kernel."""


class StepGraphs:
    """The graphs of one training, one for each size of photograph.

    Args:
        model: an NrfgsModel.
        datamanager: its training's.
        guard: its training's. Its verdict on the step before is read once, before a step is computed.
    """

    def __init__(self, model, datamanager, guard):
        self.model, self.datamanager, self.guard = model, datamanager, guard
        self._graphs: dict[_Kind, _StepGraph] = {}
        self._recorded: list[Any] = []
        """the splats' parameters and the head that the graphs hold, kept so that their ids stay theirs"""
        self._settings: dict[str, Any] = {}
        """what the graphs depend on: ids of those objects, their places in memory, phases, the resolution"""
        self._pairs_per_splat = 0.0
        """the most pairs of a view at this resolution, divided by the number of splats"""
        self._pool_and_stream: tuple = ()
        """a memory pool and a stream, shared by all graphs"""
        self._given_up = False
        self._reported: set[str] = set()

    def _can_record(self, batch: Mapping[str, Any]) -> bool:
        """Whether this step can be recorded; each thing that prevents it is reported once."""
        model = self.model
        if self._given_up or model.device.type != "cuda" or model.num_points == 0:
            return False
        if (obstacle := self._obstacle(batch)) is not None:
            self._drop_if_outdated()  # graphs of replaced splats would keep their memory
            if obstacle not in self._reported:
                CONSOLE.print(f"Steps are not recorded as a CUDA graph, and take longer: {obstacle}.", soft_wrap=True)
                self._reported.add(obstacle)
            return False
        # Smaller images go to pytorch_msssim, which copies its window from the host.
        return min(batch["image"].shape[:2]) // model._get_downscale_factor() >= WINDOW_SIZE

    def _obstacle(self, batch: Mapping[str, Any]) -> str | None:
        """An option of the training, or a property of this photograph, that graphs do not support."""
        model = self.model
        exposed = model.photograph is not None
        obstacles = (
            ("exposures of transparent photographs are learnt", exposed and batch["image"].shape[-1] == 4),
            ("the robust loss fades in", model.trimming is not None and model.trimming.fades_at(model.schedule_step)),
            ("camera poses are learnt", model.camera_optimizer.config.mode != "off"),
            ("the head's network sees pixels", model.head.at_pixel),
            ("photographs have many sizes, and only some of them are recorded", self._is_one_too_many(batch)),
        )
        return next((obstacle for obstacle, is_present in obstacles if is_present), None)

    def _is_one_too_many(self, batch: Mapping[str, Any]) -> bool:
        """Whether the photograph is of a kind that has no graph and gets none."""
        kind = _kind(batch)
        alike = [other for other in self._graphs if other.sort == kind.sort]
        if len(alike) < MOST_SIZES or kind in alike:
            return False
        return not self.model.densification.rests_at(self.model.step) or memory.share_used(self.model.device) > 0.5

    def prepare(self, camera: Cameras, batch: Mapping[str, Any], step: int) -> bool:
        """Prepare `run` for a step; returns whether it can make it.

        It cannot where recording is impossible or fails, and in the first step since graphs became outdated. Raises
        TrainingStopped if the step before met a number that is not finite.
        """
        if not self._can_record(batch) or self._drop_if_outdated():
            self.guard.settle()
            return False
        inputs = self.model.pinhole(camera), batch, camera.metadata["cam_idx"], step
        kind = _kind(batch)
        if (graph := self._graphs.get(kind)) is not None:
            graph.prepare(*inputs)
        self.guard.settle()  # the host waits for the GPU: all else is ready, so that the GPU need not wait in turn
        if graph is None or not graph.had_room():
            self._record(kind, *inputs)
        return kind in self._graphs

    def run(self, batch: Mapping[str, Any]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Make the prepared step: returns its outputs and losses, detached, and leaves the gradients of the losses' sum
        in the parameters."""
        model = self.model
        graph = self._graphs[_kind(batch)]
        losses = graph.run()
        model.info = {**graph.info, "pairs": graph.last_pairs}
        model.watch(graph.outputs, losses, batch)
        return dict(graph.outputs), dict(losses)

    def picture(self, view: Cameras, step: int) -> Tensor | None:
        """A view between cameras, drawn as a photograph (`NrfgsModel.picture`); None where no graph can draw it."""
        batch = {"image": torch.empty(int(view.height), int(view.width), 0), "between": True}
        return self._graphs[_kind(batch)].run() if self.prepare(view, batch, step) else None

    def _drop_if_outdated(self) -> bool:
        """Drop all graphs, and return True, where the step differs from the recorded ones in its splats, its resolution
        or the phase of head or densification."""
        model = self.model
        splats = list(model.gauss_params.values())
        objects = [*splats, model.head]  # the head's weights live as long as it does
        settings = {
            "objects": [id(value) for value in objects],
            "places": [value.data_ptr() for value in splats],
            "head": model.head.phase,
            "densification": model.densification.rests_at(model.step),
            "trims": model.trimming is not None and model.trimming.is_on(model.schedule_step),
            "downscale": model._get_downscale_factor(),
        }
        if settings == self._settings:
            return False
        self._update_pairs()
        if settings["downscale"] != self._settings.get("downscale"):
            self._pairs_per_splat = 0.0
        if self._graphs:
            self._graphs.clear()
            torch.cuda.empty_cache()  # which alone frees a graph's memory for others
        self._recorded, self._settings = objects, settings
        return True

    def _record(self, kind: _Kind, pinhole: Pinhole, batch: Mapping[str, Any], index: int, step: int) -> None:
        """Record a graph for this kind of photograph and prepare it for a step; if that fails, record none from now
        on."""
        self._update_pairs()
        self._graphs.pop(kind, None)
        try:
            if self._pairs_per_splat == 0.0:
                self._pairs_per_splat = self._most_pairs() / self.model.num_points
            room = int(MORE_ROOM * self._pairs_per_splat * self.model.num_points) + 1
            if not self._graphs:  # a pool's memory is free for others when all its graphs are gone
                self._pool_and_stream = torch.cuda.graph_pool_handle(), torch.cuda.Stream(self.model.device)
            make = _PictureGraph if kind.sort == "picture" else _StepGraph
            graph = self._graphs[kind] = make(self.model, pinhole, batch, room, *self._pool_and_stream)
            graph.prepare(pinhole, batch, index, step)
        except Exception as error:
            self._given_up = True
            self._graphs.clear()
            torch.cuda.empty_cache()
            reason = next(iter(str(error).splitlines()), "")
            warn(f"Steps are made kernel by kernel: their graph failed ({type(error).__name__}: {reason}).")

    def _update_pairs(self) -> None:
        """Raise `_pairs_per_splat` to the most that the present graphs have met."""
        for graph in self._graphs.values():
            self._pairs_per_splat = max(self._pairs_per_splat, graph.most_pairs() / graph.count)

    def _most_pairs(self) -> int:
        """The most pairs of any of about `VIEWS_COUNTED` views; RuntimeError where gsplat makes the tiles' lists, not
        `tile_lists.py`."""
        from nrfgs_ns.rasterizer.tile_lists import Room

        model = self.model
        field = model.field
        room = Room(1, model.device)
        count = len(self.datamanager.train_dataset)
        for index in range(0, count, max(count // VIEWS_COUNTED, 1)):
            camera, _ = self.datamanager.train_view(index)
            view = model.project(camera, field.splats)
            with room.in_use():
                composite_view(view, field.seen_from(view), torch.zeros(3, device=model.device), with_depth=False)
        _, most = room.counted.tolist()
        if most < 0:
            raise RuntimeError("gsplat lists what tiles draw, and the host waits for its lists")
        return most


class _Kind(NamedTuple):
    """The properties of a photograph for which its graph is recorded."""

    shape: tuple[int, ...]
    has_mask: bool
    sort: Literal["photograph", "between", "picture"]
    """of a training camera; of a view between cameras; not there yet, but to be drawn (shape [H, W, 0])"""


def _kind(batch: Mapping[str, Any]) -> _Kind:
    shape = tuple(batch["image"].shape)
    sort = "photograph" if "between" not in batch else "between" if shape[-1] else "picture"
    return _Kind(shape, "mask" in batch, sort)


class _StepGraph:
    """One graph, and the tensors that it reads and writes.

    Args:
        model: an NrfgsModel in training.
        pinhole, batch: some camera, and its photograph and mask as the datamanager gives them.
        pairs: number of pairs for which the tiles' lists have room.
        pool: memory that all graphs share: a graph's outputs last until the next one runs.
        stream: the stream on which all are recorded.
    """

    def __init__(self, model, pinhole: Pinhole, batch: Mapping[str, Any], pairs: int, pool: Any, stream: Any):
        from nrfgs_ns.rasterizer.tile_lists import Room

        self.model, self.count = model, model.num_points
        self.parameters = {f"splats.{name}": value for name, value in model.gauss_params.items()}
        self.parameters |= {f"head.{name}": value for name, value in model.head.named_parameters()}
        self.device = device = model.device
        matrices = {name: getattr(pinhole, name).clone() for name in ("viewmat", "K", "center")}
        self.pinhole = pinhole._replace(**matrices)
        self.batch = {name: batch[name].to(device, copy=True) for name in ("image", "mask") if name in batch}
        self.is_between = "between" in batch
        self.room = Room(pairs, device)
        self._counted = torch.ones(2, dtype=torch.int64, pin_memory=True)
        self._arrived = torch.cuda.Event()
        self._arrived.record()
        self.last_pairs = 1
        """number of pairs in the step before, as far as the host knows"""
        self.shot = None if model.photograph is None else model.photograph.shots.detach()[:1].clone()
        """the step's row of a learnt exposure model, [1, R], which a graph cannot select by itself"""
        self.noise = model.view_noise.generator(device, 0)
        self._capture(pool, stream)

    def _capture(self, pool: Any, stream: Any) -> None:
        """Record the step, which runs once before: random generators and residuals are set back in between."""
        model, device = self.model, self.device
        generators = [torch.cuda.default_generators[device.index], *([] if self.noise is None else [self.noise])]
        states = [generator.get_state() for generator in generators]
        self.graph = torch.cuda.CUDAGraph()
        if self.noise is not None:
            self.graph.register_generator_state(self.noise)
        current = torch.cuda.current_stream(device)
        residuals = None if model.trimming is None else model.trimming.histogram.clone()
        stream.wait_stream(current)
        try:
            with torch.cuda.stream(stream):
                self._compute()  # once outside the recording: first calls compile and allocate
                for generator, state in zip(generators, states, strict=True):
                    generator.set_state(state)
                if residuals is not None:
                    model.trimming.histogram.copy_(residuals)
                memory.give_back(device)
                self.graph.capture_begin(pool, capture_error_mode="thread_local")  # a viewer has a thread of its own
                try:
                    self._compute()
                finally:
                    self.graph.capture_end()
        except Exception:
            for generator, state in zip(generators, states, strict=True):  # still marked as recorded
                generator.graphsafe_set_state(torch.Generator(device).graphsafe_get_state())
                generator.set_state(state)
            raise
        finally:
            current.wait_stream(stream)

    def _compute(self) -> None:
        """One step's rendering, loss and gradients, from and to tensors that stay where they are.

        Gradients go to leaves that share the parameters' memory: an earlier step's graph may still hold the parameters
        themselves, and on another stream.
        """
        model = self.model
        leaves = {name: value.detach().requires_grad_() for name, value in self.parameters.items()}
        splats = {name: leaves[f"splats.{name}"] for name in model.gauss_params}
        weights = {name: leaves[f"head.{name}"] for name, _ in model.head.named_parameters()}
        head = lambda *view: functional_call(model.head, weights, view)  # noqa: E731
        shot = None if self.shot is None else self.shot.detach().requires_grad_()
        with torch.enable_grad(), self.room.in_use():
            view = self._project(splats)
            noisy = Field(head, model.view_noise.moved(splats, self.noise))
            outputs, info = model.render_view(view, noisy, self._look(shot), self.is_between)
            losses = loss_of(model, splats, outputs, self.batch, self.is_between)
            sum(losses.values()).backward()
        self.gradients = {name: leaf.grad for name, leaf in leaves.items()}
        if shot is not None:
            self.shot_gradient = shot.grad
        self.outputs = {name: value.detach() for name, value in outputs.items()}
        self.losses = {name: loss.detach() for name, loss in losses.items()}
        self.info = {name: value.detach() if isinstance(value, Tensor) else value for name, value in info.items()}
        for name in ("grad", "absgrad") if info["means2d"].retains_grad else ():
            gradient = getattr(info["means2d"], name, None)
            if gradient is not None:
                setattr(self.info["means2d"], name, gradient)

    def _project(self, splats: Mapping[str, Tensor]) -> View:
        return project_view(splats, self.pinhole, replace(self.model.projection_options, every_row=True))

    def _look(self, shot: Tensor | None) -> Callable[[Tensor], Tensor] | None:
        """The exposure model with a row of `shots` in place of all."""
        model = self.model.photograph
        return None if shot is None else lambda rgb: functional_call(model, {"shots": shot}, (rgb, 0))

    def had_room(self) -> bool:
        """Whether the step before had room for all pairs."""
        self._arrived.synchronize()
        self.last_pairs = int(self._counted[0])
        return self.last_pairs <= self.room.pairs

    def most_pairs(self) -> int:
        """The most pairs of any step."""
        self._arrived.synchronize()
        return int(self._counted[1])

    def prepare(self, pinhole: Pinhole, batch: Mapping[str, Any], index: int, step: int) -> None:
        """Copy in a step's camera, photograph (number `index` of the training), mask and noise."""
        own = self.pinhole
        torch._foreach_copy_([own.viewmat, own.K, own.center], [pinhole.viewmat, pinhole.K, pinhole.center])
        for name, values in self.batch.items():
            values.copy_(batch[name], non_blocking=True)
        self.model.view_noise.generator(self.device, step)  # the same, with this step's seed
        if self.shot is not None:
            self.index = index
            self.shot.copy_(self.model.photograph.shots.detach()[index : index + 1])

    def run(self) -> dict[str, Tensor]:
        """Compute a step: returns its losses, sets the parameters' gradients, `outputs` and `info`."""
        self._replay()
        if self.shot is not None:
            shots = self.parameters["photograph.shots"] = self.model.photograph.shots
            self.gradients["photograph.shots"] = torch.zeros_like(shots)
            self.gradients["photograph.shots"][self.index] = self.shot_gradient[0]
        for name, parameter in self.parameters.items():
            parameter.grad = self.gradients[name]
        return self.losses

    def _replay(self) -> None:
        self.graph.replay()
        self._counted.copy_(self.room.counted, non_blocking=True)
        self._arrived.record()


class _PictureGraph(_StepGraph):
    """A view drawn as a photograph, without loss and gradients."""

    def _compute(self) -> None:
        field = self.model.field
        with torch.no_grad(), self.room.in_use():
            self.picture = self.model.picture(self._project(field.splats), field, self._look(self.shot))

    def run(self) -> Tensor:
        """Draw it: returns a copy, since the next graph overwrites it."""
        self._replay()
        return self.picture.clone()
