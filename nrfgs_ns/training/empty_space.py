# SPDX-License-Identifier: Apache-2.0
"""Space between the cameras and what is nearest to them, kept empty (experiment)."""

import os
from random import Random

import torch

from nrfgs_ns.data.views import in_view, nearest_depth

JITTER, SHARE, VIEWS, EVERY, FROM, MARGIN = (float(x) for x in os.environ.get("NRFGS_CARVE", "0.5,0.7,8,100,600,1.2").split(","))


class EmptySpace:
    def __init__(self, cameras, points, seed):
        import nrfgs_ns.training.twin as twin

        self.between, self.seed = twin.Between(cameras), seed
        self.points = points.detach().cpu()[:: max(len(points) // 10_000, 1)].float()
        self.near = [nearest_depth(self.points, cameras[i : i + 1]) for i in range(len(cameras))]
        self.removed = 0

    @torch.no_grad()
    def clear(self, models, step):
        if step % int(EVERY) or step < FROM:
            return
        random = Random(f"{self.seed} {step} empty")
        hits = [torch.zeros(len(model.means), dtype=torch.bool, device=model.device) for model in models]
        for _ in range(int(VIEWS)):
            view = self.between.draw(random, JITTER)
            limit = SHARE * min(nearest_depth(self.points, view), self.near[view.metadata["cam_idx"]])
            if limit > 0:
                for model, hit in zip(models, hits, strict=True):
                    seen, depths = in_view(model.means, view, MARGIN)
                    hit |= seen & (depths < limit)
        for model, hit in zip(models, hits, strict=True):
            logits = model.gauss_params["opacities"].data
            self.removed += int((hit & (logits.squeeze(-1) > -4)).sum())
            logits.masked_fill_(hit[:, None], -10.0)
        if step % 1000 == 0:
            print(f"Step {step}: {self.removed} splats cleared so far.", flush=True)
