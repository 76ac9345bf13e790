# SPDX-License-Identifier: Apache-2.0
"""The PLY file: its layout, what the fit keeps of the head, and that nerfstudio's exporter writes the same."""

import base64
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
import short_trainings
import torch
import tyro
from compact_fields import plain_splats
from nerfstudio.data.dataparsers.nerfstudio_dataparser import MAX_AUTO_RESOLUTION
from plyfile import PlyData
from short_trainings import command_line, untrained
from torch.testing import assert_close

from nrfgs_ns.appearance.head import base_colors
from nrfgs_ns.appearance.sh import SphericalHarmonics, sh_bases
from nrfgs_ns.compact.decode import decode
from nrfgs_ns.errors import InputError
from nrfgs_ns.export import ply
from nrfgs_ns.export.command import Compact, Export, Ply, Web
from nrfgs_ns.export.frames import Y_DOWN
from nrfgs_ns.export.ply import read_splats, render_splats, write_splats
from nrfgs_ns.image.metrics import psnr
from nrfgs_ns.model import harmonics_fit, harmonics_tune
from nrfgs_ns.model.harmonics_fit import STRENGTHS, Moments, Observations, PlainSplats, fit_harmonics, observe
from nrfgs_ns.model.harmonics_tune import fine_tune
from nrfgs_ns.model.pinholes import pinhole
from nrfgs_ns.trained.loading import load_model

pytestmark = pytest.mark.usefixtures("no_cuda")

LAYOUT = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2".split()
LAYOUT += [f"f_rest_{i}" for i in range(45)] + "opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()
METHODS = {
    # A network that was never quieted: its residual depends on the view in ways that degree 3 cannot follow.
    # Other viewers have no near plane of ours, and of an untrained scene it hides some of what they show.
    "nrfgs": {
        "--pipeline.model.appearance.output-init": "default",
        "--pipeline.model.warmup-steps": 0,
        "--pipeline.model.near-plane": "off",
    },
    "nrfgs-sh": {"--pipeline.model.appearance.degree-interval": 1},
}


@pytest.fixture(autouse=True)
def short_fine_tune(monkeypatch):
    monkeypatch.setattr(harmonics_tune, "STEPS_ON_A_CPU", 8)


@pytest.fixture(scope="module")
def trained(tiny_scene, tmp_path_factory):
    """Method -> config.yml."""
    lines = {name: command_line(name, tiny_scene, tmp_path_factory.mktemp(name), 8, METHODS[name]) for name in METHODS}
    return {name: short_trainings.trained(line) for name, line in lines.items()}


def model_on(scene: Path, out: Path, method: str = "nrfgs", *options: str):
    """An untrained model of 300 splats, and its training cameras."""
    pipeline = short_trainings.untrained(scene, out, method, *options, mode="test").eval()
    return pipeline.model, pipeline.datamanager.train_dataset.cameras


def one_by_one(cameras):
    return [cameras[index : index + 1] for index in range(len(cameras))]


def test_layout_is_that_of_3dgs(tmp_path):
    splats = plain_splats(7)
    assert write_splats(splats, tmp_path / "deep" / "splats.ply") == 7
    header, _, body = (tmp_path / "deep" / "splats.ply").read_bytes().partition(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"] and "element vertex 7" in lines
    assert re.findall(r"property (\w+) (\w+)", header.decode()) == [("float", name) for name in LAYOUT]
    # Read without any PLY library: rows of 62 little-endian floats.
    table = dict(zip(LAYOUT, np.frombuffer(body, dtype="<f4").reshape(7, 62).T, strict=True))
    for axis, name in enumerate("xyz"):
        assert (table[name] == splats.means[:, axis].numpy()).all() and (table["n" + name] == 0).all()
    for channel in range(3):
        assert (table[f"f_dc_{channel}"] == splats.features_dc[:, channel].numpy()).all()
        for basis in range(15):
            assert (table[f"f_rest_{15 * channel + basis}"] == splats.features_rest[:, basis, channel].numpy()).all()
        assert (table[f"scale_{channel}"] == splats.scales[:, channel].numpy()).all()
    assert (table["opacity"] == splats.opacities[:, 0].numpy()).all()
    assert all((table[f"rot_{i}"] == splats.quats[:, i].numpy()).all() for i in range(4))
    assert_close(read_splats(tmp_path / "deep" / "splats.ply"), splats, rtol=0, atol=0)


def test_splats_that_cannot_be_drawn_are_left_out_also_of_a_turned_scene(tmp_path):
    splats = plain_splats(6)
    splats.quats[1] = math.nan  # there was no direction
    splats.features_rest[2, 7, 1] = math.inf
    splats.opacities[3] = -5.6  # below logit(1/255) = -5.537
    splats.opacities[4] = -5.5
    assert write_splats(splats, tmp_path / "splats.ply") == 3
    assert_close(read_splats(tmp_path / "splats.ply").means, splats.means[[0, 4, 5]], rtol=0, atol=0)
    splats.opacities[:] = -9.0
    with pytest.raises(InputError, match="none of the 6 splats"):
        write_splats(splats, tmp_path / "none.ply")
    assert not list(tmp_path.glob("none.ply*"))
    splats = plain_splats(4)
    splats.quats[2] = 0.0
    assert write_splats(Y_DOWN.moved(splats), tmp_path / "splats.ply") == 3


def test_a_head_that_is_harmonics_is_fitted_exactly(tiny_scene, tmp_path, monkeypatch):
    model, cameras = model_on(tiny_scene, tmp_path, "nrfgs-sh")
    monkeypatch.setattr(SphericalHarmonics, "is_harmonics", False)  # it does not say so
    # Below 0.5 in sum, so that no colour is clamped at zero: 15 harmonics of at most 1.2, coefficients around 0.02.
    model.gauss_params["features_rest"].data.normal_(0.0, 0.02)
    model.gauss_params["features_dc"].data.clamp_(-0.3, 0.3)
    fit = fit_harmonics(model, cameras)
    assert not fit.exact and fit.strength == STRENGTHS[0]

    errors, weights = torch.zeros(len(fit.splats.means)), torch.zeros(len(fit.splats.means))
    for camera in one_by_one(cameras):
        seen = observe(model, camera)
        delta = torch.cat([fit.splats.features_dc - model.features_dc, fit.splats.features_rest.flatten(1)], dim=1)
        found = torch.einsum("mb,mbc->mc", seen.bases, delta[seen.rows].reshape(-1, 16, 3))
        errors.index_add_(0, seen.rows, seen.weights * (found - seen.residuals).square().sum(-1))
        weights.index_add_(0, seen.rows, seen.weights)
    assert (weights > 0).sum() > 100
    rms = (errors / weights.clamp_min(1e-30)).sqrt().max()
    # Along an eigenvector of the gram matrix with eigenvalue e, a ridge s leaves e (s / (e + s))^2 k^2 <= s k^2 / 4 of
    # the squared error; so at most sqrt(s) |k| / 2 in all, with |k|^2 = 45 coefficients of variance 0.02^2 (three
    # deviations of their number: 75). To that, float32 colours and bases: 16 products rounded at 2^-24.
    assert rms < math.sqrt(STRENGTHS[0]) / 2 * math.sqrt(75) * 0.02 + 16 * 2**-24


def test_a_ridge_counts_in_views():
    """Seen in one view only, a splat moves 16 / (4 pi) / (16 / (4 pi) + ridge) of the way, whatever its size."""
    bases = sh_bases(3, torch.nn.functional.normalize(torch.tensor([[0.3, -0.5, 0.8]]), dim=-1))
    residual, power = torch.tensor([[0.1, -0.2, 0.05]]), 16 / (4 * math.pi)
    for weight in (1e-3, 1e4):
        for views in (1, 3):
            moments = Moments(2, torch.device("cpu"))
            for _ in range(views):
                moments.add(Observations(torch.tensor([1]), torch.tensor([weight]), bases, residual, torch.ones(1)))
            delta = moments.solve(0.5)
            assert (delta[0] == 0).all(), "what was not seen keeps its base colour"
            reached = torch.einsum("mb,bc->mc", bases.double(), delta[1])
            assert_close(reached, residual.double() * views * power / (views * power + 0.5), rtol=1e-6, atol=0)
            left = views * weight * float((reached - residual).square().sum())
            assert moments.squared_error(delta) == pytest.approx(left, rel=1e-5)


def test_work_in_pieces_gives_the_same_fit(tiny_scene, tmp_path, monkeypatch):
    model, cameras = model_on(tiny_scene, tmp_path, "nrfgs", "--pipeline.model.appearance.output-init", "default")
    whole = fit_harmonics(model, cameras)
    monkeypatch.setattr(harmonics_fit, "ROWS_AT_ONCE", 13)
    pieces = fit_harmonics(model, cameras)
    assert pieces[1:] == whole[1:]
    # The same sums in float64, in another order of nothing but batched products.
    for name, value in whole.splats._asdict().items():
        assert_close(getattr(pieces.splats, name), value, rtol=1e-5, atol=1e-6, msg=name)


class OpacityBySide(SphericalHarmonics):
    """Every other splat is transparent from one side, the others from the other."""

    is_harmonics = False

    def forward(self, splats, visible, camera_centers):
        appearance = super().forward(splats, visible, camera_centers)
        shown = (visible % 2 == 0) == bool(camera_centers[0] > 0)
        return appearance._replace(opacities=appearance.opacities * shown.float())


def test_opacity_is_the_mean_over_views_also_over_those_in_which_a_splat_is_transparent(tiny_scene, tmp_path):
    model, cameras = model_on(tiny_scene, tmp_path, "nrfgs-sh")
    model.head = OpacityBySide(model.config.appearance)
    model.gauss_params["means"].data[7] = 1e3  # in no view
    found = fit_harmonics(model, cameras).splats.opacities[:, 0].sigmoid()
    total, views = torch.zeros(model.num_points), torch.zeros(model.num_points)
    for camera in one_by_one(cameras):
        view = model.project(camera)
        total[view.visible] += model.field.seen_from(view).opacities
        views[view.visible] += 1
    pictured, stored = views > 0, model.gauss_params["opacities"].sigmoid()[:, 0]
    # A file's opacities keep 1e-6 away from 0 and 1, and are rounded as logits.
    assert_close(found[pictured], (total / views)[pictured], rtol=1e-5, atol=2e-6)
    assert ((found > 0.1 * stored) & (found < 0.9 * stored)).any()
    assert not pictured[7] and found[7] == stored[7]


def squared_distance(model, splats: PlainSplats, cameras) -> float:
    def off(camera) -> torch.Tensor:
        return render_splats(splats, camera, model.background_color) - model.get_outputs_for_camera(camera)["rgb"]

    return float(torch.stack([off(camera) for camera in one_by_one(cameras)]).square().mean())


def test_splats_that_not_all_views_show_are_drawn_closer_after_the_fine_tune(tiny_scene, tmp_path):
    """Also from beside the places from which it looked."""
    model, cameras = model_on(tiny_scene, tmp_path, "nrfgs-sh")
    model.head = OpacityBySide(model.config.appearance)
    fitted = fit_harmonics(model, cameras).splats
    tuned = fine_tune(model, fitted, cameras, 80)
    for name in ("means", "quats", "scales"):
        assert getattr(tuned, name) is getattr(fitted, name)
    beside = cameras[torch.arange(len(cameras))]
    centers = beside.camera_to_worlds[..., 3]
    beside.camera_to_worlds = torch.cat([beside.camera_to_worlds[..., :3], 1.05 * centers[..., None]], dim=-1)
    for places in (cameras, beside):
        before, after = (squared_distance(model, splats, places) for splats in (fitted, tuned))
        assert after < 0.7 * before


def test_the_fine_tune_leaves_alone_what_is_right(tiny_scene, tmp_path, monkeypatch):
    model, cameras = model_on(tiny_scene, tmp_path, "nrfgs-sh")
    monkeypatch.setattr(SphericalHarmonics, "is_harmonics", False)  # it does not say so
    fitted = fit_harmonics(model, cameras).splats
    # Of 255 steps of a screen, a hundredth.
    assert squared_distance(model, fine_tune(model, fitted, cameras, 20), cameras) < (0.01 / 255) ** 2


@pytest.mark.parametrize("method", METHODS)
def test_the_command_writes_the_splats_and_says_what_was_lost(method, trained, tmp_path):
    config, ours, report = trained[method], tmp_path / "ours.ply", tmp_path / "deep" / "report.json"
    tyro.cli(Export, args=["ply", "--load-config", str(config), "--output", str(ours), "--report", str(report)]).main()
    splats = PlyData.read(ours)["vertex"].data
    assert list(splats.dtype.names) == LAYOUT
    assert np.abs(sum(splats[f"rot_{i}"].astype(np.float64) ** 2 for i in range(4)) - 1).max() < 1e-6

    numbers = json.loads(report.read_text())
    assert numbers["written"] == len(splats) <= numbers["splats"] and numbers["bytes"] == ours.stat().st_size
    assert len(numbers["per_image"]) == 2 and numbers["views"] == "test"
    assert numbers["loss_db"] == pytest.approx(numbers["psnr_model"] - numbers["psnr_file"])
    if method == "nrfgs-sh":  # nothing is lost but splats below 1/255, and float32's rounding at 16 dB
        assert abs(numbers["loss_db"]) < 0.01
    else:  # the file is nearer to the model than a tenth of the residual, which is worth the gap to the base colours
        assert abs(numbers["loss_db"]) < abs(numbers["psnr_model"] - numbers["psnr_base"])
    assert numbers["exact"] == (method == "nrfgs-sh")


def test_training_views_are_called_so(trained, tmp_path, monkeypatch, printed):
    pipeline = load_model(trained["nrfgs-sh"], "test")
    pipeline.datamanager.eval_dataset = pipeline.datamanager.train_dataset  # of a capture without test images
    monkeypatch.setattr(ply, "load_model", lambda *_: pipeline)
    Ply(trained["nrfgs-sh"], output=tmp_path / "s.ply", report=tmp_path / "report.json").main()
    assert json.loads((tmp_path / "report.json").read_text())["views"] == "training"
    assert "PSNR on 8 training views: " in printed()
    pipeline.get_average_eval_image_metrics(get_std=True)
    assert "Means over 8 training views" in printed()


def test_every_world_holds_the_same_scene(trained, tmp_path):
    """Turned, scaled and with harmonics that turn along, it looks the same from cameras that do."""
    reports, means = {}, {}
    for world in ("training", "viewers", "capture"):
        out, report = tmp_path / f"{world}.ply", tmp_path / f"{world}.json"
        words = ["ply", "--load-config", str(trained["nrfgs"]), "--output", str(out), "--report", str(report)]
        tyro.cli(Export, args=[*words, "--world", world]).main()
        reports[world], means[world] = json.loads(report.read_text()), read_splats(out).means
        # The same pictures but for float32's rounding, at 16 dB.
        assert reports[world]["psnr_file"] == pytest.approx(reports["training"]["psnr_file"], abs=1e-3)
    x, y, z = means["training"].unbind(-1)
    assert_close(means["viewers"], torch.stack([x, -z, y], dim=-1), rtol=0, atol=1e-6)  # z up becomes y down
    outputs = load_model(trained["nrfgs"], "inference").datamanager.train_dataparser_outputs
    transform = outputs.dataparser_transform.double()
    in_capture = (means["training"].double() / outputs.dataparser_scale - transform[:, 3]) @ transform[:, :3]
    assert_close(means["capture"], in_capture.float())
    assert reports["viewers"]["world"] == "viewers" and "origin" not in reports["capture"]


def test_an_antialiased_model_is_marked_as_such(trained, tmp_path, monkeypatch):
    pipeline = load_model(trained["nrfgs"], "inference")
    monkeypatch.setattr(ply, "load_model", lambda *_: pipeline)
    for mode, comments in (("antialiased", ["SplatRenderMode: mip"]), ("classic", [])):
        pipeline.model.config.rasterize_mode = mode
        Ply(trained["nrfgs"], output=tmp_path / "s.ply", measure=False).main()
        assert PlyData.read(str(tmp_path / "s.ply")).comments == comments


def test_harmonics_are_fitted_in_the_size_of_the_training(tiny_scene, tmp_path, monkeypatch):
    half = untrained(tiny_scene, tmp_path, "nrfgs", "nrfgs-data", "--downscale-factor", 2, mode="inference")
    assert int(half.cameras_to_fit.width[0]) == 24 and int(half.datamanager.train_dataset.cameras.width[0]) == 48
    assert harmonics_fit.LONGEST_SIDE == MAX_AUTO_RESOLUTION, "by itself a training halves as a fit does"
    monkeypatch.setattr(harmonics_fit, "LONGEST_SIDE", 30)
    by_itself = untrained(tiny_scene, tmp_path, "nrfgs", "nrfgs-data", mode="inference")
    assert int(harmonics_fit.no_larger(by_itself.cameras_to_fit[:1]).width) == 24


@pytest.mark.parametrize("method", METHODS)
def test_ns_export_writes_the_same_splats(method, trained, tmp_path, export_gaussian_splat):
    config, ours = trained[method], tmp_path / "ours.ply"
    Ply(config, output=ours, measure=False, world="training").main()
    export_gaussian_splat(load_config=config, output_dir=tmp_path, output_filename="theirs.ply").main()
    a, b = (PlyData.read(tmp_path / f"{name}.ply")["vertex"].data for name in ("ours", "theirs"))
    assert a.dtype == b.dtype
    assert all((a[name] == b[name]).all() for name in LAYOUT)


def test_an_independent_reader_renders_the_models_picture(trained, tmp_path):
    """plyfile's numbers, gsplat's own harmonics, and the model's picture."""
    from gsplat.cuda._torch_impl import _spherical_harmonics
    from gsplat_call import rasterization

    config = trained["nrfgs-sh"]
    Ply(config, output=tmp_path / "s.ply", measure=False, world="training").main()
    vertices = PlyData.read(tmp_path / "s.ply")["vertex"]
    table = torch.from_numpy(np.stack([vertices[name] for name in LAYOUT], axis=-1))
    means, _, dc, rest, opacities, scales, quats = table.split((3, 3, 3, 45, 1, 3, 4), dim=1)
    coefficients = torch.cat([dc[:, None], rest.reshape(-1, 3, 15).transpose(1, 2)], dim=1)
    assert float(rest.abs().max()) > 1e-4, "the training must have reached the higher degrees"
    pipeline = load_model(config, "test")
    camera = pipeline.datamanager.eval_dataset.cameras[:1]
    view = pinhole(camera, camera.camera_to_worlds, 1)
    colors = (_spherical_harmonics(3, means - view.center, coefficients) + 0.5).clamp_min(0.0)
    shapes = means, quats, scales.exp(), opacities[:, 0].sigmoid(), colors
    render, alphas, _ = rasterization(*shapes, view.viewmat, view.K, view.width, view.height)
    outputs = pipeline.model.get_outputs_for_camera(camera)
    picture = (render[0] + (1 - alphas[0]) * outputs["background"]).clamp(0, 1)
    # Both in float32 through the same compositing; quaternions are normalised once more, in a few ulp.
    assert_close(picture, outputs["rgb"], rtol=0, atol=1e-4)


@pytest.mark.parametrize("mode", ["val", "test"])
def test_trainings_and_viewers_see_the_stored_tables(mode, tiny_scene, tmp_path, monkeypatch):
    """The viewer reads every property of the model several times at its start: nothing may be fitted there."""
    model = short_trainings.untrained(tiny_scene, tmp_path, mode=mode).model
    monkeypatch.setattr("nrfgs_ns.model.exported.fit_harmonics", None)
    assert model.fit is None and model.shs_rest.shape == (model.num_points, 0, 3)
    for name in ("opacities", "quats", "features_dc"):
        assert getattr(model, name) is model.gauss_params[name]
    assert model.shs_0 is model.features_dc
    assert (model.colors == base_colors(model.features_dc)).all()


def test_mistakes_are_told_in_a_sentence(trained, tmp_path):
    with pytest.raises(InputError, match="is a folder"):
        Ply(trained["nrfgs"], output=tmp_path).main()
    (tmp_path / "file").touch()
    for kind in (Ply, Compact, Web):  # before anything is loaded
        for name, report in (("file/s.html", None), ("s.html", tmp_path / "file" / "report.json")):
            with pytest.raises(InputError, match="cannot be written"):
                kind(trained["nrfgs"], output=tmp_path / name, report=report).main()
    for kind, output, report in ((Ply, "s.ply", "a/../s.ply"), (Compact, "s", "s"), (Web, "page", "page/scene.nrf")):
        with pytest.raises(InputError, match="--output .* would replace --report. Give each a name of its own"):
            kind(trained["nrfgs"], output=tmp_path / output, report=tmp_path / report).main()
    with pytest.raises(InputError, match="--output .* would replace the training's file"):
        Ply(trained["nrfgs"], output=trained["nrfgs"]).main()
    with pytest.raises(InputError, match="the 'sh' head.*nrfgs export ply"):
        Web(trained["nrfgs-sh"], output=tmp_path / "page.html").main()
    lost = tmp_path / "config.yml"
    lost.write_text(trained["nrfgs"].read_text().replace("timestamp: ", "timestamp: no-"))
    with pytest.raises(InputError, match="no checkpoints in .*, nor in .*\\. Put them"):
        Ply(lost, output=tmp_path / "s.ply").main()


def test_a_page_holds_the_scene_and_the_photographs(trained, tmp_path):
    report = tmp_path / "report.json"
    Web(trained["nrfgs"], output=tmp_path / "a/tea.html", report=report, author="me").main()
    numbers, text = json.loads(report.read_text()), (tmp_path / "a/tea.html").read_text(encoding="utf-8")
    assert "<h1>tea</h1><p>me</p>" in text
    (tmp_path / "held.nrf").write_bytes(base64.b64decode(re.search('id="packed"[^>]*>([^<]*)<', text).group(1)))
    assert len(decode(tmp_path / "held.nrf").splats["means"]) == numbers["written"] > 0
    assert numbers["bytes"] == (tmp_path / "a/tea.html").stat().st_size > numbers["scene_bytes"]
    assert abs(numbers["loss_db"]) < 0.5 and len(numbers["per_image"]) == 2

    pipeline = load_model(trained["nrfgs"], "test")
    cameras = pipeline.datamanager.train_dataset.cameras
    about = json.loads(re.search('id="about"[^>]*>([^<]*)<', text).group(1))
    names = [path.name for path in pipeline.datamanager.train_dataset.image_filenames]
    assert [one["name"] for one in about["photographs"]] == names and numbers["start"] == names[about["start"]]
    for camera, one in zip(cameras, about["photographs"], strict=True):
        assert_close(torch.tensor(one["pose"]).view(3, 4), camera.camera_to_worlds, rtol=0, atol=1e-6)
        assert_close(one["lens"], [camera.fx.item(), camera.fy.item(), camera.cx.item(), camera.cy.item()])
        assert one["distance"] > 0
    # It begins where the model is best, of the views that were asked: of this few, all.
    scores = []
    for camera, batch in zip(one_by_one(cameras), pipeline.datamanager.cached_train, strict=True):
        picture = pipeline.model.get_outputs_for_camera(camera)["rgb"]
        scores.append(psnr(picture, pipeline.model.get_gt_img(batch["image"])[..., :3]))
    assert scores[about["start"]] == max(scores)


def test_a_page_apart_from_its_scene(trained, tmp_path):
    Web(trained["nrfgs"], output=tmp_path / "served", measure=False).main()
    assert {path.name for path in (tmp_path / "served").iterdir()} == {"index.html", "scene.nrf"}
    decode(tmp_path / "served/scene.nrf")
    (tmp_path / "taken").write_text("")
    (tmp_path / "taken.html").mkdir()
    for name, kind in (("taken", "file"), ("taken.html", "folder")):
        with pytest.raises(InputError, match=f"is a {kind}. Name a file that ends in .html"):
            Web(trained["nrfgs"], output=tmp_path / name).main()
