# SPDX-License-Identifier: Apache-2.0
"""On a CUDA device: both back ends show the same scene, and trainings run. `pytest -m gpu`."""

import pytest
import torch
from nerfstudio.engine.optimizers import Optimizers
from short_trainings import PLAIN, SMOKE_METHODS, SMOKE_STEPS, bound, command_line, untrained
from torch.testing import assert_close

from nrfgs_lab.training_run import evaluate, train
from nrfgs_ns.appearance.sh import eval_sh

pytestmark = pytest.mark.gpu


@pytest.mark.parametrize("degree", range(4))
def test_harmonics_kernel_against_the_torch_twin(degree):
    torch.manual_seed(0)
    directions, coefficients = torch.randn(500, 3), torch.randn(500, 16, 3)
    leaves = [directions.requires_grad_(), coefficients.requires_grad_()]
    on_gpu = [leaf.detach().cuda().requires_grad_() for leaf in leaves]
    twin, kernel = eval_sh(degree, *leaves), eval_sh(degree, *on_gpu)
    # 16 products of numbers around 3, each rounded at 2^-24 of itself; the kernel is compiled with fast math.
    assert_close(kernel.cpu(), twin, rtol=0, atol=2e-5)
    weight = torch.randn_like(twin)
    twin.backward(weight)
    kernel.backward(weight.cuda())
    for cpu, gpu in zip(leaves, on_gpu, strict=True):
        if cpu.grad is not None:
            assert_close(gpu.grad.cpu(), cpu.grad, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("method", SMOKE_METHODS)
def test_one_step_is_the_same_on_both_devices(method, tiny_scene, tmp_path):
    """The same splats, camera and background: image, loss and gradients of every parameter."""
    results = {}
    for device in ("cpu", "cuda"):
        words = "--pipeline.model.background-color black --pipeline.model.few-views off"
        if method == "nrfgs":  # zero outputs would hide the layers before them; fp32 as on the CPU
            words += " --pipeline.model.appearance.output-init default --pipeline.model.appearance.precision fp32"
        pipeline = untrained(tiny_scene, tmp_path, method, *words.split(), device=device)
        model = pipeline.model
        # Splats start round, and turning a round splat changes nothing: its quaternion's gradient is rounding alone.
        model.gauss_params["scales"].data += 0.5 * torch.randn(model.num_points, 3).to(device)
        model.step_cb(Optimizers({}, {}), 10**6)
        camera, batch = pipeline.datamanager.next_train(0)
        outputs = model(camera)
        model.get_loss_dict(outputs, batch)["main_loss"].backward()
        parameters = [*model.gauss_params.items(), *model.head.named_parameters()]
        gradients = {name: value.grad.cpu() for name, value in parameters if value.grad is not None}
        results[device] = (outputs["rgb"].detach().cpu(), gradients)
    rgb, gradients = results["cpu"]
    # A contribution that one device cuts at alpha = 1/255 and the other keeps moves a pixel by at most 1/255.
    assert (results["cuda"][0] - rgb).abs().max() < 1 / 255
    assert (results["cuda"][0] - rgb).abs().mean() < 1e-5
    assert gradients.keys() == results["cuda"][1].keys()
    for name, gradient in gradients.items():
        if gradient.norm() == 0:  # layers behind a zero, in heads that start so
            assert results["cuda"][1][name].norm() == 0, name
            continue
        error = (results["cuda"][1][name] - gradient).norm() / gradient.norm()
        assert error < 1e-2, (name, error)


@pytest.mark.parametrize("method", SMOKE_METHODS)
def test_train_and_eval_on_the_gpu(method, tiny_scene, tmp_path):
    record = train(command_line(method, tiny_scene, tmp_path, SMOKE_STEPS, PLAIN, {"--steps-per-eval-all-images": 100}))
    assert record.peak_memory_bytes > 0
    assert evaluate(record.config_path, tmp_path / "eval.json")["psnr"] > bound(f"tiny/{method}")
