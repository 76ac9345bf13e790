# SPDX-License-Identifier: Apache-2.0
"""Procedural ray-traced scenes whose reflectance is known exactly, with one dial for gloss.

A textured diffuse floor, glossy and mirror-like spheres and a box, three coloured lamps and a luminous sky dome. At
gloss 0 every surface point has one colour from everywhere; view dependence grows with the dial. The scene can be
written as a nerfstudio data set, or asked for its colour along any ray:

    from nrfgs_lab.scenes import SceneConfig, build_scene, write_scene

    write_scene(SceneConfig(gloss=0.5), Path("data/spheres"))
    scene = build_scene(SceneConfig(gloss=0.5))
    colours = scene.radiance(origins, directions)  # [N, 3] linear RGB

`shading.py` has the equations, `scene.py` the layout. Only numpy is needed, and Pillow and plyfile for writing.
"""

from .cameras import camera_rays, dome_cameras, render
from .config import SceneConfig
from .dataset import write_scene
from .scene import build_scene

__all__ = ["SceneConfig", "build_scene", "camera_rays", "dome_cameras", "render", "write_scene"]
