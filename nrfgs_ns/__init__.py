# SPDX-License-Identifier: Apache-2.0
"""NRF-GS for nerfstudio: Gaussian splatting with a neural residual field instead of spherical harmonics.

A splat's colour and opacity, seen from a camera, come from an appearance head; everything else is splatfacto.
"""

import sys
from importlib import import_module
from importlib.machinery import ModuleSpec
from types import ModuleType

__version__ = "0.1.0"

MOVED = {
    "nrfgs_ns.capacity": None,
    "nrfgs_ns.capacity.config": "nrfgs_ns.model.retired",
    "nrfgs_ns.densification.consistent": "nrfgs_ns.model.retired",
    "nrfgs_ns.diffuse_splats": "nrfgs_ns.model.retired",
    "nrfgs_ns.distributed.config": "nrfgs_ns.training.pipeline",
    "nrfgs_ns.pipeline": "nrfgs_ns.training.pipeline",
    "nrfgs_ns.trainer": "nrfgs_ns.training.trainer",
    "nrfgs_ns.training.sharding": "nrfgs_ns.training.pipeline",
}
"""Modules that a config.yml saved by an older version may name -> where their classes are now. None: a package of some
of them."""


class MovedModules:
    """Imports a module under its old name as the very module that it is now, so that its classes are the same ones."""

    @staticmethod
    def find_spec(name: str, path=None, target=None) -> ModuleSpec | None:
        if name not in MOVED:
            return None
        return ModuleSpec(name, MovedModules, is_package=MOVED[name] is None)

    @staticmethod
    def create_module(spec: ModuleSpec) -> None:
        return None

    @staticmethod
    def exec_module(module: ModuleType) -> None:
        if MOVED[module.__name__] is not None:
            sys.modules[module.__name__] = import_module(MOVED[module.__name__])


sys.meta_path.append(MovedModules)
