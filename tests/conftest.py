# SPDX-License-Identifier: Apache-2.0
import os
import signal
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest
from hypothesis import settings

# A first example pays for imports and allocations; how long one takes says nothing.
settings.register_profile("nrfgs", deadline=None)
settings.load_profile("nrfgs")

# A suite that a script starts in the background ignores Ctrl-C, and so would the processes that tests start.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Modules that several test files share. tests/ itself would let its folders pass for packages, such as nerfbaselines.
HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE / d) for d in ("helpers", "fixtures", "appearance", "densification", "image", "rasterizer")]

from processes import hide_open3d, keep_what_is_imported, let_go, open3d_shown  # noqa: E402

hide_open3d()

SCENES = Path(os.environ.get("NRFGS_SCENES", Path(__file__).resolve().parents[2] / "shared" / "scenes"))


def pytest_configure(config):
    """Without `-m gpu` there is no GPU: on which device a training runs is decided when the methods are imported."""
    if "gpu" not in config.option.markexpr.replace("not gpu", ""):
        os.environ["CUDA_VISIBLE_DEVICES"] = ""


def pytest_runtest_setup(item):
    if item.get_closest_marker("gpu"):
        import torch

        if not torch.cuda.is_available():
            pytest.skip("needs a CUDA device and gsplat's kernels")


def pytest_collection_finish():
    keep_what_is_imported()


def pytest_unconfigure():
    let_go()


@pytest.fixture
def captures() -> Path:
    """Folder of real captures (NRFGS_SCENES, else shared/scenes beside the checkout); skips where there is none."""
    if not (SCENES / "fox" / "transforms.json").exists():
        pytest.skip(f"no real captures in {SCENES}; set NRFGS_SCENES to a folder that has fox, kitchen, ...")
    return SCENES


@pytest.fixture(scope="session")
def tiny_scene(tmp_path_factory) -> Path:
    """A procedural data set of 10 views, 48 x 36, with 300 points."""
    from nrfgs_lab.scenes import SceneConfig, write_scene

    config = SceneConfig(views=10, width=48, height=36, points=300, samples=1)
    return write_scene(config, tmp_path_factory.mktemp("data") / "tiny")


@pytest.fixture
def export_gaussian_splat():
    """ExportGaussianSplat of nerfstudio's exporter, which imports open3d; skips where that does not import."""
    with open3d_shown():
        try:
            from nerfstudio.scripts.exporter import ExportGaussianSplat
        except ImportError as error:
            pytest.skip(f"ns-export imports open3d, which does not import here: {error}")
        yield ExportGaussianSplat


@pytest.fixture
def dataset_render():
    """DatasetRender of `ns-render`, which imports mediapy, which imports IPython; skips where that is missing."""
    pytest.importorskip("IPython", reason="ns-render imports IPython, which is not installed")
    from nerfstudio.scripts.render import DatasetRender

    return DatasetRender


@pytest.fixture
def no_cuda(monkeypatch):
    """Make anything that needs CUDA fail: gsplat's compiled kernels, `.cuda()`; and hide a GPU that is there."""
    import torch

    refuse = Mock(side_effect=AssertionError("CUDA was asked for on the CPU path"))
    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", None)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.Tensor, "cuda", refuse)
    monkeypatch.setattr(torch.nn.Module, "cuda", refuse)


@pytest.fixture(scope="module")
def any_share():
    """Let trainings of a few steps average over any share of them."""
    from nrfgs_ns.training import averaging

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(averaging, "LARGEST_SHARE", 1.0)
        yield


@pytest.fixture
def no_heif(monkeypatch):
    """Hide pillow-heif."""
    from nrfgs_ns.data.pictures import read_heif

    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    read_heif.cache_clear()  # a failure is not kept


@pytest.fixture
def capture(tmp_path):
    """A capture of ten images (`small_capture.Capture`)."""
    from small_capture import Capture

    return Capture(tmp_path / "capture", images=10)


@pytest.fixture
def printed(capsys):
    """A function: what was printed since it was last called, in one line."""
    return lambda: " ".join(capsys.readouterr().out.split())
