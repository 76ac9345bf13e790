# SPDX-License-Identifier: Apache-2.0
"""Trained models, for what looks at them or writes them."""

from pathlib import Path
from typing import Literal

from nrfgs_ns.errors import InputError


def load_model(config: Path, mode: Literal["test", "inference"]):
    """The pipeline of a finished training, in evaluation mode.

    Raises:
        InputError: there is no such training, or it is not one of this project's methods.
    """
    from nerfstudio.utils.eval_utils import eval_setup

    from nrfgs_ns.model.model import NrfgsModel

    if not config.is_file():
        raise InputError(f"--load-config {config}: no such file. Name the config.yml that the training saved.")
    try:
        _, pipeline, _, _ = eval_setup(config, test_mode=mode)
    except (SystemExit, IndexError) as error:  # nerfstudio has said on the screen where it looked
        raise InputError(
            f"--load-config {config}: its checkpoints cannot be found. Run this in the folder where the training was "
            "started: paths in config.yml are relative to it."
        ) from error
    if not isinstance(pipeline.model, NrfgsModel):
        raise InputError(f"--load-config {config}: a {type(pipeline.model).__name__}. Use ns-export for it.")
    return pipeline
