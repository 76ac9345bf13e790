# SPDX-License-Identifier: Apache-2.0
"""Rendering, loss and gradients of a training step as one CUDA graph.

A step launches a hundred kernels, and the host takes longer to launch them than a GPU takes to run them: 4 ms against
2 ms at 250,000 splats. Between two refinements each step does the same to the same tensors. So it is recorded once,
and launched as a whole from then on, with another camera, photograph and noise.

Sizes must not differ between steps: all splats have a row, visible or not, and the tiles' lists have room for 1.5 times
the pairs of recent views. If a view needs more, which the host learns a step later, its farthest splats are left out of
that step, and there is more room from then on.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

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
from nrfgs_ns.rasterizer import Pinhole, composite_view, project_view

MORE_ROOM = 1.5
"""Room for pairs of splats and tiles, relative to the view that has most."""
VIEWS_ASKED = 20
"""Views in which pairs are counted."""
MOST_SIZES = 4
"""Sizes of photographs that are recorded while splats grow, after each refinement anew. Later further sizes are, unless
more than half of the GPU's memory is in use. Other steps run kernel by kernel."""


class StepGraphs:
    """The graphs of one training, one for each size of photograph.

    Args:
        model: an NrfgsModel.
        datamanager: of its training.
        guard: of its training; its verdict on the step before is read once, before a step is computed.
    """

    def __init__(self, model, datamanager, guard):
        self.model, self.datamanager, self.guard = model, datamanager, guard
        self._graphs: dict[tuple, _StepGraph] = {}
        self._of: list[Any] = []
        """the splats' parameters and the head that were recorded"""
        self._how: dict[str, Any] = {}
        """what else differs between recordings: phases, places in memory, the resolution"""
        self._pairs_for_each = 0.0
        """the most pairs of a view, for each splat, at this resolution"""
        self._place: tuple = ()
        """a pool of memory and a stream, of all graphs"""
        self._given_up = False
        self._said: set[str] = set()

    def _takes(self, batch: Mapping[str, Any]) -> bool:
        """Whether this step can be recorded; each thing that prevents it is reported once."""
        model = self.model
        if self._given_up or model.device.type != "cuda" or model.num_points == 0:
            return False
        if (obstacle := self._obstacle(batch)) is not None:
            self._is_new()  # graphs of splats that are gone would keep their memory
            if obstacle not in self._said:
                CONSOLE.print(f"Steps are not recorded as a CUDA graph, and take longer: {obstacle}.", soft_wrap=True)
                self._said.add(obstacle)
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
        return next((what for what, there in obstacles if there), None)

    def _is_one_too_many(self, batch: Mapping[str, Any]) -> bool:
        """Whether the photograph is of a kind that has no graph and gets none."""
        if len(self._graphs) < MOST_SIZES or _kind(batch) in self._graphs:
            return False
        return not self.model.densification.rests_at(self.model.step) or memory.share_used(self.model.device) > 0.5

    def prepare(self, camera: Cameras, batch: Mapping[str, Any], step: int) -> bool:
        """Whether `run` can make this step, which it is then ready for. False where the step is the first of its kind,
        or cannot be recorded; TrainingStopped where the step before was condemned."""
        if not self._takes(batch) or self._is_new():
            self.guard.settle()
            return False
        seen_from = self.model.pinhole(camera)
        now = seen_from, batch, camera.metadata["cam_idx"], step
        kind = _kind(batch)
        if (graph := self._graphs.get(kind)) is not None:
            graph.prepare(*now)
        self.guard.settle()  # everything is ready, so that the GPU need not wait for what the host does
        if graph is None or not graph.had_room():
            self._record(kind, *now)
        return kind in self._graphs

    def run(self, batch: Mapping[str, Any]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """The outputs and losses of the step that has been prepared, detached: the parameters have the gradients of the
        losses' sum."""
        model = self.model
        graph = self._graphs[_kind(batch)]
        losses = graph.run()
        model.info = {**graph.info, "pairs": graph.last_pairs}
        model.watch(graph.outputs, losses, batch)
        return dict(graph.outputs), dict(losses)

    def _is_new(self) -> bool:
        """Whether a step differs from the recorded ones: in its splats, in its resolution, or in what the head or the
        densification does."""
        model = self.model
        splats = list(model.gauss_params.values())
        now = [*splats, model.head]  # whose weights live as long as it does
        how = {
            "places": [value.data_ptr() for value in splats],
            "head": model.head.phase,
            "densification": model.densification.rests_at(model.step),
            "trims": model.trimming is not None and model.trimming.is_on(model.schedule_step),
            "downscale": model._get_downscale_factor(),
        }
        same = len(now) == len(self._of) and all(a is b for a, b in zip(now, self._of, strict=True))
        if same and how == self._how:
            return False
        self._see_pairs()
        if how["downscale"] != self._how.get("downscale"):
            self._pairs_for_each = 0.0
        if self._graphs:
            self._graphs.clear()
            torch.cuda.empty_cache()  # which alone frees a graph's memory for others
        self._of, self._how = now, how
        return True

    def _record(self, kind: tuple, seen_from: Pinhole, batch: Mapping[str, Any], index: int, step: int) -> None:
        """Record a graph for this kind of photograph, prepared for a step; if that fails, no step from now on."""
        self._see_pairs()
        self._graphs.pop(kind, None)
        try:
            if self._pairs_for_each == 0.0:
                self._pairs_for_each = self._most_pairs() / self.model.num_points
            room = int(MORE_ROOM * self._pairs_for_each * self.model.num_points) + 1
            if not self._graphs:  # a pool's memory is free for others when all its graphs are gone
                self._place = torch.cuda.graph_pool_handle(), torch.cuda.Stream(self.model.device)
            graph = self._graphs[kind] = _StepGraph(self.model, seen_from, batch, room, self._place)
            graph.prepare(seen_from, batch, index, step)
        except Exception as error:
            self._given_up = True
            self._graphs.clear()
            torch.cuda.empty_cache()
            reason = next(iter(str(error).splitlines()), "")
            warn(f"Steps are made kernel by kernel: their graph failed ({type(error).__name__}: {reason}).")

    def _see_pairs(self) -> None:
        """Learn from the present graphs how many pairs views have."""
        for graph in self._graphs.values():
            self._pairs_for_each = max(self._pairs_for_each, graph.most_pairs() / graph.count)

    def _most_pairs(self) -> int:
        """The most pairs of any of `VIEWS_ASKED` views in the tiles of images with gradients; RuntimeError where gsplat
        makes the lists, not `tile_lists.py`."""
        from nrfgs_ns.rasterizer.tile_lists import FixedRoom

        model = self.model
        field = model.field
        room = FixedRoom(1, model.device)
        count = len(self.datamanager.train_dataset)
        for index in range(0, count, max(count // VIEWS_ASKED, 1)):
            camera, _ = self.datamanager.train_view(index)
            view = model.project(camera, field.splats)
            with room.in_use():
                composite_view(view, field.seen_from(view), torch.zeros(3, device=model.device), with_depth=False)
        _, most = room.counted.tolist()
        if most < 0:
            raise RuntimeError("gsplat lists what tiles draw, and the host waits for its lists")
        return most


def _kind(batch: Mapping[str, Any]) -> tuple:
    """The properties of a photograph for which its graph is recorded."""
    return tuple(batch["image"].shape), "mask" in batch


class _StepGraph:
    """One graph, and the tensors that it reads and writes.

    Args:
        model: an NrfgsModel in training.
        seen_from, batch: some camera, and its photograph and mask as the datamanager gives them.
        pairs: how many the lists have room for.
        place: a pool of memory and a stream, for all graphs. What a graph needs only while it runs, others use again;
            what it leaves lasts until the next one runs.
    """

    def __init__(self, model, seen_from: Pinhole, batch: Mapping[str, Any], pairs: int, place: tuple):
        from nrfgs_ns.rasterizer.tile_lists import FixedRoom

        self.model, self.count = model, model.num_points
        self.parameters = {f"splats.{name}": value for name, value in model.gauss_params.items()}
        self.parameters |= {f"head.{name}": value for name, value in model.head.named_parameters()}
        self.device = device = model.device
        self.seen_from = seen_from._replace(
            viewmat=seen_from.viewmat.clone(), K=seen_from.K.clone(), center=seen_from.center.clone()
        )
        self.batch = {name: batch[name].to(device, copy=True) for name in ("image", "mask") if name in batch}
        self.room = FixedRoom(pairs, device)
        self._counted = torch.ones(2, dtype=torch.int64, pin_memory=True)
        self._arrived = torch.cuda.Event()
        self._arrived.record()
        self.last_pairs = 1
        """of the step before, as far as the host knows"""
        self.shot = None if model.photograph is None else model.photograph.shots.detach()[:1].clone()
        """the step's row of a learnt exposure model, [1, R], which a graph cannot select by itself"""
        self.noise = model.view_noise.generator(device, 0)

        generators = [torch.cuda.default_generators[device.index], *([] if self.noise is None else [self.noise])]
        states = [generator.get_state() for generator in generators]
        self.graph = torch.cuda.CUDAGraph()
        if self.noise is not None:
            self.graph.register_generator_state(self.noise)
        pool, aside = place
        now = torch.cuda.current_stream(device)
        residuals = None if model.trimming is None else model.trimming.histogram.clone()
        aside.wait_stream(now)
        try:
            with torch.cuda.stream(aside):
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
            now.wait_stream(aside)

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
        shot = look = None
        if self.shot is not None:
            shot = self.shot.detach().requires_grad_()
            look = lambda rgb: functional_call(model.photograph, {"shots": shot}, (rgb, 0))  # noqa: E731
        with torch.enable_grad(), self.room.in_use():
            view = project_view(splats, self.seen_from, replace(model.projection_options, every_row=True))
            noisy = Field(head, model.view_noise.moved(splats, self.noise))
            outputs, info = model.render_view(view, noisy, look)
            losses = loss_of(model, splats, outputs, self.batch)
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

    def had_room(self) -> bool:
        """Whether the step before had room for all pairs."""
        self._arrived.synchronize()
        self.last_pairs = int(self._counted[0])
        return self.last_pairs <= self.room.pairs

    def most_pairs(self) -> int:
        """The most pairs of any step."""
        self._arrived.synchronize()
        return int(self._counted[1])

    def prepare(self, seen_from: Pinhole, batch: Mapping[str, Any], index: int, step: int) -> None:
        """Copy in a step's camera, noise and training photograph, number `index`."""
        mine = self.seen_from
        torch._foreach_copy_([mine.viewmat, mine.K, mine.center], [seen_from.viewmat, seen_from.K, seen_from.center])
        for name, values in self.batch.items():
            values.copy_(batch[name], non_blocking=True)
        self.model.view_noise.generator(self.device, step)  # the same, with this step's seed
        if self.shot is not None:
            self.index = index
            self.shot.copy_(self.model.photograph.shots.detach()[index : index + 1])

    def run(self) -> dict[str, Tensor]:
        """Compute a step: returns its losses, sets the parameters' gradients, `outputs` and `info`."""
        self.graph.replay()
        if self.shot is not None:
            shots = self.parameters["photograph.shots"] = self.model.photograph.shots
            self.gradients["photograph.shots"] = torch.zeros_like(shots)
            self.gradients["photograph.shots"][self.index] = self.shot_gradient[0]
        self._counted.copy_(self.room.counted, non_blocking=True)
        self._arrived.record()
        for name, parameter in self.parameters.items():
            parameter.grad = self.gradients[name]
        return self.losses
