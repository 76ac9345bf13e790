# SPDX-License-Identifier: Apache-2.0
"""Trained models, for what looks at them or writes them."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

from nrfgs_ns.errors import InputError

if TYPE_CHECKING:  # nerfstudio takes seconds to import: `nrfgs --help` answers at once
    from nerfstudio.engine.trainer import TrainerConfig

    from nrfgs_ns.model.model import NrfgsModel
    from nrfgs_ns.training.pipeline import NrfgsPipeline


class Trained(NamedTuple):
    """A finished training."""

    config: "TrainerConfig"
    pipeline: "NrfgsPipeline"
    """in evaluation mode"""
    checkpoint: Path
    step: int


def load_training(path: Path, mode: Literal["test", "inference"]) -> Trained:
    """A finished training, set up as by nerfstudio's `eval_setup`; but its config.yml runs no code.

    Args:
        path: its config.yml.
        mode: "test" reads the test images; "inference" none, and fits harmonics to the head.

    Raises:
        InputError: there is no such training, or it is not one of this project's methods.
    """
    import torch
    from nerfstudio.utils.eval_utils import eval_load_checkpoint

    from nrfgs_ns.training.config_file import read_config
    from nrfgs_ns.training.pipeline import NrfgsPipelineConfig

    config = read_config(path)
    if not isinstance(config.pipeline, NrfgsPipelineConfig):
        raise InputError(f"{path}: a training of {config.method_name}. Use nerfstudio's own commands for it.")
    config.load_dir = config.get_checkpoint_dir()
    pipeline = config.pipeline.setup(device="cuda" if torch.cuda.is_available() else "cpu", test_mode=mode)
    pipeline.eval()
    try:
        return Trained(config, pipeline, *eval_load_checkpoint(config, pipeline))
    except (SystemExit, IndexError) as error:  # nerfstudio has said on the screen where it looked
        raise InputError(
            f"{path}: its checkpoints cannot be found. Run this in the folder where the training was started: paths in "
            "config.yml are relative to it."
        ) from error


def load_model(path: Path, mode: Literal["test", "inference"]) -> "NrfgsPipeline":
    """The pipeline of `load_training`."""
    return load_training(path, mode).pipeline


def load_file(path: Path) -> "NrfgsModel":
    """The model in a compact file, in evaluation mode; it needs no config.yml and no data set.

    Raises:
        InputError: as `decode`.
    """
    import torch
    from nerfstudio.data.scene_box import SceneBox

    from nrfgs_ns.compact.decode import decode, model_state
    from nrfgs_ns.model.model import NrfgsModelConfig

    decoded = decode(path)
    means, render = decoded.splats["means"], decoded.header.get("render", {})
    mode, background = render.get("rasterize_mode"), render.get("background")
    if mode not in ("classic", "antialiased") or not isinstance(background, list) or len(background) != 3:
        raise InputError(f"{path} does not say how it is rendered. Export it again with nrfgs export compact.")
    name = {(0, 0, 0): "black", (1, 1, 1): "white"}.get(tuple(background), "random")
    config = NrfgsModelConfig(appearance=decoded.config, rasterize_mode=mode, background_color=name)
    model = config.setup(
        scene_box=SceneBox(torch.stack([means.amin(0), means.amax(0)])),
        num_train_data=1,
        seed_points=(means, torch.zeros_like(means)),
    )
    model.load_state_dict(model_state(model, path))
    model.background_color = torch.tensor(background, dtype=torch.float32)
    model.to("cuda" if torch.cuda.is_available() else "cpu")
    model.update_to_step(config.stop_split_at)
    return model.eval()
