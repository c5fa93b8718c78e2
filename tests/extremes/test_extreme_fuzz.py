"""Scenes that nobody would make: loose triangles, any light, any material, any setting. No launch may write a wrong
number (``numbers`` checks each), and whatever a scene holds, light has to be finite."""

from __future__ import annotations

import lit_scenes as lit
import numpy as np
import pytest
from extreme_scenes import HEIGHT, METHODS, WIDTH, numbers
from hypothesis import given, settings
from hypothesis import strategies as st

from warp_dvct.scene import Light, LightKind, LightRole, Material, Role, Scene

SHARE = st.one_of(st.sampled_from([0.0, 1.0]), st.floats(0.0, 1.0))


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    """A handful of loose triangles of each role, some double sided, a light or three, a camera among them."""
    rng = np.random.default_rng(draw(st.integers(0, 2**31)))
    size = 10.0 ** draw(st.floats(-3.0, 2.0))
    materials = [
        Material(
            (draw(SHARE), draw(SHARE), draw(SHARE)), draw(SHARE), draw(SHARE), draw(st.sampled_from([1.0, 1.5, 3.0]))
        )
        for _ in range(2)
    ]
    meshes = []
    for role in Role:
        count = draw(st.integers(0 if role == Role.SYNTHETIC else 1, 20))
        corners = rng.uniform(-1, 1, (count, 1, 3)) + rng.normal(
            0, draw(st.sampled_from([1e-3, 0.1, 1.0])), (count, 3, 3)
        )
        meshes.append(lit.mesh(size * corners, role, int(role), double_sided=draw(st.booleans())))
    lights = tuple(light(draw, rng, size) for _ in range(draw(st.integers(1, 3))))
    eye = size * rng.normal(0, 1.5, 3)
    camera = lit.look_at(
        eye, eye + rng.normal(0, 1, 3), half=draw(st.sampled_from([0.01, 0.5, 5.0])), aspect=WIDTH / HEIGHT
    )
    return lit.scene_of(*meshes, lights=lights, materials=materials, camera=camera)


def light(draw: st.DrawFn, rng: np.random.Generator, size: float) -> Light:
    """Any kind, as small or large as may be, white hot or black."""
    kind = draw(st.sampled_from(list(LightKind)))
    strength = draw(st.sampled_from([0.0, 1e-6, 1.0, 1e6]))
    x, y, z = np.linalg.qr(rng.normal(0, 1, (3, 3)))[0]
    half = size * draw(st.sampled_from([1e-4, 0.1, 3.0]))
    texture = rng.uniform(0, 2, (4, 8, 3)).astype(np.float32) if draw(st.booleans()) else None
    return Light(
        kind,
        (strength, strength, 0.5 * strength),
        position=tuple(size * rng.normal(0, 1, 3)),
        axis_x=tuple(half * x),
        axis_y=tuple(half * y),
        direction=tuple(z),
        radius=half,
        angle=draw(st.sampled_from([0.0, 0.01, 1.0])),
        cone_angle=draw(st.sampled_from([1e-3, 0.5, np.pi])),
        cone_softness=draw(SHARE),
        texture=texture if kind == LightKind.DOME else None,
        role=draw(st.sampled_from(list(LightRole))),
    )


KNOBS = st.fixed_dictionaries(
    {
        "volume.resolution": st.sampled_from([1, 7, 32]),
        "volume.coarse": st.sampled_from([0, 1, 16]),
        "bounces": st.sampled_from([0, 1, 4]),
        "gather.stride": st.sampled_from([1, 6]),
        "antialias": st.sampled_from([0, 3]),
        "cones.coverage": st.sampled_from(["additive", "product"]),
        "cones.filter": st.sampled_from(["directional", "isotropic"]),
        "cones.delta": st.sampled_from(["dual", "split"]),
        "shadow_maps": st.sampled_from(["double", "single"]),
        "vpls.clamp": st.sampled_from([0.0, 0.5]),
        "samples": st.just(2),
    }
)


@pytest.mark.parametrize("method", METHODS)
@settings(max_examples=12, deadline=None, database=None, derandomize=True)
@given(scene=scenes(), knobs=KNOBS)
def test_any_scene_gives_finite_numbers(method, scene, knobs):
    seen = numbers(scene, method, width=16, height=12, **knobs)
    for name in ("comp", "rgba", "plate", "shadow", "added", "delta", "albedo", "normal", "position"):
        assert np.isfinite(getattr(seen.layers, name)).all(), name
    assert not np.isnan(seen.layers.depth).any()
