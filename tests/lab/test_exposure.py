# SPDX-License-Identifier: Apache-2.0
"""The study of known exposures: what it puts on photographs, and what it reads back."""

import json

import numpy as np
import pytest
import torch
from PIL import Image

from nrfgs_lab.exposure import Study, exposed, make_data, recovered, split
from nrfgs_ns.image.photograph import PhotographModel


def test_a_stop_doubles_the_light_and_white_stays_white():
    grey = np.full((2, 2, 3), 118, np.uint8)  # sRGB of 0.181
    assert exposed(grey, [1.0, 1.0, 1.0])[0, 0].tolist() == [162, 162, 162]  # of 0.363
    assert exposed(grey, [0.0, 1.0, -1.0])[0, 0].tolist() == [118, 162, 85]  # of 0.091
    assert (exposed(np.full((1, 1, 3), 255, np.uint8), [1.0] * 3) == 255).all()


def test_only_training_photographs_are_exposed_anew_and_all_are_smaller(tiny_scene, tmp_path):
    study = Study(tiny_scene, tmp_path, stops=1.0)
    truth = study.exposures()
    assert np.abs(np.mean(list(truth.values()), axis=0)).max() < 1e-12
    make_data(tiny_scene, tmp_path / "varied", 2, truth)
    make_data(tiny_scene, tmp_path / "as-is", 2, None)
    meta = json.loads((tmp_path / "varied" / "transforms.json").read_text())
    assert (meta["w"], meta["h"]) == (24, 18) and (tmp_path / "varied" / meta["ply_file_path"]).is_file()
    assert json.loads((tmp_path / "varied" / "truth.json").read_text()) == truth
    train, test = split(meta)
    for frames, same in ((train, False), (test, True)):
        for frame in frames:
            one, other = (np.asarray(Image.open(tmp_path / data / frame["file_path"])) for data in ("varied", "as-is"))
            assert one.shape == (18, 24, 3)
            assert np.array_equal(one, other) == same


def test_what_was_learnt_is_compared_with_the_truth(tmp_path):
    truth = {"a": [0.5, 0.6, 0.4], "b": [-0.7, -0.5, -0.6], "c": [0.2, -0.1, 0.2]}
    model = PhotographModel(["a.png", "b.png", "c.png"], start=torch.tensor([*truth.values()]))
    checkpoint = tmp_path / "step-000000001.ckpt"
    state = {f"_model.photograph.{name}": value for name, value in model.state_dict().items()}
    torch.save({"step": 1, "pipeline": state}, checkpoint)
    (tmp_path / "truth.json").write_text(json.dumps(truth))
    found = recovered(checkpoint, tmp_path / "truth.json")
    assert found["correlation"] == pytest.approx(1.0) and found["rms_error_stops"] < 1e-6
    assert found["white_balance_rms_error_stops"] < 1e-6
    assert recovered(checkpoint, tmp_path / "none")["rms_stops"] == pytest.approx(found["rms_stops"])
    torch.save({"step": 1, "pipeline": {}}, checkpoint)
    assert recovered(checkpoint, tmp_path / "truth.json") is None
