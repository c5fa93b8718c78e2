"""Scenes that come as plain data: is every number in them finite? (Those read from a stage were checked by prim.)"""

from __future__ import annotations

from typing import Any

import numpy as np

from warp_dvct.errors import StageError
from warp_dvct.scene import Scene

LIGHT_NUMBERS = ("radiance", "position", "axis_x", "axis_y", "direction", "radius", "angle", "cone_angle", "texture")


def check_scene(scene: Scene) -> None:
    """Refuse numbers that no picture can be made of, before they spread.

    Raises:
        StageError: A point, normal, light, material, texture or camera holds NaN or infinity; the message names it.
    """
    for number, mesh in enumerate(scene.meshes):
        name = mesh.path or f"mesh {number}"
        for what in ("points", "corner_normals", "corner_uvs", "corner_colors"):
            _check(name, what, getattr(mesh, what))
    for number, light in enumerate(scene.lights):
        name = light.path or f"light {number}"
        for what in LIGHT_NUMBERS:
            _check(name, what, getattr(light, what))
    for number, material in enumerate(scene.materials):
        name = material.name or f"material {number}"
        for what in ("base_color", "metallic", "roughness", "ior", "specular_color"):
            _check(name, what, getattr(material, what))
    for number, texture in enumerate(scene.textures):
        _check(texture.name or f"texture {number}", "pixels", texture.pixels)
    _check(scene.camera.path or "the camera", "to_world", scene.camera.to_world)


def _check(name: str, what: str, values: Any) -> None:
    if values is None:
        return
    flat = np.asarray(values).reshape(-1)
    good = np.isfinite(flat)
    if not good.all():
        at = int(np.argmin(good))
        place = f" at entry {at}" if flat.size > 4 else ""
        raise StageError(f"{name}: {what} is {flat[at]}{place}; every number of a scene has to be finite")
