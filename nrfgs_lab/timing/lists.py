# SPDX-License-Identifier: Apache-2.0
# ruff: noqa
"""Time list making, forward and backward of the tile kernels, old and new in one process; check that they agree.

On a GPU (needs torch and Triton >= 3.4; no gsplat, no nerfstudio):

    mkdir OLD; for f in tile_lists compositing_triton; do git show 4c2232f1:nrfgs_ns/rasterizer/$f.py > OLD/$f.py; done
    PYTHONPATH=REPOSITORY python -m nrfgs_lab.timing.lists --old OLD [--splats 300000 1000000 3000000] [--megapixels 2 8]

OLD's files are loaded as siblings of the repository's own; everything else is shared. Without a GPU, tiny:

    TRITON_INTERPRET=1 PYTHONPATH=REPOSITORY python -m nrfgs_lab.timing.lists --old OLD --splats 300 --megapixels 0.004 --reps 1
"""

import argparse
import importlib.util
import json
import math
import sys
import time
from collections import defaultdict
from pathlib import Path
from statistics import median

import torch

parser = argparse.ArgumentParser()
parser.add_argument("--old", type=Path, required=True)
parser.add_argument("--splats", type=int, nargs="+", default=[300_000, 1_000_000, 3_000_000])
parser.add_argument("--megapixels", type=float, nargs="+", default=[0.4, 2.0, 8.0])
parser.add_argument("--views", type=int, nargs="+", default=[0, 5])
parser.add_argument("--reps", type=int, default=15)
parser.add_argument("--room", type=float, default=1.5, help="room for pairs, over the pairs of the view")
parser.add_argument("--rectangles", action="store_true", help="radii [M, 2], as with gsplat 1.5")
parser.add_argument("--no-profile", action="store_true")
parser.add_argument("--old-side", type=int, help="force the old lists' side")
args = parser.parse_args()
cuda = torch.cuda.is_available()
device = torch.device("cuda" if cuda else "cpu")
began = time.perf_counter()

import nrfgs_ns.rasterizer.compositing_triton as new_compositing  # noqa: E402
import nrfgs_ns.rasterizer.tile_lists as new_lists  # noqa: E402


def sibling(name: str):
    """A module of the old folder, under another name in the same package."""
    full = f"nrfgs_ns.rasterizer.old_{name}"
    spec = importlib.util.spec_from_file_location(full, args.old / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[full] = module
    spec.loader.exec_module(module)
    return module


old_lists, old_compositing = sibling("tile_lists"), sibling("compositing_triton")


def made(count: int):
    """nrfgs_lab.timing.scale.made: discs on a bumpy ball and two walls."""
    draw = torch.Generator().manual_seed(0)
    normals, spread, colors = torch.randn(3, count, 3, generator=draw)
    normals = torch.nn.functional.normalize(normals, dim=-1)
    radii = torch.tensor([0.5] * 5 + [2.0] * 3 + [5.0] * 2)[torch.arange(count) * 10 // count, None]
    means = radii * normals * (1 + 0.1 * (9 * normals).sin().prod(dim=-1, keepdim=True))
    scales = (radii * (12 / count) ** 0.5).log() + 0.5 * spread - torch.tensor([0.4, 0.4, 2.5])
    quats = torch.stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], 0 * normals[:, 0]], dim=-1)
    opacities = 2 * torch.randn(count, 1, generator=draw)
    tables = (
        means,
        scales.exp(),
        torch.nn.functional.normalize(quats, dim=-1),
        opacities.sigmoid()[:, 0],
        colors.sigmoid(),
    )
    return [table.to(device) for table in tables]


def camera(view: int, megapixels: float):
    angle = torch.tensor(view * 2 * math.pi / 16)
    back = torch.nn.functional.normalize(torch.stack([angle.cos(), angle.sin(), torch.tensor(0.4)]), dim=-1)
    right = torch.stack([-angle.sin(), angle.cos(), torch.tensor(0.0)])
    up = torch.linalg.cross(back, right)
    turn = torch.stack([right, -up, -back])  # world to camera: x right, y down, z forward
    scale = math.sqrt(1e6 * megapixels / 600)
    return turn.to(device), (1.5 * back).to(device), round(30 * scale), round(20 * scale), 26.0 * scale


def projected(splats, view: int, megapixels: float):
    """One row for each splat as gsplat 1.4 projects it; radius 0 where the camera does not see it."""
    means, scales, quats, opacities, colors = splats
    turn, center, width, height, focal = camera(view, megapixels)
    w, x, y, z = quats.unbind(-1)
    axes = torch.stack(
        [
            *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        ],
        -1,
    ).view(-1, 3, 3)
    seen = (means - center) @ turn.T
    root = turn @ axes * scales[:, None]
    covariance = root @ root.mT
    px, py, depth = seen.unbind(-1)
    d = depth.clamp_min(0.01)
    lim_x, lim_y = 1.3 * 0.5 * width / focal, 1.3 * 0.5 * height / focal
    tx, ty = d * (px / d).clamp(-lim_x, lim_x), d * (py / d).clamp(-lim_y, lim_y)
    zero = torch.zeros_like(d)
    J = torch.stack([focal / d, zero, -focal * tx / d**2, zero, focal / d, -focal * ty / d**2], -1).view(-1, 2, 3)
    flat = J @ covariance @ J.mT
    a, b, c = flat[:, 0, 0] + 0.3, flat[:, 0, 1], flat[:, 1, 1] + 0.3
    det = a * c - b * b
    middle = 0.5 * (a + c)
    radius = (3 * (middle + (middle**2 - det).clamp_min(0.01).sqrt()).sqrt()).ceil()
    means2d = torch.stack([focal * px / d + 0.5 * width, focal * py / d + 0.5 * height], -1)
    size = means2d.new_tensor([width, height])
    visible = (depth > 0.01) & ((means2d + radius[:, None] > 0) & (means2d - radius[:, None] < size)).all(1)
    radii = torch.where(visible, radius, 0).int()
    if args.rectangles:
        sides = (3.33 * torch.stack([a, c], -1).sqrt()).ceil()
        radii = torch.where(visible[:, None], sides, 0).int()
    conics = torch.stack([c, -b, a], -1) / det[:, None]
    return [t.contiguous() for t in (means2d, radii, depth, conics, opacities)], colors.contiguous(), width, height


def timed(call) -> float:
    """Median milliseconds of a call; on a GPU, of its CUDA graph."""
    call()
    if not cuda:
        start = time.perf_counter()
        call()
        return 1e3 * (time.perf_counter() - start)
    torch.cuda.synchronize()
    aside = torch.cuda.Stream()
    with torch.cuda.stream(aside):
        call()
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        call()
    for _ in range(3):
        graph.replay()
    times = []
    for _ in range(args.reps):
        start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        start.record()
        graph.replay()
        end.record()
        torch.cuda.synchronize()
        times.append(start.elapsed_time(end))
    del graph
    return median(times)


def kernels(call) -> dict[str, float]:
    """Milliseconds of the kernels of a call, by kind."""
    from torch.autograd import DeviceType
    from torch.profiler import ProfilerActivity, profile

    with profile(activities=[ProfilerActivity.CUDA]) as watch:
        for _ in range(5):
            call()
        torch.cuda.synchronize()
    total = defaultdict(float)
    for event in watch.events():
        if event.device_type != DeviceType.CUDA or event.is_user_annotation:
            continue
        name = event.name
        kind = next((k for k in ("count_kernel", "list_kernel", "split_kernel") if k in name), None)
        if kind is None and "adix" in name:
            kind = "sort tiles" if "short" in name else "sort depths" if "float" in name else "sort ?"
        if kind is None:
            kind = next(
                (k for k in ("earchsorted", "index", "scan", "Scan", "Memset", "fill", "arange") if k in name), "other"
            )
        total[kind.lower()] += event.time_range.elapsed_us() / 5e3
    return {kind: round(value, 4) for kind, value in sorted(total.items(), key=lambda item: -item[1])}


class Variant:
    def __init__(self, name, lists, compositing, tables, colors, width, height):
        self.name, self.lists, self.compositing = name, lists, compositing
        self.tables, self.colors, self.width, self.height = tables, colors, width, height
        small = -(-width // 8) * (-(-height // 8) + 1) <= 2**16
        self.side = 8 if name == "new" or small else 16
        if name == "old" and args.old_side:
            self.side = args.old_side
        self.options = {"split": True} if name == "new" else {}
        self.shape = (width, height) if name == "new" else (width, height, self.side)
        self.size = -(-width // self.side), -(-height // self.side), self.side
        begins, _ = lists.tile_lists(*tables, *self.size, **self.options)
        self.listed = int(begins[0, -1, 0])  # in tiles that are composited
        room = lists.FixedRoom(1, device)
        lists.tile_lists(*tables, *self.size, room=room, **self.options)
        self.sorted = int(room.counted[1])
        self.room = lists.FixedRoom(int(args.room * self.sorted) + 1, device)

    def make(self):
        return self.lists.tile_lists(*self.tables, *self.size, room=self.room, **self.options)

    def leaves(self):
        means2d, _, _, conics, opacities = self.tables
        return [t.clone().requires_grad_() for t in (means2d, conics, opacities, self.colors)]

    def image(self, leaves, lists, background):
        return self.compositing.CompositeSplats.apply(*leaves, background, *lists, self.shape, True)

    def times(self, upstream):
        background, lists = self.colors.new_full((1, 3), 0.3), self.make()
        means2d, _, _, conics, opacities = self.tables
        tables = means2d, conics, opacities, self.colors
        out = {"lists": timed(self.make)}
        with torch.no_grad():
            out["forward"] = timed(lambda: self.image(tables, lists, background))

        def both():
            leaves = self.leaves()
            image, _ = self.image(leaves, lists, background)
            image.backward(upstream)

        def whole():
            leaves = self.leaves()
            image, _ = self.image(leaves, self.make(), background)
            image.backward(upstream)

        out["backward"] = timed(both) - out["forward"]  # with copies and zeros of tables, the same for both
        out["all"] = timed(whole)
        return {key: round(value, 4) for key, value in out.items()}


def check(old: Variant, new: Variant, upstream) -> dict:
    """Largest difference of images; norms of gradients' differences over their norms."""
    results = []
    for variant in (old, new):
        leaves, background = variant.leaves(), variant.colors.new_full((1, 3), 0.3).requires_grad_()
        image, alphas = variant.image(leaves, variant.make(), background)
        (image * upstream).sum().backward()
        results.append([image.detach(), alphas.detach(), *(t.grad for t in (*leaves, background)), leaves[0].absgrad])
    gaps = {"image": (results[0][0] - results[1][0]).abs().max().item()}
    gaps["alphas"] = (results[0][1] - results[1][1]).abs().max().item()
    for name, mine, twin in zip(
        ("means2d", "conics", "opacities", "colors", "background", "absgrad"),
        results[1][2:],
        results[0][2:],
        strict=True,
    ):
        gaps[name] = ((mine - twin).norm() / twin.norm().clamp_min(1e-30)).item()
    # Where T is at its cut-off to rounding, a splat may come or go: in few pixels.
    off = ((results[0][0] - results[1][0]).abs().amax(-1) > 2e-5).sum().item()
    gaps["pixels beyond 2e-5"] = off
    few = 1e-4 if old.side == new.side else 1e-3
    ok = off <= 1e-5 * results[0][1].numel() and all(
        gaps[name] <= few for name in ("means2d", "conics", "opacities", "colors", "background", "absgrad")
    )
    if old.side == new.side:  # the same lists, to the last tie
        (a, b), (c, d) = old.make(), new.make()
        pairs = int(a[0, -1, 0])
        same = torch.equal(a[:, :-1], c[:, :-1]) and torch.equal(b[:pairs], d[:pairs])
        gaps["lists equal"] = same
        if not same:
            gaps["pairs old, new"] = pairs, int(c[0, -1, 0])
    gaps["OK"] = ok and gaps.get("lists equal", True)
    return gaps


print(torch.cuda.get_device_name() if cuda else "cpu", torch.__version__, flush=True)
for count in args.splats:
    splats = made(count)
    for megapixels in args.megapixels:
        sums = defaultdict(lambda: defaultdict(float))
        for view in args.views:
            tables, colors, width, height = projected(splats, view, megapixels)
            variants = [
                Variant("old", old_lists, old_compositing, tables, colors, width, height),
                Variant("new", new_lists, new_compositing, tables, colors, width, height),
            ]
            upstream = torch.randn(1, height, width, 3, generator=torch.Generator(device).manual_seed(1), device=device)
            if view == args.views[0]:
                gaps = check(*variants, upstream)
                print("check", json.dumps(gaps), flush=True)
            for variant in variants:
                for key, value in variant.times(upstream).items():
                    sums[variant.name][key] += value / len(args.views)
                sums[variant.name]["Mpairs sorted"] += variant.sorted / 1e6 / len(args.views)
                sums[variant.name]["Mpairs composited"] += variant.listed / 1e6 / len(args.views)
                if cuda:
                    sums[variant.name]["side"] = variant.side
                if cuda and variant.name == "new" and view == args.views[0]:
                    usual, batch = new_lists.launch_split, new_lists.BATCH
                    for new_lists.BATCH, warps in ((128, 1), (256, 2), (512, 4)):
                        new_lists.launch_split = lambda *a, warps=warps, **k: usual(*a, **{**k, "num_warps": warps})
                        print(
                            f"  lists, split in batches of {new_lists.BATCH}, {warps} warps: {timed(variant.make):.4f}"
                        )
                    new_lists.launch_split, new_lists.BATCH = usual, batch
                if cuda and not args.no_profile and count == 1_000_000 and view == args.views[0]:
                    print("  kernels of lists,", variant.name, kernels(variant.make), flush=True)
        for name, values in sums.items():
            print(
                f"{count:,} splats, {width} x {height}, {name}:",
                {k: round(v, 3) for k, v in values.items()},
                flush=True,
            )
        print(
            f"   new / old: { ({k: round(sums['new'][k] / sums['old'][k], 3) for k in ('lists', 'forward', 'backward', 'all')}) }",
            flush=True,
        )
        del variants, upstream, tables, colors
        if cuda:
            torch.cuda.empty_cache()
print(f"{time.perf_counter() - began:.0f} s")
