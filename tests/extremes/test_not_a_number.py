"""A scene with a number that is none is refused by the name of what holds it, before any kernel runs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from extreme_scenes import RED, SHINY, WHITE, ball, lamp, room

from warp_dvct.errors import StageError
from warp_dvct.relighter import Relighter
from warp_dvct.scene import Light, LightKind, Scene


def spoiled(values: Any, value: float = np.nan) -> np.ndarray:
    """A copy with a wrong third number."""
    values = np.array(values, float)
    values.flat[2] = value
    return values


def cases() -> dict[str, Scene]:
    mesh = replace(ball(), path="/Ball")
    camera = room().camera
    normals = np.zeros((len(mesh.triangles), 3, 3))
    texture = np.ones((4, 8, 3), np.float32)
    return {
        "/Ball: points is nan at entry 2": room(replace(mesh, points=spoiled(mesh.points))),
        "/Ball: points is inf at entry 2": room(replace(mesh, points=spoiled(mesh.points, np.inf))),
        "/Ball: corner_normals is nan": room(replace(mesh, corner_normals=spoiled(normals))),
        "/Lamp: radiance is inf": room(lights=(lamp(path="/Lamp", radiance=(1.0, np.inf, 1.0)),)),
        "light 0: position is nan": room(lights=(lamp(position=(0.5, np.nan, 0.5)),)),
        "light 0: texture is nan": room(lights=(Light(LightKind.DOME, (1.0, 1.0, 1.0), texture=spoiled(texture)),)),
        "/Paint: roughness is nan": room(materials=(WHITE, RED, replace(SHINY, roughness=np.nan, name="/Paint"))),
        "the camera: to_world is nan": replace(room(), camera=replace(camera, to_world=spoiled(camera.to_world))),
    }


@pytest.mark.parametrize("message", cases())
def test_what_is_not_finite_is_named(message):
    with pytest.raises(StageError, match=message):
        Relighter(cases()[message], width=16, height=12)


def test_the_scene_itself_is_fine():
    assert Relighter(room(), width=16, height=12).scene.meshes
