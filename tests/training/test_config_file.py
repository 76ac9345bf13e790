# SPDX-License-Identifier: Apache-2.0
"""config.yml: what a training saved is read back whole, and a file that asks for more is not obeyed."""

import re
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from nrfgs_ns import method_config
from nrfgs_ns.errors import InputError
from nrfgs_ns.training.config_file import read_config

WHOLE = yaml.dump(method_config.nrfgs.config)


@pytest.fixture
def read(tmp_path):
    def read(text: str):
        (tmp_path / "config.yml").write_text(text, encoding="utf-8")
        return read_config(tmp_path / "config.yml")

    return read


@pytest.mark.parametrize("name", ["nrfgs_best", "nrfgs_gsnb"])
def test_what_is_saved_is_read_back(read, name):
    config = replace(getattr(method_config, name).config, data=Path("/some where/scène"))
    assert read(yaml.dump(config)) == config


def test_enums_as_early_versions_of_python_3_11_write_them(read):
    kind = "nerfstudio.utils.writer.EventName"
    event = rf"!!python/object/apply:{kind}\n(\s*)- Train Iter \(time\)"
    early = rf"!!python/object/apply:builtins.getattr\n\1- !!python/name:{kind} ''\n\1- ITER_TRAIN_TIME"
    text, count = re.subn(event, early, WHOLE)
    assert count == 1 or sys.version_info < (3, 11, 4)
    assert read(text) == method_config.nrfgs.config


CALL = "!!python/object/apply:os.system ['touch {mark}']"
NAME = "!!python/name:nerfstudio"


def with_project(value: str) -> str:
    return WHOLE.replace("project_name: nerfstudio-project", value)


HOSTILE = {
    "a call": CALL,
    "a call with keywords": "!!python/object/apply:os.system\nargs: ['touch {mark}']",
    "a new object": "!!python/object/new:os.system ['touch {mark}']",
    "a call inside": with_project(f"project_name: {CALL}"),
    "a call in a path": with_project(f"project_name: !!python/object/apply:pathlib.Path [{CALL}]"),
    "a call through a package": "!!python/object/apply:nerfstudio.utils.scripts.run_command ['touch {mark}']",
    "a module of a package": "!!python/object/apply:nerfstudio.scripts.train.os.system ['touch {mark}']",
    "a module": "!!python/module:os",
    "a function as target": WHOLE.replace("name:nrfgs_ns.training.trainer.NrfgsTrainer ''", "name:os.system ''"),
    "another class": WHOLE.replace("name:torch.optim.adam.Adam", "name:nerfstudio.utils.writer.TensorboardWriter", 1),
    "a method of a configuration": with_project("setup: !!python/name:torch.optim.adam.Adam ''"),
    "an object that is no configuration": "!!python/object:nerfstudio.engine.trainer.Trainer {}",
    "an object of another package": "!!python/object:subprocess.Popen {}",
    "a list": "[1, 2]",
    "nothing": "",
    "no YAML": "{]",
    "deep": "[" * 2_000,
    "an attribute": "!!python/object/apply:builtins.getattr [!!python/name:os.path '', sep]",
    "an attribute of a class": "!!python/object/apply:builtins.getattr "
    f"[{NAME}.engine.trainer.TrainerConfig '', setup]",
    "an attribute of an enum": f"!!python/object/apply:builtins.getattr [{NAME}.utils.writer.EventName '', __class__]",
    "a class that is gone": WHOLE.replace("nrf.NrfConfig", "gone.NrfConfig"),
    "a value that the enum lacks": "!!python/object/apply:nerfstudio.utils.writer.EventName ['no such']",
}


@pytest.mark.parametrize("text", HOSTILE.values(), ids=HOSTILE.keys())
def test_a_file_that_asks_for_more_is_refused(read, tmp_path, text):
    mark = tmp_path / "mark"
    text = text.replace("{mark}", str(mark))
    assert text != WHOLE
    with pytest.raises(InputError, match="config.yml is not") as refused:
        read(text)
    assert "\n" not in str(refused.value) and not mark.exists()
    assert "gone" not in text or "package is missing or broken (ModuleNotFoundError: No" in str(refused.value)
    if "touch" in text:  # the file is one that would have been obeyed, or would have failed for another reason
        assert "it asks for" in str(refused.value) or "could not determine a constructor" in str(refused.value)


TYPES = {
    "hidden_width: 64": ("hidden_width: wide", "pipeline.model.appearance.hidden_width is 'wide'"),
    "max_num_iterations: 0": ("max_num_iterations: [1]", r"max_num_iterations is \[1\]"),
    "vis: viewer": ("vis: view", "vis is 'view'"),
    "load_scheduler: true": ("load_scheduler: 3", "load_scheduler is 3"),
    "lr: 0.05": ("lr: fast", "optimizers.opacities.optimizer.lr is 'fast'"),
}


@pytest.mark.parametrize("old", TYPES)
def test_a_value_of_another_type_is_refused(read, old):
    assert old in WHOLE
    new, message = TYPES[old]
    with pytest.raises(InputError, match=f"config.yml: {message}, which is not of its type"):
        read(WHOLE.replace(old, new))


def test_a_pipeline_refuses_it_too():
    """nerfstudio's own commands read the file without these checks."""
    config = replace(method_config.nrfgs.config.pipeline, model=3)
    with pytest.raises(InputError, match="pipeline.model is 3, which is not of its type, NrfgsModelConfig"):
        config.setup(device="cpu")


def test_an_option_that_is_newer_than_the_file_has_its_default(read):
    config = replace(method_config.nrfgs.config, average_steps=3)
    text = yaml.dump(config)
    for option in ("average_steps: 3\n", "    view_noise: 0.5\n", r"    camera_optimizer: .*\n(?:      .*\n)+"):
        text, count = re.subn(option, "", text)
        assert count == 1
    found = read(text)
    assert found.average_steps is None and found.pipeline.model.view_noise == 0.0
    assert found.pipeline.model.camera_optimizer == config.pipeline.model.camera_optimizer


def test_a_group_of_options_that_is_gone_is_read(read):
    group = "  sharding: !!python/object:nrfgs_ns.training.pipeline.ShardingConfig\n    rebalance_at: 1.1\n"
    assert read(WHOLE.replace("  model: ", f"{group}  model: ", 1)) == method_config.nrfgs.config


def test_the_choice_of_fused_kernels_is_read(read):
    text, count = re.subn("implementation: auto", "implementation: fused", WHOLE)
    assert count == 1 and read(text).pipeline.model.appearance.implementation == "fused"


def test_a_file_that_is_not_there_or_no_configuration(tmp_path):
    for cut in (WHOLE[:1], WHOLE[:1000], WHOLE[:-2], WHOLE[: WHOLE.index("viewer:")]):
        (tmp_path / "cut").write_text(cut)
        with pytest.raises(InputError):
            read_config(tmp_path / "cut")
    with pytest.raises(InputError, match="no such file. Name the config.yml"):
        read_config(tmp_path / "config.yml")
    (tmp_path / "binary").write_bytes(bytes(range(256)))
    with pytest.raises(InputError, match="not a configuration: .* Name the config.yml"):
        read_config(tmp_path / "binary")
