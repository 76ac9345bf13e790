# SPDX-License-Identifier: Apache-2.0
"""The viewer without a GPU or a browser: what each mode shows, and that a browser's wishes reach no training."""

import threading
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace

import imageio.v3
import numpy as np
import pytest
import torch
from exposures import exposed
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.utils import colormaps
from nerfstudio.viewer.render_state_machine import RenderStateMachine
from nerfstudio.viewer.utils import CameraState
from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO, Viewer
from PIL import Image
from short_trainings import assert_same_training, checkpoint_of, command_line, set_up, untrained
from small_capture import Capture
from torch.testing import assert_close
from viser import _icons, _scene_api

from nrfgs_ns.appearance.head import Field, SplatAppearance
from nrfgs_ns.appearance.nrf import NrfConfig
from nrfgs_ns.appearance.sh import ShConfig
from nrfgs_ns.data.datamanager import NrfgsInputDataset
from nrfgs_ns.image.photograph import BASIS
from nrfgs_ns.rasterizer import View
from nrfgs_ns.viewer import pictures as drawn
from nrfgs_ns.viewer import start
from nrfgs_ns.viewer.pictures import BASE, DEPTH, FULL, VIEW_DEPENDENCE, legends, picture

pytestmark = pytest.mark.usefixtures("no_cuda")

FIELD = ["residual", "low branch", "high branch", "gate weight", "opacity residual"]
"""What the default field shows of itself."""


@pytest.fixture(scope="module")
def build(tiny_scene, tmp_path_factory):
    """Pipeline of a method whose head has learnt something, and with opacities at which a pixel shows few splats."""

    def pipeline(method="nrfgs", *options):
        few = "--pipeline.model.few-views", "off"
        pipeline = untrained(tiny_scene, tmp_path_factory.mktemp("out"), method, *few, *options)
        model = pipeline.model
        for parameter in model.head.parameters():
            torch.nn.init.normal_(parameter, std=0.5)
        for name, parameter in model.gauss_params.items():
            if name in ("latents", "features_rest", "sg_colors"):
                torch.nn.init.normal_(parameter, std=0.3)
        model.gauss_params["opacities"].data.fill_(1.0)
        model.update_to_step(10**6)
        pipeline.eval()
        return pipeline

    return pipeline


def two_cameras(pipeline):
    cameras = pipeline.datamanager.train_dataset.cameras
    return cameras[0:1], cameras[4:5]


@pytest.fixture(scope="module")
def scene(build):
    pipeline = build()
    return pipeline.model, *two_cameras(pipeline)


@pytest.mark.parametrize("config, offered", [
    (NrfConfig(), FIELD),
    (NrfConfig(split_bands=False), ["residual", "opacity residual"]),
    (NrfConfig(num_bands=1), ["residual", "opacity residual"]),
    (NrfConfig(opacity_residual=False), FIELD[:-1]),
    (ShConfig(), ["residual"]),
])  # fmt: skip
def test_a_head_offers_what_it_has(config, offered):
    head = config.setup()
    splats = {"means": torch.zeros(4, 3), "opacities": torch.zeros(4, 1), **head.splat_params(torch.zeros(4, 3))}
    assert list(legends(Field(head, splats))) == [FULL, BASE, *offered, VIEW_DEPENDENCE, DEPTH]


@pytest.mark.parametrize("method", ["nrfgs", "nrfgs-sh", "nrfgs-vdgs", "nrfgs-gsnb", "nrfgs-sg"])
def test_every_mode_is_a_picture_of_its_own(build, method):
    pipeline = build(method)
    model, (camera, _) = pipeline.model, two_cameras(pipeline)
    pictures = {}
    for mode in legends(model.field):
        outputs = picture(model, camera, mode)
        assert outputs.keys() == model.get_outputs(camera).keys()
        rgb = outputs["rgb"]
        assert rgb.shape == (36, 48, 3) and torch.isfinite(rgb).all() and 0 <= rgb.min() and rgb.max() <= 1
        pictures[mode] = rgb
    for one, other in combinations(pictures, 2):
        # Browsers get 8 bits: what differs by less than one level on average looks the same.
        assert (pictures[one] - pictures[other]).abs().mean() > 1 / 255, (one, other)


def test_gain_leads_from_the_base_to_the_trained_image_and_beyond(scene):
    model, camera, _ = scene
    assert torch.equal(picture(model, camera, gain=0.0)["rgb"], model.get_base_color(camera))
    assert torch.equal(picture(model, camera, BASE, gain=2.0)["rgb"], model.get_base_color(camera))
    assert torch.equal(picture(model, camera, gain=1.0)["rgb"], model.get_outputs(camera)["rgb"])
    view = model.project(camera)
    base, trained = model.field.base_of(view), model.field.seen_from(view)
    colors, opacities = 2 * trained.colors - base.colors, 2 * trained.opacities - base.opacities
    by_hand = model.composite(view, SplatAppearance(colors.clamp_min(0), opacities.clamp(0, 1)))[0]["rgb"]
    # The same to rounding: 2^-24 in each of at most 300 splats that a pixel adds up.
    assert_close(picture(model, camera, gain=2.0)["rgb"], by_hand, rtol=0, atol=300 * 2**-24)


@pytest.mark.parametrize("mode", ["residual", "low branch", "high branch", "opacity residual"])
def test_gain_scales_what_it_shows(scene, mode):
    """Without any gain a change is grey, where the splats are as where they are not."""
    model, camera, _ = scene
    # alpha + (1 - alpha), summed over at most 300 splats
    grey = picture(model, camera, mode, gain=0.0)["rgb"]
    assert_close(grey, torch.full_like(grey, 0.5), rtol=0, atol=300 * 2**-24)
    half, whole = (picture(model, camera, mode, gain=gain)["rgb"] - 0.5 for gain in (0.5, 1.0))
    assert half.abs().mean() < whole.abs().mean()


def test_frozen_view_is_the_head_seen_from_elsewhere(scene):
    model, here, there = scene
    center = model.project(there).center
    view = model.project(here)
    frozen = picture(model, here, frozen_center=center)["rgb"]
    assert torch.equal(frozen, model.composite(view, model.field.seen_from(view._replace(center=center)))[0]["rgb"])
    unfrozen = picture(model, here)["rgb"]
    assert (frozen - unfrozen).abs().mean() > 1 / 255
    assert torch.equal(picture(model, here, frozen_center=view.center)["rgb"], unfrozen)
    residuals = [picture(model, here, "residual", frozen_center=o)["rgb"] for o in (None, center)]
    assert (residuals[0] - residuals[1]).abs().mean() > 1 / 255


def test_branches_add_up_to_the_residual_and_the_residual_to_the_head(build):
    model = build().model
    splats = {name: value.detach() for name, value in model.gauss_params.items()}
    splats["features_dc"] = torch.zeros_like(splats["features_dc"])  # mid grey: no colour is clamped
    visible, center = torch.arange(0, 300, 2), torch.tensor([0.3, -1.0, 0.5])
    with torch.no_grad():
        parts = model.head.components(splats, visible, center)
        trained, base = model.head(splats, visible, center), model.head.base_appearance(splats, visible)
    # Sums and differences of a few numbers of at most 1.
    close = {"rtol": 0, "atol": 4 * 2**-24}
    assert_close(parts["low branch"].values + parts["high branch"].values, parts["residual"].values, **close)
    assert_close(parts["residual"].values, trained.colors - base.colors, **close)
    change = (trained.opacities - base.opacities)[:, None]
    assert_close(parts["opacity residual"].values, change, **close)
    assert parts["low branch"].values.abs().max() <= 0.2 and change.abs().max() > 0.05
    gate = parts["gate weight"].values
    assert gate.shape == (150, 1) and 0 <= gate.min() < gate.max() <= 1
    with torch.no_grad():  # a shut gate leaves the low branch
        model.head.high[-1].bias[3], model.head.high[-1].weight[3] = -100.0, 0.0
        shut = model.head.components(splats, visible, center)
    assert torch.equal(shut["residual"].values, parts["low branch"].values)
    assert shut["high branch"].values.abs().max() == 0


def test_view_dependence_is_the_deviation_over_the_sphere():
    """For harmonics of degree 1, k Y_1, the deviation is known: the mean square of each is 1 / (4 pi)."""
    head = ShConfig(degree=1).setup()
    means = torch.randn(5, 3, generator=torch.Generator().manual_seed(0))
    splats = {"means": means, "opacities": torch.zeros(5, 1), **head.splat_params(torch.full((5, 3), 0.5))}
    visible, center = torch.tensor([0, 2, 3]), torch.tensor([4.0, 0.0, 1.0])
    field, view = Field(head, splats), View(SimpleNamespace(gaussian_ids=visible), center)
    assert drawn.view_dependence(field, view).abs().max() == 0
    splats["features_rest"][2, :, 1] = torch.tensor([0.3, -0.2, 0.1])
    # sqrt(k . k / (4 pi)) in one channel; a third of its square over three channels.
    expected = torch.tensor([0.0, (0.14 / (12 * torch.pi)) ** 0.5, 0.0])[:, None]
    # 12 colours near 1/2 are rounded at 2^-25 each.
    assert_close(drawn.view_dependence(field, view), expected, rtol=0, atol=12 * 2**-25)


def test_depth_is_dark_near_and_bright_far():
    depth = torch.tensor([[1.0, 2.0, 3.0, 50.0]])[..., None]
    opaque = torch.tensor([[1.0, 1.0, 1.0, 0.1]])[..., None]
    # The quantile of three is the second; what is hardly there does not count.
    assert drawn.scaled_depth(depth, opaque).flatten().tolist() == [0.0, 1.0, 1.0, 1.0]
    assert drawn.scaled_depth(depth, 0 * opaque).abs().max() == 0


class Browser(RenderStateMachine):
    """One of the viewer's render threads, which renders one image as it would for a browser, and ends."""

    def __init__(self, viewer, pose):
        super().__init__(viewer, VISER_NERFSTUDIO_SCALE_RATIO, client=None)
        self.camera = CameraState(fov=0.9, aspect=4 / 3, c2w=pose, camera_type=CameraType.PERSPECTIVE)
        self.state = "low_move"

    def run(self):
        self.outputs = self._render_img(self.camera)

    @classmethod
    def sees(cls, viewer, pose) -> dict[str, torch.Tensor]:
        thread = cls(viewer, pose)
        thread.start()
        thread.join(timeout=300)
        return thread.outputs


@pytest.mark.parametrize("method", ["nrfgs", "nrfgs-deferred"])
def test_every_output_can_be_shown(method, build, open_viewer):
    viewer = open_viewer(build(method))
    model, pose = viewer.pipeline.model, two_cameras(viewer.pipeline)[0].camera_to_worlds[0]
    model.train()
    for mode in model.viewer_panel.legends:
        model.viewer_panel.mode.value = mode
        outputs = Browser.sees(viewer, pose)
        assert model.training, "rendering for the viewer must leave a training in training mode"
        assert {"rgb", "depth", "accumulation"} <= set(outputs)
        for name, image in outputs.items():
            shown = colormaps.apply_colormap(image=image, colormap_options=viewer.control_panel.colormap_options)
            assert shown.shape[-1] == 3 and torch.isfinite(shown).all(), name


def coarse(rgb: torch.Tensor) -> torch.Tensor:
    """Means over an 8 x 8 grid: nerfstudio picks the size of a picture by how fast the last ones were."""
    return torch.nn.functional.adaptive_avg_pool2d(rgb.permute(2, 0, 1), 8)


def test_the_panel_rules_the_browser_and_nothing_else(build, open_viewer):
    pipeline = build()
    model, (camera, elsewhere) = pipeline.model, two_cameras(pipeline)
    batch = pipeline.datamanager.fixed_indices_eval_dataloader[0][1]
    before = model.get_outputs_for_camera(camera)
    before_metrics = model.get_image_metrics_and_images(before, batch)[0]

    viewer, panel, pose = open_viewer(pipeline), model.viewer_panel, camera.camera_to_worlds[0]
    plain = coarse(Browser.sees(viewer, pose)["rgb"])
    panel.count.value = "?"
    viewer.update_scene(0)
    assert panel.count.value == "300"
    panel.mode.value, panel.gain.value = "residual", 1.5
    panel.frozen_center, panel.freeze.value = model.project(elsewhere).center, True
    viewer.control_panel.background_color = (255, 0, 0)
    viewer.control_panel.crop_viewport = True
    assert panel.options["mode"] == "residual" and panel.options["gain"] == 1.5
    assert (coarse(Browser.sees(viewer, pose)["rgb"]) - plain).abs().mean() > 0.05
    assert model.crop_box is None
    # The viewer's crop box is one unit wide, and the scene is larger: there is less to see.
    cropped = Browser.sees(viewer, pose)["accumulation"].mean()
    viewer.control_panel.crop_viewport = False
    assert 0 < cropped < Browser.sees(viewer, pose)["accumulation"].mean()
    panel.mode.value = FULL  # transparent pixels show the viewer's background now
    assert Browser.sees(viewer, pose)["background"][0, 0].tolist() == [1.0, 0.0, 0.0]

    after = model.get_outputs_for_camera(camera)
    assert all(torch.equal(after[name], before[name]) for name in before)
    assert model.get_image_metrics_and_images(after, batch)[0] == before_metrics


@pytest.mark.parametrize("is_slow", [True, False])
def test_only_slow_pictures_are_interrupted(is_slow, build, open_viewer, monkeypatch):
    viewer = open_viewer(build())
    panel, pose = viewer.pipeline.model.viewer_panel, two_cameras(viewer.pipeline)[0].camera_to_worlds[0]
    monkeypatch.setattr(type(panel), "is_slow", is_slow)
    interruptible = set()

    class Watched(Browser):
        def check_interrupt(self, frame, event, arg):
            interruptible.add(Path(frame.f_code.co_filename).name)
            return self.check_interrupt

    assert Watched.sees(viewer, pose)["rgb"].std() > 0.01
    assert "panel.py" in interruptible and ("pictures.py" in interruptible) == is_slow


def test_a_photographs_look(build, open_viewer):
    pipeline = build("nrfgs", "--pipeline.model.photographs", "on")
    model, (camera, _) = pipeline.model, two_cameras(pipeline)
    with torch.no_grad():
        model.photograph.shots[3] = torch.tensor([-1.0, 0.5, 0.0])
    plain = picture(model, camera)["rgb"]
    assert torch.equal(plain, model.get_outputs_for_camera(camera)["rgb"])  # the mean look
    third = picture(model, camera, photograph=3)["rgb"]
    assert_close(third, exposed(plain, model.photograph.shots[3] @ torch.tensor(BASIS)))
    assert third.mean() < plain.mean() - 0.02

    viewer, panel, pose = open_viewer(pipeline), model.viewer_panel, camera.camera_to_worlds[0]
    seen = coarse(Browser.sees(viewer, pose)["rgb"])
    panel.look.value = model.photograph.names[3]
    assert panel.options["photograph"] == 3
    assert coarse(Browser.sees(viewer, pose)["rgb"]).mean() < seen.mean() - 0.01
    assert torch.equal(model.get_outputs_for_camera(camera)["rgb"], plain)


STEPS = 18
"""Two refinements and a change of resolution."""


def watched_training(scene, out, each_step) -> dict:
    """Train for STEPS and call each_step(trainer) after each; the last checkpoint."""
    rules = "warmup_length=2,refine_every=4,reset_alpha_every=100,densify_grad_thresh=1e-6"
    options = {
        "--pipeline.model.densification": f"splatfacto,{rules}",
        "--pipeline.model.resolution-schedule": 9,
        "--pipeline.model.num-downscales": 1,
        "--pipeline.model.few-views": "off",
        # Nerfstudio draws the images to evaluate with the generator that orders the training's.
        "--steps-per-eval-image": 4,
        "--steps-per-eval-all-images": 8,
    }
    trainer = set_up(command_line("nrfgs", scene, out, STEPS, options))
    trainer._update_viewer_state = lambda step: each_step(trainer)
    trainer.train()
    return checkpoint_of(trainer.base_dir / "config.yml")


def test_a_training_does_not_notice_who_watches(tiny_scene, tmp_path, open_viewer):
    """To the bit: the same training with a browser that looks at something else after every second step."""
    wishes = [(mode, g, f) for g, f in ((0.0, True), (2.0, False)) for mode in [FULL, *FIELD, VIEW_DEPENDENCE]]
    viewers, seen = [], []

    def watch(trainer):
        model = trainer.pipeline.model
        if trainer.step % 2:
            return
        if not viewers:
            viewers.append(open_viewer(trainer.pipeline))
        panel, cameras = model.viewer_panel, trainer.pipeline.datamanager.train_dataset.cameras
        panel.mode.value, panel.gain.value, panel.freeze.value = wishes[len(seen) % len(wishes)]
        panel.frozen_center = cameras.camera_to_worlds[3, :3, 3]
        viewers[0].control_panel.background_color = (255, 0, 0)
        seen.append(Browser.sees(viewers[0], cameras.camera_to_worlds[len(seen) % 8])["rgb"].mean().item())

    watched = watched_training(tiny_scene, tmp_path / "watched", watch)
    quiet = watched_training(tiny_scene, tmp_path / "quiet", lambda trainer: None)
    assert len(seen) == STEPS // 2 and len(set(seen)) > 1
    assert len(quiet["pipeline"]["_model.gauss_params.means"]) != 300, "nothing was densified: it would prove less"
    assert_same_training(quiet, watched, rtol=0, atol=0)


# The viewer opens without reading anything twice, and shows what it showed.
def test_a_training_s_photographs_are_not_read_again(pipeline, tiny_scene, tmp_path, monkeypatch):
    dataset, reads, shown = pipeline.datamanager.train_dataset, [], []
    get_data, threads = NrfgsInputDataset.get_data, torch.get_num_threads()
    monkeypatch.setattr(NrfgsInputDataset, "get_data", lambda *args, **more: reads.append(1) or get_data(*args, **more))
    log, lock = tmp_path / "log", threading.Lock()
    monkeypatch.setattr(Image, "init", lambda: pytest.fail("imports all of Pillow's formats"))
    viewer = Viewer(ViewerConfig(), log, datapath=tiny_scene, pipeline=pipeline, train_lock=lock)
    scene = viewer.viser_server.scene
    add = scene.add_camera_frustum
    monkeypatch.setattr(scene, "add_camera_frustum", lambda **what: shown.append(what["image"]) or add(**what))
    try:
        viewer.init_scene(dataset, "training")
        assert len(shown) == len(dataset) and reads == []
        assert torch.get_num_threads() == threads
        Viewer.init_scene.__wrapped__(viewer, dataset, "training")
        assert reads != []
        ours, theirs = (np.stack(some).astype(int) for some in (shown[: len(dataset)], shown[len(dataset) :]))
        assert np.abs(ours - theirs).max() <= 1, "but for the rounding of a byte"
    finally:
        viewer.viser_server.stop()


def test_icons_and_pictures_are_visers(pipeline, monkeypatch):
    assert all(start.icon(name) == _icons.svg_from_icon(name) for name in ("123", "camera", "zzz"))
    picture = np.random.default_rng(0).integers(0, 256, (24, 30, 3), np.uint8)
    ours = [_scene_api._encode_image_binary(picture, kind) for kind in ("jpeg", "png")]
    monkeypatch.setattr(_scene_api, "iio", imageio.v3)
    assert ours == [_scene_api._encode_image_binary(picture, kind) for kind in ("jpeg", "png")]


def test_large_photographs_come_small(tmp_path, monkeypatch):
    monkeypatch.setattr(Capture, "width", 640)
    monkeypatch.setattr(Capture, "height", 400)
    capture = Capture(tmp_path / "large", images=3)
    capture.meta |= {"fl_x": 500.0, "fl_y": 500.0, "cx": 320.0, "cy": 200.0}
    for index, path in enumerate((capture.folder / "images").iterdir()):
        Image.radial_gradient("L").resize((640, 400)).convert("RGB").rotate(90 * index).save(path)
    dataset = NrfgsInputDataset(capture.parse())
    read = [dataset.get_data(index, image_type="uint8") for index in range(len(dataset))]
    for images in (read, None):  # in memory, or in files
        small = start.SmallPhotographs(dataset, images)
        assert len(small) == len(dataset) and small.cameras is dataset.cameras
        image = small[0]["image"]
        assert min(image.shape[:2]) in range(start.SIDE, 2 * start.SIDE) and image.shape[2] == 3
        whole = dataset.get_data(0)["image"].permute(2, 0, 1)[None]
        expected = torch.nn.functional.interpolate(whole, tuple(image.shape[:2]), mode="area")[0].permute(1, 2, 0)
        assert (image - expected).abs().mean() < 0.03


@pytest.mark.parametrize("mode", ["L", "RGBA", "P", "CMYK"])
def test_a_photograph_of_any_mode_is_shown_in_colour(tmp_path, mode):
    path = tmp_path / ("a.jpg" if mode == "CMYK" else "a.png")
    Image.fromarray(np.full((30, 40, 3), 153, np.uint8)).convert(mode).save(path)
    image = start.SmallPhotographs(SimpleNamespace(cameras=None, image_filenames=[path]), None)[0]["image"]
    assert image.shape == (30, 40, 3) and (image - 153 / 255).abs().max() < 0.02
