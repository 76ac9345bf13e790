# SPDX-License-Identifier: Apache-2.0
"""One training of any method that nerfstudio knows, its own splatfacto included, and its evaluation.

    python -m nrfgs_lab.run RECORD.json METHOD [options of ns-train]

trains METHOD, evaluates the last checkpoint, and writes everything measured to RECORD.json.
"""

import contextlib
import json
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import nn

from nrfgs_ns.files import write_whole
from nrfgs_ns.training.checkpoint_files import allow_nerfstudio_checkpoints
from nrfgs_ns.training.run import evaluate, machine, train


@contextlib.contextmanager
def host_without_downloads(method: str) -> Iterator[None]:
    """Let nerfstudio's own methods run offline, for comparisons.

    They build LPIPS, and download its weights, with the model. For the time of a run it is replaced by one that gives
    NaN, unless the weights are on disk. Their checkpoints need torch's leave to be read. This project's methods need no
    such thing.
    """
    allow_nerfstudio_checkpoints()
    if method.startswith("nrfgs") or _lpips_weights_are_here():
        yield
        return
    import torchmetrics.image.lpip as lpip

    class NoLpips(nn.Module):
        def __init__(self, **_: Any):
            super().__init__()

        def forward(self, *_: Any) -> torch.Tensor:
            return torch.tensor(float("nan"))

    original, lpip.LearnedPerceptualImagePatchSimilarity = lpip.LearnedPerceptualImagePatchSimilarity, NoLpips
    try:
        yield
    finally:
        lpip.LearnedPerceptualImagePatchSimilarity = original


def _lpips_weights_are_here() -> bool:
    from torchvision.models import AlexNet_Weights

    return (Path(torch.hub.get_dir()) / "checkpoints" / Path(AlexNet_Weights.DEFAULT.url).name).is_file()


def main() -> None:
    record_path, args = Path(sys.argv[1]), sys.argv[2:]
    with host_without_downloads(args[0]):
        record = train(args)
        results = evaluate(Path(record.config_path), record_path.with_suffix(".eval.json"))
    record_path.with_suffix(".eval.json").unlink()
    content = {"method": args[0], "machine": machine(), "train": asdict(record), "eval": results}
    write_whole(record_path, json.dumps(content, indent=1))


if __name__ == "__main__":
    main()
