"""What a GPU shares out to many threads: a point's rays, a patch's rays and a map's splats, here on one thread."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from warp_dvct import Relighter
from warp_dvct.bench.motion import same
from warp_dvct.launch import Launcher
from warp_dvct.scene import Role, Scene
from warp_dvct.usd.read import read_stage
from warp_dvct.usd_scenes import path

PARTS = 5  # divides neither the rays nor the points of a map


def relighter(scene: Scene, parts: int, method: str = "delta-cones", **settings: object) -> Relighter:
    """At a tiny size, on one thread: atomic functions are not atomic on several."""
    made = Relighter(scene, method=method, quality="draft", width=64, threads=1, settings=settings)
    made._launcher.parts = lambda count: parts
    return made


def moved(scene: Scene, way: tuple[float, float, float]) -> Scene:
    meshes = [replace(m, points=m.points + np.array(way)) if m.role == Role.SYNTHETIC else m for m in scene.meshes]
    return replace(scene, meshes=tuple(meshes))


@pytest.mark.parametrize("stage", ["room_area", "room_glossy"])
def test_rays_in_parts_give_the_same_light(stage):
    """To rounding: sums are taken in another order."""
    scene = read_stage(path(stage))
    whole, parted = (relighter(scene, parts).render() for parts in (1, PARTS))
    for name in ("delta", "comp"):
        expected, got = (getattr(layers, name) for layers in (whole, parted))
        assert np.abs(expected).max() > 0.05
        # Layers are half floats; a rounding more or less is one step of theirs.
        np.testing.assert_allclose(got, expected, rtol=2e-3, atol=2e-4)
    assert not same(whole, parted), "nothing was summed in parts"


def test_rays_kept_in_parts_are_those_of_a_frame_from_scratch():
    scene = read_stage(path("room_area"))
    plate = np.full((36, 64, 3), 0.5, np.float32)
    shot = relighter(scene, PARTS)
    shot.render(plate)
    for way in ((0.02, 0.0, 0.0), (0.04, 0.0, 0.01)):
        shot.set_scene(moved(scene, way))
        assert same(shot.render(plate), relighter(moved(scene, way), PARTS).render(plate))
        assert shot.stats["kept"]["gathered real hits"]


def test_shadow_maps_drawn_in_parts_are_the_same_maps():
    """Bit for bit: the nearest splat of a texel does not depend on the order."""
    scene = read_stage(path("room_spot"))
    knobs = {"vpls.count": 32, "ism.size": 32, "ism.points": 64, "ism.blocks": 2}
    whole, parted = (relighter(scene, parts, "instant-radiosity", **knobs).render() for parts in (1, PARTS))
    assert np.abs(whole.delta).max() > 0.05
    assert same(whole, parted)


@pytest.mark.cpu
def test_many_points_are_enough_for_a_gpu():
    """What parts write of all points stays within 2^20 entries; the CPU has one part."""
    gpu = SimpleNamespace(device=SimpleNamespace(is_cuda=True))
    counts = (0, 1, 3600, 2**15, 2**18, 2**20, 2**22)
    assert [Launcher.parts(gpu, count) for count in counts] == [32, 32, 32, 32, 4, 1, 1]
    assert Launcher("cpu").parts(1) == 1
