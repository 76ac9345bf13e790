# SPDX-License-Identifier: Apache-2.0
"""The laboratory's heads at the pixel: gradients, the viewer, refusals. training/test_lifecycle.py trains them."""

from pathlib import Path

import pytest
import torch
from nerfstudio.utils.eval_utils import eval_setup
from short_trainings import command_line, trained

from nrfgs_lab.heads.deferred import DeferredConfig
from nrfgs_lab.heads.latent_spec import LatentSpecConfig
from nrfgs_lab.training_run import evaluate
from nrfgs_ns.appearance.head import Field
from nrfgs_ns.errors import InputError
from nrfgs_ns.export.command import Compact, Ply, Web
from nrfgs_ns.rasterizer import Pinhole, ProjectionOptions, composite_view, project_view, world_to_camera
from nrfgs_ns.viewer.pictures import BASE, DEPTH, FULL, legends, picture

pytestmark = pytest.mark.usefixtures("no_cuda")


SHARP = {"--pipeline.model.num-downscales": 0}


@pytest.fixture(scope="module", params=["nrfgs-deferred", "nrfgs-latent-spec"])
def finished(request, tiny_scene, tmp_path_factory) -> tuple[str, Path]:
    return request.param, trained(command_line(request.param, tiny_scene, tmp_path_factory.mktemp("out"), 60, SHARP))


SMALL = {
    "deferred": DeferredConfig(channels=6, hidden_width=5, hidden_layers=2),
    "deferred, features as they are": DeferredConfig(channels=4, harmonics=False, hidden_width=5, hidden_layers=1),
    "latent-spec": LatentSpecConfig(diffuse_dim=3, specular_dim=1, hidden_width=1),
}


@pytest.mark.parametrize("name", SMALL)
def test_gradients_agree_with_finite_differences(name):
    """From the image through the network and the rasterizer to means, opacities, features and shared weights."""
    torch.manual_seed(0)
    head = SMALL[name].setup().double()
    means = torch.tensor([[0.1, 0.2, 0.0], [-0.3, 0.1, 0.4], [0.2, -0.2, -0.5]], dtype=torch.float64)
    quats = torch.tensor([[1.0, 0.2, 0, 0], [1, 0, 0.3, 0], [1, 0, 0, 0.4]], dtype=torch.float64)
    scales = torch.tensor([[-1.0, -0.8, -1.2]] * 3, dtype=torch.float64)
    stored = {"means": means, "opacities": torch.tensor([[0.3], [-0.2], [0.6]], dtype=torch.float64)}
    stored |= head.splat_params(torch.rand(3, 3, dtype=torch.float64))
    weights = dict(head.named_parameters())
    center = torch.tensor([0.1, -0.1, 3.0], dtype=torch.float64)
    pose = torch.cat([torch.eye(3, dtype=torch.float64), center[:, None]], dim=1)[None]
    K = torch.tensor([[[6.0, 0, 2.5], [0, 6.0, 2.0], [0, 0, 1]]], dtype=torch.float64)
    camera, background = Pinhole(world_to_camera(pose), K, 5, 4, center), torch.full((3,), 0.4, dtype=torch.float64)

    class Drawn(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.head = head

        def forward(self, *values):
            splats = {**dict(zip(stored, values, strict=True)), "quats": quats, "scales": scales}
            view = project_view(splats, camera, ProjectionOptions())
            seen = Field(head, splats).seen_from(view)
            return composite_view(view, seen, background, image_of=head.image_of, look=lambda rgb: rgb)[0]["rgb"]

    def f(*inputs):
        shared = {f"head.{key}": value for key, value in zip(weights, inputs[len(stored) :], strict=True)}
        return torch.func.functional_call(Drawn(), shared, inputs[: len(stored)])

    inputs = [*stored.values(), *(weight.detach().clone() for weight in weights.values())]
    assert torch.autograd.gradcheck(f, [x.requires_grad_() for x in inputs])


def test_it_learns(finished, tiny_scene, tmp_path):
    first = trained(command_line(finished[0], tiny_scene, tmp_path, 1, SHARP))
    untrained, learnt = (evaluate(config, tmp_path / "eval.json")["psnr"] for config in (first, finished[1]))
    assert learnt > untrained + 1.0


@pytest.mark.parametrize("command", [Ply, Compact, Web])
def test_exports_refuse(command, finished, tmp_path):
    with pytest.raises(InputError, match="colours pixels.*no file of splats can hold it"):
        command(finished[1], output=tmp_path / "file").main()


def test_every_picture_of_the_viewer(finished):
    method, config = finished
    pipeline = eval_setup(config)[1]
    model, camera = pipeline.model, pipeline.datamanager.train_dataset.cameras[0:1]
    assert list(legends(model.field)) == [FULL, BASE, DEPTH]
    images = {mode: picture(model, camera, mode)["rgb"] for mode in legends(model.field)}
    gains = [picture(model, camera, gain=gain)["rgb"] for gain in (0.0, 0.5, 2.0)]
    assert all(image.shape == (36, 48, 3) and torch.isfinite(image).all() for image in (*images.values(), *gains))
    assert torch.equal(images[FULL], model.get_outputs_for_camera(camera)["rgb"])
    assert torch.equal(images[BASE], gains[0]) and torch.equal(images[BASE], model.get_base_color(camera))
    assert ((images[FULL] - images[BASE]).abs().max() > 0.01) == (method == "nrfgs-latent-spec")  # its diffuse image


def test_sizes_that_cannot_work_are_named():
    for config in (DeferredConfig(channels=7), DeferredConfig(channels=4), LatentSpecConfig(diffuse_dim=2)):
        with pytest.raises(InputError, match="channels|diffuse_dim"):
            config.setup()
