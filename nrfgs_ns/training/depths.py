# SPDX-License-Identifier: Apache-2.0
"""Trial: depths that several photographs agree on, as a term of the loss."""

from random import Random

import torch

from nrfgs_ns.rasterizer import Pinhole, composite, project_view

GEOMETRY = "means", "scales", "quats", "opacities"


def depth_pull(training, maps, step):
    model = training.pipeline.model
    weight, every, shape, until = model.config.depth.split(",")
    if maps is None or step % int(every) or model.schedule_step > 30000 * float(until):
        return {}
    views, inverse, agreed = maps
    one = Random(f"{model._seed} depth {step}").randrange(len(inverse))
    matrix, K = views.world_to_camera[one][None], views.intrinsics[one][None]
    height, width = agreed.shape[1:]
    center = torch.linalg.inv(views.world_to_camera[one])[:3, 3].contiguous()
    pinhole = Pinhole(matrix.contiguous(), K.contiguous(), width, height, center)
    params = model.gauss_params
    view = project_view(params, pinhole, model.projection_options)
    opacities = torch.sigmoid(params["opacities"]).flatten()[view.visible]
    known = agreed[one]
    if not bool(known.any()):
        return {}
    target = -inverse[one].clamp_min(1e-9).log()
    middle = target[known].mean()
    target = target - middle
    u = view.projection.depths.clamp_min(1e-6).log() - middle
    features = torch.stack([u * u, u, torch.ones_like(u)], dim=-1)
    render, alpha, _ = composite(view.projection, features, opacities, backgrounds=features.new_zeros(1, 3))
    r = render[0]
    error = r[..., 0] - 2 * target * r[..., 1] + target * target * r[..., 2]
    error = (error / r[..., 2].clamp_min(0.05)).clamp_min(0.0)
    if shape == "root":
        error = (error + 0.05**2).sqrt() - 0.05
    loss = float(weight) * (error * known).mean()
    names = [name for name in GEOMETRY if name in params]
    grads = torch.autograd.grad(loss, [params[name] for name in names])
    training.depth_loss = loss.detach()
    return dict(zip((params[name] for name in names), grads))
