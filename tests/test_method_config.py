# SPDX-License-Identifier: Apache-2.0
"""The menu: registered, light to import, and splatfacto's to the number."""

import re
import runpy
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import tyro
from nerfstudio.configs import external_methods
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion, all_methods, method_configs
from nerfstudio.models.splatfacto import SplatfactoModelConfig
from nerfstudio.plugins.registry import discover_methods

from nrfgs_ns import method_config as menu
from nrfgs_ns.densification import Splatfacto
from nrfgs_ns.training.identity import leaves

METHODS = {
    "nrfgs": (menu.nrfgs, {"latents", "field"}),
    "nrfgs-sh": (menu.nrfgs_sh, set()),
    "nrfgs-vdgs": (menu.nrfgs_vdgs, {"field"}),
    "nrfgs-gsnb": (menu.nrfgs_gsnb, {"field"}),
    "nrfgs-sg": (menu.nrfgs_sg, {"sg_axes", "sg_sharpness", "sg_colors"}),
}
"""Of each method: its specification, and the groups of parameters that its head adds."""
PRESETS = {"nrfgs-fast": menu.nrfgs_fast, "nrfgs-best": menu.nrfgs_best, "nrfgs-harmonics": menu.nrfgs_harmonics}


@pytest.mark.parametrize("name", [*METHODS, *PRESETS])
def test_nerfstudio_finds_the_method(name):
    assert all_methods[name].method_name == name
    assert all_methods[name].machine.device_type == ("cuda" if torch.cuda.is_available() else "cpu")
    assert tyro.cli(AnnotatedBaseConfigUnion, args=[name, "--data", "x"]).method_name == name


@pytest.mark.parametrize("parser", ["nerfstudio-data", "colmap"])
def test_a_parser_that_is_named_has_splatfactos_defaults(parser):
    """nerfstudio-data by itself leaves the points out; splatfacto's reads them."""
    ours, theirs = (tyro.cli(AnnotatedBaseConfigUnion, args=[name, parser]) for name in ("nrfgs", "splatfacto"))
    assert ours.pipeline.datamanager.dataparser == theirs.pipeline.datamanager.dataparser


@pytest.mark.parametrize("name", METHODS)
def test_everything_else_is_splatfactos(name):
    (method, groups), host = METHODS[name], method_configs["splatfacto"]
    ours = method.config
    model, rules = ours.pipeline.model, ours.pipeline.model.densification
    off = {"use_scale_regularization", "use_bilateral_grid", "output_depth_during_training"}  # and not offered here
    assert not any(getattr(host.pipeline.model, option) for option in off)
    left_out = {"_target", "n_split_samples", "color_corrected_metrics", "sh_degree_interval", *off}
    left_out |= {"max_gauss_ratio", "grid_shape"}
    built = Splatfacto().build(1, 1, 1.0).strategy
    for option, number in {
        "densify_size_thresh": built.grow_scale3d,
        "split_screen_size": built.grow_scale2d,
        "cull_scale_thresh": built.prune_scale3d,
        "cull_screen_size": built.prune_scale2d,
        "stop_screen_size_at": built.refine_scale2d_stop_iter,
        "use_absgrad": built.absgrad,
    }.items():
        assert number == getattr(host.pipeline.model, option)
        left_out.add(option)
    for field in fields(SplatfactoModelConfig):
        if field.name not in left_out and not (name == "nrfgs" and hasattr(Splatfacto, field.name)):
            value = getattr(rules if hasattr(rules, field.name) else model, field.name)
            assert value == getattr(host.pipeline.model, field.name), field.name
    for group, parts in ours.optimizers.items():
        if group not in {*groups, "photograph"}:
            for part in ("optimizer", "scheduler"):
                assert parts[part] == host.optimizers[group][part], (group, part)
    assert set(host.optimizers) - set(ours.optimizers) <= {"features_rest", "bilateral_grid"}
    # nrfgs chooses by the number of views, up to splatfacto's number.
    assert ours.max_num_iterations == (0 if name == "nrfgs" else host.max_num_iterations)
    assert ours.for_views(10_000).max_num_iterations == host.max_num_iterations
    for field in ("mixed_precision", "use_grad_scaler", "gradient_accumulation_steps", "vis"):
        assert getattr(ours, field) == getattr(host, field), field
    datamanager, host_datamanager = ours.pipeline.datamanager, host.pipeline.datamanager
    for field in ("cache_images", "cache_images_type", "camera_res_scale_factor", "train_cameras_sampling_strategy"):
        assert getattr(datamanager, field) == getattr(host_datamanager, field), field


@pytest.mark.parametrize("name, differs", [
    ("nrfgs-fast", {"max_num_iterations": 10_000, "schedule_steps": 30_000, "average_steps": 200,
                    "pipeline.model.twin": "off"}),
    ("nrfgs-best", {"max_num_iterations": 30_000, "average_steps": 200,
                    "pipeline.model.densification": "error-guided,threshold=0.0016"}),
])  # fmt: skip
def test_a_preset_differs_in_what_it_says_and_shares_nothing(name, differs):
    ours, base = dict(leaves(PRESETS[name].config)), dict(leaves(menu.nrfgs.config))
    assert ours.keys() == base.keys()
    assert {key: ours[key] for key in ours if str(ours[key]) != str(base[key])} == {"method_name": name, **differs}
    assert PRESETS[name].config.pipeline.model.appearance is not menu.nrfgs.config.pipeline.model.appearance


def test_harmonics_have_all_rules_that_are_not_the_fields():
    ours, field, plain = (dict(leaves(method.config)) for method in (menu.nrfgs_harmonics, menu.nrfgs, menu.nrfgs_sh))
    names = "densification", "dense_start", "twin", "near_plane", "view_noise", "shrinkage"
    rules = {"max_num_iterations", *(f"pipeline.model.{name}" for name in names)}
    assert {key for key in ours if str(ours[key]) != str(plain[key])} == {"method_name", *rules}
    assert all(str(ours[key]) == str(field[key]) for key in rules)
    assert ours["pipeline.model.few_views"] != field["pipeline.model.few_views"]


def test_nerfstudio_still_knows_who_asks_for_an_external_method(capsys):
    """Listing them asks nothing; naming one on the command line says how to install it."""
    listed, _ = external_methods.get_external_methods()
    assert "in2n" in listed
    assert isinstance(external_methods.inspect, SimpleNamespace), "the slow way is back"
    named = external_methods.ExternalMethod("[bold]how to install it", [("x", "")])
    with pytest.raises(SystemExit):
        external_methods.ExternalMethodDummyTrainerConfig(method_name="x", method=named)
    assert "how to install it" in capsys.readouterr().out


def test_registering_pulls_in_no_gpu_code_and_no_training_tools():
    """An entry point that fails to import, or is slow, spoils every ns command. nerfstudio loads plugins while it
    imports itself; tests/data/test_dataparser.py imports this package first."""
    code = (
        "import sys, nerfstudio.configs.dataparser_configs as parsers, nerfstudio.configs.method_configs;"
        "parsers.all_dataparsers['nrfgs-data'], nerfstudio.configs.method_configs.all_methods['nrfgs'];"
        "heavy = 'gsplat.cuda._backend', 'open3d', 'sklearn', 'torch._inductor.compile_fx';"
        "lab = (name for name in sys.modules if name.startswith('nrfgs_lab.'));"
        "lab = [name for name in lab if not name.startswith('nrfgs_lab.heads')];"
        "print([name for name in heavy if name in sys.modules] + lab)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=300)
    assert run.stdout.strip().endswith("[]")
    assert "leaked" not in run.stderr


# The entry for nerfstudio's list of external methods, in the installed nerfstudio's own loader.
LISTING = Path(__file__).resolve().parents[1] / "docs" / "nerfstudio"


def test_the_listing_is_of_registered_methods_and_its_page_is_where_it_says(monkeypatch):
    monkeypatch.setattr(external_methods, "external_methods", [])
    runpy.run_path(str(LISTING / "external_method.py"))
    (entry,) = external_methods.external_methods
    listed, descriptions = external_methods.get_external_methods()
    assert "nrfgs" in listed and listed.keys() <= discover_methods()[0].keys()
    assert all(f"ns-train {name}" in descriptions[name] for name in listed)
    (name,) = re.findall(r"https://docs.nerf.studio/nerfology/methods/(\w+).html", entry.instructions)
    page = (LISTING / f"{name}.md").read_text(encoding="utf-8")
    assert f"pip install {entry.pip_package}\n" in page
    assert all(f"`{method}`" in page or f"ns-train {method} " in page for method in listed)
    assert not re.findall(r"\]\((?!https://)", page), "links and pictures of another site"
