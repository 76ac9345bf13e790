# SPDX-License-Identifier: Apache-2.0
"""`nrfgs doctor`: what is installed, what runs on this machine, and how to get what is missing."""

import importlib
import platform
import sys
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from traceback import extract_tb

from packaging.requirements import Requirement

PACKAGE, TRAINING = "nrfgs-ns", "training"
EXTRAS = {
    "": TRAINING,
    "kernels": "the fused kernels on a GPU",
    "heic": "HEIC photographs",
    "lab": "`nrfgs bench`",
    "flip": "FLIP in `nrfgs bench`",
    "browser": "tests of pages in browsers (nothing else)",
}
"""Extras of the package -> what they are for."""


@dataclass
class Finding:
    """A line of the report; `fix` is "" where nothing is missing, and without what is `broken` no training works."""

    name: str
    state: str
    fix: str = ""
    broken: bool = False


def packages() -> list[Finding]:
    """Versions of Python and of all packages that this one declares."""
    findings = [Finding(PACKAGE, version(PACKAGE)), Finding("Python", platform.python_version())]
    for requirement in map(Requirement, requires(PACKAGE)):
        name, marker = requirement.name, requirement.marker
        if uses := [use for extra, use in EXTRAS.items() if marker is None or marker.evaluate({"extra": extra})]:
            use = "`nrfgs prepare`" if name == "pycolmap" else uses[0]
            try:
                installed = version(name)
                fits = requirement.specifier.contains(installed, prereleases=True)
            except PackageNotFoundError:
                installed, fits = "missing", False
            fix = "" if fits else f"For {use} run `pip install '{name}{requirement.specifier}'`."
            findings.append(Finding(name, installed, fix, not fits and use == TRAINING))
    return findings


def imports() -> list[Finding]:
    """Whether what `ns-train nrfgs` needs can be imported: libraries of the system may be missing, and one package that
    registers a method and cannot be imported takes all methods along."""
    try:
        importlib.import_module("nerfstudio.configs.method_configs")
    except Exception as error:
        fix = "Install what it names; docs/troubleshooting.md has the common cases."
        where = f"{type(error).__name__}: {error}, in {extract_tb(error.__traceback__)[-1].filename}"
        return [Finding("ns-train nrfgs", f"cannot be imported ({where})", fix, True)]
    return [Finding("ns-train nrfgs", "can be imported")]


def machine() -> list[Finding]:
    """The weights of LPIPS; the GPU and what runs there, or what its absence means."""
    import torch

    from nrfgs_ns.image.metrics import lpips_advice

    advice = lpips_advice()
    findings = [Finding("LPIPS", "its weights are missing" if advice else "its weights are on disk", advice or "")]
    build = f"PyTorch is built {f'for CUDA {torch.version.cuda}' if torch.version.cuda else 'without CUDA'}"
    if not torch.cuda.is_available():
        need = "its driver" if torch.version.cuda else "a build of PyTorch for CUDA"
        fix = f"Training runs on the CPU, slowly; to use an NVIDIA GPU install {need}."
        return [*findings, Finding("GPU", f"none; {build}", fix)]
    free, total = (size / 1e9 for size in torch.cuda.mem_get_info())
    gpu = Finding("GPU", f"{torch.cuda.get_device_name()}, {free:.1f} of {total:.1f} GB free; {build}")
    return [*findings, gpu, *kernels(torch.device("cuda", torch.cuda.current_device()))]


def kernels(device) -> list[Finding]:
    """Whether gsplat's kernels load, which compiles them if that is to be done, for minutes; whether Triton's run."""
    from nrfgs_ns.appearance.nrf import NrfConfig
    from nrfgs_ns.kernels import trial
    from nrfgs_ns.training.pipeline import kernels_of

    load_gsplat, *trials = kernels_of(NrfConfig().setup())
    reasons: list[str] = []
    trial.logger.addFilter(note := lambda record: reasons.append(record.getMessage()))
    try:
        load_gsplat(device)
        gsplat = Finding("gsplat's kernels", "load")
    except Exception as error:
        fix = "They are compiled at first use: install a C++ compiler and the CUDA toolkit (nvcc) of PyTorch's version."
        gsplat = Finding("gsplat's kernels", f"do not load ({type(error).__name__}: {error})", fix, True)
    for attempt in trials:
        attempt(device)
    trial.logger.removeFilter(note)
    fix = f"Training is slower; install Triton and a C compiler: {' '.join(reasons)}" if reasons else ""
    return [gsplat, Finding("Triton's kernels", "do not all run" if reasons else "run", fix)]


@dataclass
class Doctor:
    """Print versions, the GPU and what is missing, with a fix for each. The status is 1 if no training works."""

    def main(self) -> None:
        findings: list[Finding] = []
        for look in (packages, imports, machine):
            if not any(finding.broken for finding in findings):  # later ones import what may be missing
                findings += look()
        for finding in findings:
            print(f"{finding.name}: {finding.state}" + f"\n    {finding.fix}" * bool(finding.fix))
        if any(finding.broken for finding in findings):
            sys.exit("nrfgs: training does not work here.")
