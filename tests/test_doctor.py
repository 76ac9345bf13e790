# SPDX-License-Identifier: Apache-2.0
"""`nrfgs doctor`: what is missing is named with its fix, and the status says whether training works."""

import contextlib
import sys
from importlib.metadata import PackageNotFoundError
from unittest.mock import Mock

import pytest
import torch

from nrfgs_ns import doctor
from nrfgs_ns.densification import statistics
from nrfgs_ns.image import ssim
from nrfgs_ns.kernels.trial import tried_once
from nrfgs_ns.training import optimizers, pipeline

DECLARED = {
    "torch>=2.6": "2.15.0+cpu",
    "gsplat>=1.4,!=1.5.0": "1.4.0",
    "pycolmap>=4.2": "4.2.1",
    "winonly>=1; sys_platform == 'win32'": None,
    "pillow-heif>=1.0; extra == 'heic'": "1.8.1",
    "flip-evaluator>=1.6; extra == 'flip'": "1.7",
    "pytest>=8; extra == 'dev'": None,
}
CPU = torch.device("cpu")


@pytest.fixture
def installed(monkeypatch) -> dict[str, str | None]:
    """Versions of declared packages, None where missing; to be changed. Imports and the machine are not looked at."""
    versions = {doctor.Requirement(text).name: found for text, found in DECLARED.items()}

    def version(name: str) -> str:
        if versions.get(name, "0.2.0") is None:
            raise PackageNotFoundError(name)
        return versions.get(name, "0.2.0")

    monkeypatch.setattr(doctor, "requires", lambda _: list(DECLARED))
    monkeypatch.setattr(doctor, "version", version)
    monkeypatch.setattr(doctor, "imports", Mock(return_value=[]))
    monkeypatch.setattr(doctor, "machine", Mock(return_value=[]))
    return versions


def faults() -> dict[str, doctor.Finding]:
    return {finding.name: finding for finding in doctor.packages() if finding.fix}


def test_nothing_is_wrong_where_all_is_there(installed, capsys):
    assert faults() == {}
    doctor.Doctor().main()
    printed = capsys.readouterr().out.splitlines()
    assert {"nrfgs-ns: 0.2.0", "torch: 2.15.0+cpu", "gsplat: 1.4.0", "pillow-heif: 1.8.1"} <= set(printed)
    assert not {"winonly", "pytest"} & {line.split(":")[0] for line in printed}, "not for this platform; for developers"
    assert doctor.imports.called and doctor.machine.called


@pytest.mark.parametrize("name, found, works", [
    *((name, None, True) for name in ("pycolmap", "pillow-heif", "flip-evaluator")),
    *(("torch", found, False) for found in (None, "2.5.1")),
    *(("gsplat", found, False) for found in (None, "1.5.0")),
])  # fmt: skip
def test_what_training_works_without(name, found, works, installed, capsys):
    installed[name] = found
    with contextlib.nullcontext() if works else pytest.raises(SystemExit) as stop:
        doctor.Doctor().main()
    assert works or stop.value.code not in (None, 0)
    assert list(faults()) == [name] and f"pip install '{name}" in capsys.readouterr().out
    assert doctor.imports.called == doctor.machine.called == works, "they import what is missing"


def test_what_cannot_be_imported_is_told(monkeypatch):
    assert not doctor.imports()[0].broken
    monkeypatch.setattr("nerfstudio.plugins.registry.entry_points", Mock(side_effect=OSError("libGL.so.1: missing")))
    monkeypatch.delitem(sys.modules, "nerfstudio.configs.method_configs")
    (finding,) = doctor.imports()
    assert finding.broken and finding.fix and "libGL.so.1: missing, in /" in finding.state


def test_kernels_that_fail_are_told_apart(monkeypatch):
    """gsplat's are needed; for Triton's there is PyTorch, and the reason is that of the trial."""
    monkeypatch.setattr(pipeline, "load_kernels", lambda _: None)
    for owner, name in ((ssim, "kernels_run_on"), (statistics, "try_kernel"), (optimizers, "try_kernel")):
        monkeypatch.setattr(owner, name, lambda _: True)
    monkeypatch.setattr("nrfgs_ns.appearance.nrf.NeuralResidualField.try_kernels", lambda *_: None)
    assert [(finding.fix, finding.broken) for finding in doctor.kernels(CPU)] == [("", False)] * 2
    monkeypatch.setattr(ssim, "kernels_run_on", tried_once("SSIM")(Mock(side_effect=OSError("no compiler"))))
    gsplat, triton = doctor.kernels(CPU)
    assert not gsplat.fix and not triton.broken and "SSIM" in triton.fix and "no compiler" in triton.fix
    monkeypatch.setattr(pipeline, "load_kernels", Mock(side_effect=ImportError("no nvcc")))
    gsplat, _ = doctor.kernels(CPU)
    assert gsplat.broken and "no nvcc" in gsplat.state and "nvcc" in gsplat.fix


@pytest.mark.gpu
def test_all_kernels_run_on_this_gpu():
    assert [finding.fix for finding in doctor.kernels(torch.device("cuda"))] == ["", ""]
