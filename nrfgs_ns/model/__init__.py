# SPDX-License-Identifier: Apache-2.0
"""The model: nerfstudio's hooks, how a camera is rendered, what a checkpoint holds."""


def __getattr__(name: str):
    # Where a config.yml of an older version names them. At first use, so that each part of this room imports alone.
    if name in ("NrfgsModel", "NrfgsModelConfig"):
        from nrfgs_ns.model import model

        return getattr(model, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
