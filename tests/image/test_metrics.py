# SPDX-License-Identifier: Apache-2.0
"""Metrics against other libraries, under masks and at their edges; LPIPS with and without weights; the colour fit."""

import functools
import json
import math

import numpy as np
import pytest
import pytorch_msssim
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torchmetrics.image import PeakSignalNoiseRatio

from nrfgs_ns.image import metrics
from nrfgs_ns.image.metrics import METRIC_NAMES, fit_colors, image_metrics, l1, ms_ssim, psnr, ssim, ssim_maps

SCALARS = (psnr, l1, ssim, ms_ssim)


def pair(height: int, width: int, noise: float = 0.1, dtype=torch.float32) -> tuple[torch.Tensor, torch.Tensor]:
    """A smooth image with some texture, and a noisy copy of it."""
    generator = torch.Generator().manual_seed(height * 1000 + width)
    y, x = torch.meshgrid(torch.linspace(0, 6, height), torch.linspace(0, 9, width), indexing="ij")
    gt = 0.5 + 0.3 * torch.stack([torch.sin(x * y), torch.cos(x + y), torch.sin(3 * x)], dim=-1)
    return (gt + noise * torch.randn(gt.shape, generator=generator)).clamp(0, 1).to(dtype), gt.to(dtype)


def disc(height: int, width: int, radius: float) -> torch.Tensor:
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return ((y - height / 2) ** 2 + (x - width / 2) ** 2 < radius**2)[..., None]


def batch(image: torch.Tensor) -> torch.Tensor:
    return image.movedim(-1, 0)[None]


@pytest.mark.parametrize("height, width", [(11, 11), (40, 61), (161, 200), (230, 175)])
@pytest.mark.parametrize("noise", [0.003, 0.1])
def test_values_are_those_of_other_libraries(height, width, noise):
    pred, gt = pair(height, width, noise)
    # float32 sums of at most 10^5 terms: 1e-6 relative. PSNR takes 10 log10 of them: 4.3e-6 dB.
    expected = PeakSignalNoiseRatio(data_range=1.0)(batch(pred), batch(gt)).item()
    assert psnr(pred, gt) == pytest.approx(expected, abs=1e-5)
    assert l1(pred, gt) == pytest.approx((pred - gt).abs().mean().item(), rel=1e-5)
    assert ssim(pred, gt) == pytest.approx(pytorch_msssim.ssim(batch(pred), batch(gt), data_range=1.0).item(), abs=1e-5)
    if min(height, width) > 160:
        expected = pytorch_msssim.ms_ssim(batch(pred), batch(gt), data_range=1.0).item()
        assert ms_ssim(pred, gt) == pytest.approx(expected, abs=1e-5)


def test_perfect_inverted_and_diverged_predictions():
    _, gt = pair(170, 165)
    values = image_metrics(gt, gt)
    assert values["psnr"] == pytest.approx(100.0) and values["l1"] == 0.0  # capped: JSON has no infinity
    # In float32 cs and ssim are quotients of equal numbers, each rounded once or twice.
    assert values["ssim"] == pytest.approx(1.0, abs=1e-6) and values["ms_ssim"] == pytest.approx(1.0, abs=1e-6)
    json.dumps(values, allow_nan=False)
    # Negative contrast-structure terms are clamped: a power of them would not be a number.
    _, gt = pair(170, 190)
    expected = pytorch_msssim.ms_ssim(batch(1 - gt), batch(gt), data_range=1.0).item()
    assert ms_ssim(1 - gt, gt) == pytest.approx(expected, abs=1e-6) == 0.0
    pred, gt = pair(170, 170)
    pred[80, 80] = float("nan")
    assert all(math.isnan(metric(pred, gt)) for metric in SCALARS)


@given(st.integers(1, 14), st.integers(1, 14), st.booleans())
@settings(max_examples=40)
def test_small_images_give_a_number_or_none(height, width, masked):
    pred, gt = pair(height, width)
    values = image_metrics(pred, gt, torch.ones(height, width, 1, dtype=torch.bool) if masked else None)
    assert tuple(values) == METRIC_NAMES
    assert math.isfinite(values["psnr"]) and math.isfinite(values["l1"])
    assert (values["ssim"] is not None) == (min(height, width) >= 11)
    assert values["ms_ssim"] is None and values["lpips"] is None


def test_an_empty_mask_gives_none_and_one_without_a_window_no_ssim_but_a_thin_one_survives_the_coarse_scales():
    pred, gt = pair(170, 165)
    mask = torch.zeros(170, 165, 1, dtype=torch.bool)
    assert set(image_metrics(pred, gt, mask).values()) == {None}
    mask[:5] = True
    assert psnr(pred, gt, mask) is not None and l1(pred, gt, mask) is not None
    assert ssim(pred, gt, mask) is None and ms_ssim(pred, gt, mask) is None
    pred, gt = pair(200, 220)
    mask = torch.zeros(200, 220, 1, dtype=torch.bool)
    mask[:, 101] = True  # one pixel wide, odd: gone after one halving by majority
    assert 0 < ms_ssim(pred, gt, mask) < 1


def test_what_lies_outside_the_mask_does_not_count():
    pred, gt = pair(170, 180)
    mask = disc(170, 180, 50)
    garbage = torch.where(mask, pred, torch.rand(pred.shape))
    garbage[0, 0] = float("nan")
    for metric in SCALARS:
        assert metric(garbage, gt, mask) == metric(pred, gt, mask)
    assert psnr(torch.where(mask, gt + 0.1, gt), gt, mask) == pytest.approx(20.0, abs=1e-4)  # -10 log10(0.1^2)


def test_masked_ssim_is_the_mean_over_centres_inside():
    pred, gt = pair(60, 70, dtype=torch.float64)
    mask = disc(60, 70, 14)
    ssim_map = ssim_maps(*(image.movedim(-1, 0) for image in (torch.where(mask, pred, gt), gt)))[0]
    expected = np.mean([ssim_map[:, i - 5, j - 5].mean() for i, j, _ in mask.nonzero().tolist()])
    assert ssim(pred, gt, mask) == pytest.approx(expected, abs=1e-12)


@pytest.mark.gpu
@pytest.mark.parametrize("masked", [False, True])
def test_cuda_agrees_with_cpu(masked):
    pred, gt = pair(300, 400, noise=0.01)
    mask = disc(300, 400, 100) if masked else None
    on_cpu, on_cuda = image_metrics(pred, gt, mask), image_metrics(pred.cuda(), gt, mask)
    for name in ("psnr", "ssim", "ms_ssim", "l1"):
        assert on_cuda[name] == pytest.approx(on_cpu[name], rel=1e-5), name  # TF32 would be off by 1e-3


@pytest.fixture
def hub(tmp_path, monkeypatch):
    """An empty torch hub folder and a fresh warning."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(metrics, "_lpips_net", functools.cache(metrics._lpips_net.__wrapped__))
    monkeypatch.setattr("torch.hub.download_url_to_file", lambda *_, **__: pytest.fail("a download was tried"))
    folder = tmp_path / "hub" / "checkpoints"
    folder.mkdir(parents=True)
    return folder


@pytest.fixture
def weights(hub):
    """Random AlexNet weights where torchvision looks for the trained ones."""
    from torchvision.models import alexnet

    torch.manual_seed(0)
    path = hub / "alexnet-owt-7be5be79.pth"
    torch.save(alexnet(weights=None).state_dict(), path)
    return path


def test_lpips_without_weights_is_none_and_says_how_to_get_them(hub):
    assert image_metrics(*pair(40, 40))["lpips"] is None
    advice = metrics.lpips_advice()
    assert str(hub / "alexnet-owt-7be5be79.pth") in advice and "load_state_dict_from_url" in advice


def test_lpips_with_broken_weights_is_none(weights):
    weights.write_bytes(weights.read_bytes()[:1000])
    assert image_metrics(*pair(40, 40))["lpips"] is None
    assert "cannot be loaded" in metrics.lpips_advice()


def test_lpips_with_weights(weights):
    """Random features do not judge images, but they tell equal from different, and inside from outside."""
    pred, gt = pair(64, 72)
    mask = disc(64, 72, 20)

    def lpips(*images):
        return image_metrics(*images)["lpips"]

    assert lpips(gt, gt) == 0.0
    assert lpips(pred, gt) > 0
    # Under a mask the truth stands outside.
    assert lpips(pred, gt, mask) == lpips(torch.where(mask, pred, gt), gt) > 0
    assert lpips(torch.where(mask, gt, pred), gt, mask) == 0.0
    assert lpips(pred, gt, torch.zeros_like(mask)) is None
    # Overshoot is clamped, not refused; a diverged prediction shows.
    assert lpips(gt + 2, gt) == lpips(torch.ones_like(gt), gt)
    assert math.isnan(lpips(torch.full_like(gt, float("nan")), gt))

    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

    reference = LearnedPerceptualImagePatchSimilarity(net_type="alex", normalize=True)
    assert lpips(pred, gt) == reference(batch(pred), batch(gt)).item()
    assert lpips(*pair(30, 64)) is None and math.isfinite(lpips(*pair(31, 64)))


def test_a_fit_undoes_an_affine_change_of_colours_inside_the_mask():
    truth = torch.rand(20, 30, 3) * 0.6 + 0.2
    pred = truth @ torch.tensor([[0.8, 0.1, 0.0], [0.0, 0.7, 0.05], [0.1, 0.0, 0.9]]) + 0.03
    torch.testing.assert_close(fit_colors(pred, truth), truth, atol=1e-5, rtol=0)
    truth = torch.rand(12, 12, 3) * 0.5 + 0.25
    pred, mask = truth * 0.5 + 0.1, torch.zeros(12, 12, 1, dtype=torch.bool)
    mask[3:9, 3:9] = True
    pred = torch.where(mask, pred, torch.zeros_like(pred))
    torch.testing.assert_close(fit_colors(pred, truth, mask)[3:9, 3:9], truth[3:9, 3:9], atol=1e-5, rtol=0)
    truth, flat = torch.rand(5, 5, 3), torch.full((5, 5, 3), 0.4)
    torch.testing.assert_close(fit_colors(flat, truth), truth.mean((0, 1)).expand(5, 5, 3), atol=1e-5, rtol=0)
    assert fit_colors(flat, truth, torch.zeros(5, 5, 1, dtype=torch.bool)) is flat
    flat[0, 0, 0] = torch.nan
    assert fit_colors(flat, truth) is flat
