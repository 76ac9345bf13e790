# SPDX-License-Identifier: Apache-2.0
"""On a CUDA device: a field that has lost parts, and splats without residual, train on the fused kernels.
`pytest -m gpu tests/test_gpu_necessity.py`."""

from dataclasses import replace

import pytest
import torch

from nrfgs_ns.appearance.diffuse import DIFFUSE
from nrfgs_ns.studies.run import evaluate, parse

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]

OPTIONS = {
    "--max-num-iterations": 300,
    "--vis": "tensorboard",
    "--steps-per-eval-image": 100000,
    "--steps-per-eval-all-images": 100000,
    "--logging.profiler": "none",
    "--logging.local-writer.enable": False,
    "--pipeline.model.num-downscales": 0,
    "--pipeline.model.warmup-length": 50,
    "--pipeline.model.refine-every": 20,
    "--pipeline.model.appearance.output-init": "default",
    # An error instead of PyTorch, whatever is dropped; and products as exact as PyTorch's.
    "--pipeline.model.appearance.implementation": "fused",
    "--pipeline.model.appearance.precision": "fp32",
    "--pipeline.model.capacity": "auto",
    "--pipeline.model.capacity-search.step": 120,
    "--pipeline.model.capacity-search.settle": 8,
    "--pipeline.model.capacity-search.tolerance-db": 100.0,
    "--pipeline.model.diffuse.start": 80,
    "--pipeline.model.diffuse.every": 60,
    "--pipeline.model.diffuse.trial": 8,
    "--pipeline.model.diffuse.stop": 160,
    "--pipeline.model.diffuse.threshold": 4.0,
}


def test_a_smaller_field_with_diffuse_splats_trains_and_is_its_twin(tiny_scene, tmp_path):
    words = [str(word) for option in OPTIONS.items() for word in option]
    config = parse(["nrfgs", "--data", str(tiny_scene), "--output-dir", str(tmp_path), *words])
    config.save_config()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    trainer.train()
    model = trainer.pipeline.model
    found = model.capacity_found["head"]
    assert found == {"latent_dim": 1, "num_bands": 1, "opacity_residual": False, "use_distance": False}
    diffuse = model.densification.state[DIFFUSE]
    assert 0 < int(diffuse.sum()) < len(diffuse) == model.num_points
    for name in ("latents", "field"):  # all of it has learnt, and Adam holds the tensors that are drawn
        held = trainer.optimizers.optimizers[name].param_groups[0]["params"]
        drawn = list(model.head.parameters()) if name == "field" else [model.gauss_params["latents"]]
        assert [id(one) for one in held] == [id(one) for one in drawn]
        for parameter in held:
            assert trainer.optimizers.optimizers[name].state[parameter]["exp_avg"].shape == parameter.shape

    twin = replace(model.head.config, implementation="torch").setup().to(model.device)
    twin.load_state_dict(model.head.state_dict())
    twin.scene_unit = model.head.scene_unit
    model.eval()
    with torch.no_grad():
        view = model.look(trainer.pipeline.datamanager.train_view(0)[0])
    answers = {}
    for name, head in (("fused", model.head), ("torch", twin)):
        splats = {key: value.detach() for key, value in view.splats.items()}
        splats["latents"] = splats["latents"].clone().requires_grad_()
        head.zero_grad(set_to_none=True)
        colors, opacities = head(splats, view.visible, view.center)
        (colors.square().sum() + opacities.sum()).backward()
        weights = [weight.grad for weight in head.parameters()]
        answers[name] = (colors.detach(), opacities.detach()), [splats["latents"].grad, *weights]
    # Sums of 64 products of numbers up to 10; three tf32 products leave 2^-21 of each: 3e-4, behind a scale of 0.2.
    for fused, plain in zip(answers["fused"][0], answers["torch"][0], strict=True):
        torch.testing.assert_close(fused, plain, rtol=0, atol=1e-4)
    # A hidden unit next to zero may be on in one and off in the other: as between devices, 1 % of the whole.
    for fused, plain in zip(answers["fused"][1], answers["torch"][1], strict=True):
        assert (fused - plain).norm() <= 1e-2 * plain.norm() + 1e-6
    diffuse_seen = diffuse[view.visible]
    assert diffuse_seen.any() and (answers["fused"][1][0][diffuse] == 0).all()

    results = evaluate(config.get_base_dir() / "config.yml", tmp_path / "eval.json")
    assert results["psnr"] > 12 and results["splats"] == model.num_points
