# SPDX-License-Identifier: Apache-2.0
"""Nerfbaselines' `Method` around this project's trainer; nothing of nerfbaselines is needed to import it.

A checkpoint is a folder:

    config.yml                    the training's configuration, as nerfstudio writes it
    world.json                    the way from the data set's world to the model's, and what else the images decide
    nerfstudio_models/step-*.ckpt parameters, optimisers and generators, as `ns-train` writes them

With the training set a training goes on from it as if it had never stopped; without, it renders.
"""

import contextlib
import copy
import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.engine.callbacks import TrainingCallbackLocation
from nerfstudio.scripts.train import _set_random_seed
from nerfstudio.utils import writer

from nrfgs_ns.data.views import different_views
from nrfgs_ns.errors import InputError
from nrfgs_ns.model.model import NrfgsModel
from nrfgs_ns.nerfbaselines.photos import World, background_of, hold_in_memory
from nrfgs_ns.training.checkpoint_files import read_or_refuse
from nrfgs_ns.training.config_file import read_config
from nrfgs_ns.training.identity import leaves
from nrfgs_ns.training.trainer import NrfgsTrainer
from nrfgs_ns.training.trainer_config import NrfgsTrainerConfig, parse

MODELS = "nerfstudio_models"


class Nrfgs:
    """`ns-train nrfgs`.

    Args:
        train_dataset: nerfbaselines' data set with its images; only rendering can do without.
        config_overrides: options of `ns-train`, with their dots: {"pipeline.model.appearance.latent_dim": 16}. Not
            read with a checkpoint, which has its own.

    Raises:
        InputError: an option is unknown or out of range, the data cannot be used, or there is neither data nor
            checkpoint.
    """

    method = "nrfgs"

    def __init__(
        self,
        *,
        checkpoint: str | None = None,
        train_dataset: dict[str, Any] | None = None,
        config_overrides: dict[str, Any] | None = None,
    ):
        if checkpoint is None and train_dataset is None:
            raise InputError("Give a training data set to train on, or a checkpoint to render from.")
        self.checkpoint = None if checkpoint is None else Path(checkpoint)
        self.trainer: NrfgsTrainer | None = None
        if self.checkpoint is None:
            config = configure(self.method, config_overrides or {}, train_dataset["metadata"])
            self.config = config.for_views(different_views(torch.from_numpy(train_dataset["cameras"].poses)))
            self.world = World.around(train_dataset["cameras"].poses, self.config.pipeline.datamanager.dataparser)
        else:
            self.config, self.record, self.file = _read_checkpoint(self.checkpoint)
            self.world = World(torch.tensor(self.record["transform"], dtype=torch.float64), self.record["scale"])
        if train_dataset is None:
            loaded = read_or_refuse(self.file)
            self.model = _build_model(copy.deepcopy(self.config), self.record, loaded)
            self.step = loaded["step"] + 1
        else:
            self._set_up_training(train_dataset)
        self.loaded_step = None if self.checkpoint is None else self.step

    def _set_up_training(self, dataset: dict[str, Any]) -> None:
        config = copy.deepcopy(self.config)  # its classes are replaced, which a file should not say
        hold_in_memory(config.pipeline.datamanager, dataset, self.world)
        self.folder = tempfile.TemporaryDirectory(prefix="nrfgs-")
        config.output_dir = Path(self.folder.name)
        if self.checkpoint is not None:
            config.load_checkpoint = self.file
        _set_random_seed(config.machine.seed)
        trainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        trainer.guard.step = trainer._start_step
        trainer.guard.check_parameters(trainer.optimizers)
        if trainer.pace is not None:
            trainer.pace.start()
        self.trainer, self.model, self.step = trainer, trainer.pipeline.model, trainer._start_step
        self.record = {
            "transform": self.world.transform.tolist(),
            "scale": self.world.scale,
            "scene_unit": self.model.scene_unit,
            "training_images": len(dataset["image_paths"]),
        }

    @classmethod
    def get_method_info(cls) -> dict[str, Any]:
        """Requirements on the data, and outputs."""
        return {
            "method_id": cls.method,
            "required_features": frozenset(("color", "points3D_xyz", "points3D_rgb")),
            "supported_camera_models": frozenset(("pinhole",)),
            "supported_outputs": ("color", {"name": "depth", "type": "depth"}, "accumulation"),
            "can_resume_training": True,
        }

    def get_info(self) -> dict[str, Any]:
        """Steps, checkpoint, and options: dotted names and values that are numbers, strings, truth values or None."""
        options = leaves(self.config)
        return {
            **self.get_method_info(),
            "num_iterations": self.config.max_num_iterations,
            "loaded_step": self.loaded_step,
            "loaded_checkpoint": None if self.checkpoint is None else str(self.checkpoint),
            "batch_size": 1,
            "eval_batch_size": 1,
            "hparams": {name: value for name, value in options if isinstance(value, (int, float, str, type(None)))},
        }

    def train_iteration(self, step: int) -> dict[str, float]:
        """One step.

        Args:
            step: from 0, or from the loaded step.

        Returns:
            loss, its terms and metrics, every `logging.steps_per_log` steps; {} between: no step waits for a GPU.

        Raises:
            TrainingStopped: a number is not finite.
        """
        if self.trainer is None:
            raise InputError("This method was loaded without a training data set. Give one to train.")
        trainer = self.trainer
        trainer.step = step
        trainer.pipeline.train()
        for callback in trainer.callbacks:
            callback.run_callback_at_location(step, location=TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
        loss, losses, metrics = trainer.train_iteration(step)
        for callback in trainer.callbacks:
            callback.run_callback_at_location(step, location=TrainingCallbackLocation.AFTER_TRAIN_ITERATION)
        if step == trainer.last_step:
            trainer.take_the_mean()
        writer.EVENT_STORAGE.clear()  # nobody reads nerfstudio's log
        self.step = step + 1
        if step % self.config.logging.steps_per_log != 0:
            return {}
        return {name: float(value) for name, value in {**metrics, **losses, "loss": loss}.items()}

    @torch.no_grad()
    def render(self, camera: Any, *, options: dict[str, Any] | None = None) -> dict[str, np.ndarray]:
        """Render one camera of the data set's world, float32: color [H, W, 3] in [0, 1], depth [H, W] in the data set's
        unit of length, accumulation [H, W]; or those that options["outputs"] names."""
        self.model.eval()
        outputs = self.model.get_outputs_for_camera(self.world.cameras(camera.item()[None]).to(self.model.device))
        rendered = {
            "color": outputs["rgb"],
            "depth": outputs["depth"][..., 0] / self.world.scale,
            "accumulation": outputs["accumulation"][..., 0],
        }
        wanted = (options or {}).get("outputs") or rendered
        return {name: value.cpu().numpy() for name, value in rendered.items() if name in wanted}

    def get_train_embedding(self, index: int) -> None:
        """There are no appearance embeddings."""

    def optimize_embedding(self, dataset: dict[str, Any], *, embedding: np.ndarray | None = None) -> dict[str, Any]:
        """Raise NotImplementedError: there are no appearance embeddings."""
        raise NotImplementedError

    def save(self, path: str) -> None:
        """Write a checkpoint into a folder."""
        folder = Path(path)
        models = folder / MODELS
        models.mkdir(parents=True, exist_ok=True)
        (folder / "config.yml").write_text(yaml.dump(self.config), encoding="utf-8")
        (folder / "world.json").write_text(json.dumps(self.record, indent=1) + "\n", encoding="utf-8")
        if self.trainer is None:
            with contextlib.suppress(shutil.SameFileError):
                shutil.copyfile(self.file, models / self.file.name)  # nerfbaselines asks for the same bytes
            return
        self.trainer.checkpoint_dir = models
        self.trainer.save_checkpoint(self.step - 1)

    def close(self) -> None:
        """Remove what is only needed while training."""
        if self.trainer is not None:
            self.folder.cleanup()


def _method(name: str) -> type[Nrfgs]:
    return type(f"Nrfgs{name.title()}", (Nrfgs,), {"method": f"nrfgs-{name}", "__doc__": f"`ns-train nrfgs-{name}`."})


NrfgsFast, NrfgsBest, NrfgsSh = map(_method, ("fast", "best", "sh"))
NrfgsVdgs, NrfgsGsnb, NrfgsSg = map(_method, ("vdgs", "gsnb", "sg"))


def configure(method: str, overrides: dict[str, Any], metadata: dict[str, Any]) -> NrfgsTrainerConfig:
    """The configuration of a training, parsed as by `ns-train`.

    Args:
        overrides: options and their values, which win over the data set's background in `metadata`.

    Raises:
        InputError: an option is unknown, or belongs to a loop that nerfbaselines does not run.
    """
    background = background_of(metadata)
    words = [] if background is None else ["--pipeline.model.background_color", background]
    for name, value in overrides.items():
        values = value if isinstance(value, (list, tuple)) else [value]
        words += [f"--{name}", *map(str, values)]
    try:
        config = parse([method, *words])
    except SystemExit as error:  # tyro has said on the screen which one, and what there is
        raise InputError(f"These are not options of ns-train {method}: {overrides}") from error
    if config.time_budget is not None or config.machine.num_devices > 1:
        raise InputError("time_budget and machine.num_devices are ns-train's: here nerfbaselines counts the steps.")
    config.vis, config.logging.profiler, config.logging.local_writer.enable = "", "none", False
    config.timestamp, config.data = "nerfbaselines", None
    return config


def _read_checkpoint(folder: Path) -> tuple[NrfgsTrainerConfig, dict[str, Any], Path]:
    """The configuration for this machine's device, the content of world.json, and the file of the parameters."""
    files = list((folder / MODELS).glob("*.ckpt"))
    try:
        record = json.loads((folder / "world.json").read_text(encoding="utf-8"))
        record = {name: record[name] for name in ("transform", "scale", "scene_unit", "training_images")}
        (file,) = files
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{folder} is not a whole checkpoint of nrfgs, a world.json and one file in {MODELS} ({error!r}). Copy it "
            "again."
        ) from error
    config = read_config(folder / "config.yml")
    config.machine.device_type = "cuda" if torch.cuda.is_available() else "cpu"
    return config, record, file


def _build_model(config: NrfgsTrainerConfig, record: dict[str, Any], content: dict[str, Any]) -> NrfgsModel:
    """The model of a checkpoint, without its images."""
    few = torch.rand(4, 3, generator=torch.Generator().manual_seed(0))  # the checkpoint's splats take their place
    model = config.pipeline.model.setup(
        scene_box=SceneBox(aabb=torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])),
        num_train_data=record["training_images"],
        metadata={"scene_unit": record["scene_unit"]},
        device=config.machine.device_type,
        grad_scaler=None,
        seed_points=(few, 255 * few),
    )
    model.update_to_step(content["step"])
    own = "_model."
    model.load_state_dict(
        {name.removeprefix(own): value for name, value in content["pipeline"].items() if name.startswith(own)}
    )
    return model.to(config.machine.device_type)
