# SPDX-License-Identifier: Apache-2.0
"""Nerfbaselines' `Method` around this project's trainer; nothing of nerfbaselines is needed to import it.

Nerfbaselines' poses are camera-to-world with y down and z forwards (OpenCV), in the data set's own world; nerfstudio's
have y up and z backwards, in a world that is turned upright, centred and scaled to the cameras. A checkpoint is a
folder:

    config.yml                    the training's configuration, as nerfstudio writes it
    world.json                    the transform from the data set's world, and what else depends on the images
    nerfstudio_models/step-*.ckpt parameters, optimisers and generators, as `ns-train` writes them

With the training set a training resumes from it exactly; without, it renders.
"""

import contextlib
import copy
import json
import math
import shutil
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import yaml
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataparserOutputs
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.engine.callbacks import TrainingCallbackLocation
from nerfstudio.utils import writer
from torch import Tensor

from nrfgs_lab.training_run import parse, set_up
from nrfgs_ns.data.datamanager import NrfgsDatamanager, NrfgsDatamanagerConfig, NrfgsInputDataset
from nrfgs_ns.data.dataparser import NrfgsDataParserConfig, place
from nrfgs_ns.data.views import different_views
from nrfgs_ns.errors import InputError
from nrfgs_ns.model.model import NrfgsModel
from nrfgs_ns.training.checkpoint_files import read
from nrfgs_ns.training.config_file import read_config
from nrfgs_ns.training.identity import leaves
from nrfgs_ns.training.pace import TimedPace
from nrfgs_ns.training.trainer import NrfgsTrainer
from nrfgs_ns.training.trainer_config import NrfgsTrainerConfig

MODELS = "nerfstudio_models"


class Nrfgs:
    """`ns-train nrfgs`.

    Args:
        checkpoint: folder to resume or render from.
        train_dataset: nerfbaselines' data set with its images; only rendering from a checkpoint can do without.
        config_overrides: options of `ns-train`, with their dots: {"pipeline.model.appearance.latent_dim": 16}. A
            checkpoint has its own.

    """

    method = "nrfgs"

    def __init__(
        self,
        *,
        checkpoint: str | None = None,
        train_dataset: dict[str, Any] | None = None,
        config_overrides: dict[str, Any] | None = None,
    ):
        self.checkpoint = None if checkpoint is None else Path(checkpoint)
        self.trainer: NrfgsTrainer | None = None
        if self.checkpoint is None:
            poses = train_dataset["cameras"].poses
            config = configure(self.method, config_overrides or {}, train_dataset["metadata"])
            self.config = config.for_views(different_views(torch.from_numpy(poses)))
            self.world = World.around(poses, self.config.pipeline.datamanager.dataparser)
        else:
            self.config = read_config(self.checkpoint / "config.yml")
            self.config.machine.device_type = "cuda" if torch.cuda.is_available() else "cpu"
            (self.file,) = (self.checkpoint / MODELS).glob("*.ckpt")
            self.record = json.loads((self.checkpoint / "world.json").read_text(encoding="utf-8"))
            self.world = World(torch.tensor(self.record["transform"], dtype=torch.float64), self.record["scale"])
        if train_dataset is None:
            content = read(self.file)
            self.model = _build_model(copy.deepcopy(self.config), self.record, content)
            self.step = content["step"] + 1
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
        trainer = set_up(config)
        trainer.guard.step = trainer._start_step
        trainer.guard.check_parameters(trainer.optimizers)
        if isinstance(trainer.pace, TimedPace):
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
        """One step, counted from 0: the loss, its terms and metrics every `logging.steps_per_log` steps; {} between,
        so that no step waits for a GPU."""
        trainer = self.trainer
        trainer.step = step
        trainer.pipeline.train()
        for callback in trainer.callbacks:
            callback.run_callback_at_location(step, location=TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
        loss, losses, metrics = trainer.train_iteration(step)
        for callback in trainer.callbacks:
            callback.run_callback_at_location(step, location=TrainingCallbackLocation.AFTER_TRAIN_ITERATION)
        if step == trainer.last_step:
            trainer.install_mean()
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
        raise NotImplementedError

    def save(self, path: str) -> None:
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


NrfgsFast, NrfgsBest, NrfgsSh, NrfgsHarmonics = map(_method, ("fast", "best", "sh", "harmonics"))
NrfgsVdgs, NrfgsGsnb, NrfgsSg = map(_method, ("vdgs", "gsnb", "sg"))


def configure(method: str, overrides: dict[str, Any], metadata: dict[str, Any]) -> NrfgsTrainerConfig:
    """The configuration of a training, parsed as by `ns-train`; `overrides` win over the data set's background.

    Raises:
        InputError: an option belongs to what nerfbaselines does itself, or the background is neither black nor white.
        SystemExit: an option is unknown; tyro has said which.
    """
    words = []
    if (color := metadata.get("background_color")) is not None:
        name = {(0, 0, 0): "black", (255, 255, 255): "white"}.get(tuple(np.asarray(color).tolist()))
        if name is None:
            raise InputError(f"The data set's background is {np.asarray(color)}; only black and white are known.")
        words = ["--pipeline.model.background_color", name]
    for name, value in overrides.items():
        words += [f"--{name}", *map(str, value if isinstance(value, (list, tuple)) else [value])]
    config = parse([method, *words])
    resized = config.pipeline.datamanager.camera_res_scale_factor != 1.0
    if config.time_budget is not None or config.machine.num_devices > 1 or resized:
        raise InputError(
            "time_budget, machine.num_devices and camera_res_scale_factor are ns-train's: here nerfbaselines counts "
            "the steps, starts the process and sizes the images."
        )
    config.vis, config.logging.profiler, config.logging.local_writer.enable = "", "none", False
    config.timestamp, config.data = "nerfbaselines", None
    return config


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


class World(NamedTuple):
    """The map from the data set's world to the one that is trained in, x -> scale (R x + t)."""

    transform: Tensor  # [R | t], float64 [3, 4], R a rotation
    scale: float  # > 0

    @classmethod
    def around(cls, poses: np.ndarray, options: NrfgsDataParserConfig) -> "World":
        """The world that nerfstudio's parser, with these options, makes of nerfbaselines' poses [V, 3 or 4, 4]."""
        rows = np.tile(np.eye(4), (len(poses), 1, 1))
        rows[:, :3] = _opengl(poses).numpy()
        how = (options.orientation_method, options.center_method, options.auto_scale_poses, options.scale_factor)
        _, transform, scale = place(rows, *how)
        return cls(transform.double(), scale)

    def points(self, xyz: Tensor) -> Tensor:
        """Points float64 [N, 3] of the data set's world in this one."""
        return self.scale * (xyz @ self.transform[:, :3].T + self.transform[:, 3])

    def cameras(self, given: Any) -> Cameras:
        """Nerfbaselines' pinhole cameras [V] as nerfstudio's."""
        poses = _opengl(given.poses)
        rotation = self.transform[:, :3] @ poses[:, :, :3]
        center = self.points(poses[:, :, 3])
        intrinsics = torch.from_numpy(np.array(given.intrinsics, dtype=np.float32))
        sizes = torch.from_numpy(np.array(given.image_sizes, dtype=np.int64))
        return Cameras(
            camera_to_worlds=torch.cat([rotation, center[..., None]], dim=-1).float(),
            **{name: intrinsics[:, i].contiguous() for i, name in enumerate(("fx", "fy", "cx", "cy"))},
            **{name: sizes[:, i].contiguous() for i, name in enumerate(("width", "height"))},
            camera_type=CameraType.PERSPECTIVE,
        )


def _opengl(poses: np.ndarray) -> Tensor:
    """Poses [V, 3 or 4, 4] with y up and z backwards, float64 [V, 3, 4]."""
    return torch.from_numpy(np.asarray(poses, dtype=np.float64)[:, :3] * np.array([1.0, -1.0, -1.0, 1.0]))


def hold_in_memory(config: NrfgsDatamanagerConfig, dataset: dict[str, Any], world: World) -> None:
    """Let a datamanager hold nerfbaselines' training set, by its classes, since nerfstudio copies configurations."""
    cameras, images, masks = world.cameras(dataset["cameras"]), dataset["images"], dataset.get("masks")
    metadata: dict[str, Tensor] = {}
    if (xyz := dataset.get("points3D_xyz")) is not None:
        metadata["points3D_xyz"] = world.points(torch.from_numpy(np.array(xyz, dtype=np.float64))).float()
        metadata["points3D_rgb"] = torch.from_numpy(dataset["points3D_rgb"])
    outputs = DataparserOutputs([Path(path) for path in dataset["image_paths"]], cameras, metadata=metadata)

    class GivenParser(DataParser):
        """The same for all splits."""

        def _generate_dataparser_outputs(self, split: str = "train") -> DataparserOutputs:
            return outputs

    class GivenImages(NrfgsInputDataset):
        """The images in memory, which nerfbaselines may have padded to one size."""

        def _cropped(self, images, index: int) -> np.ndarray:
            """Bytes as they are, truth values as 0 and 255, floats in [0, 1] times 255, rounded."""
            width, height = self._sizes[index]
            image = np.asarray(images[index])[:height, :width]
            return image if image.dtype == np.uint8 else np.rint(255.0 * np.clip(image, 0.0, 1.0)).astype(np.uint8)

        def get_numpy_image(self, image_idx: int) -> np.ndarray:
            image = self._cropped(images, image_idx)
            return image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=-1)

        def get_data(self, image_idx: int, image_type="float32") -> dict[str, Any]:
            data = super().get_data(image_idx, image_type)
            if masks is not None:
                data["mask"] = torch.from_numpy(self._cropped(masks, image_idx) > 127)[..., None]
            return data

    class GivenDatamanager(NrfgsDatamanager):
        """The training set alone: nerfbaselines evaluates."""

        dataset_type = GivenImages

        def create_eval_dataset(self):
            return self.train_dataset

        def load_all_images(self) -> tuple[int, int]:
            return len(self.cached_train), 0

    config._target, config.dataparser._target = GivenDatamanager, GivenParser
    config.image_memory = math.inf  # they are in memory
