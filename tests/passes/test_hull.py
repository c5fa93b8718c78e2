"""Protects the rays that are not traced because they leave an object's convex hull: none of them would have hit."""

from dataclasses import replace

import lit_scenes as lit
import numpy as np
import pytest

from warp_dvct.bench.motion import same
from warp_dvct.device_scene import DeviceScene
from warp_dvct.passes import hull
from warp_dvct.relighter import Relighter
from warp_dvct.scene import Role

SETTINGS = {
    "volume.resolution": 32,
    "volume.coarse": 16,
    "gather.rays": 16,
    "gather.object_rays": 32,
    "patches.rays": 16,
    "shadows.samples": 8,
    "shadows.probes": 8,
}


EYES = [(0.5, 0.5, 0.15), (0.6, 0.45, 0.85)]  # the first is that of the scene's camera


def on_hull(triangles: np.ndarray, eye=None) -> np.ndarray:
    """By brute force: whether all corners of an object are on one side of each triangle's plane, and the eye is not."""
    normal = lit.cross_of(triangles)
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    height = np.einsum("ij,ikj->ik", normal, triangles.reshape(-1, 3)[None] - triangles[:, :1])
    above, below = height.min(1) > -1e-7, height.max(1) < 1e-7
    if eye is None:
        return above | below
    side = np.einsum("ij,ij->i", normal, eye - triangles[:, 0])
    return (below & (side > 0.0)) | (above & (side < 0.0))


def cup(center) -> np.ndarray:
    """A ball whose upper half is folded into the lower one."""
    triangles = lit.ball(center, 0.1, 12)
    up = triangles[..., 2] - center[2]
    triangles[..., 2] = center[2] + np.where(up > 0.0, -0.4 * up, up)
    return triangles


def scene(*objects):
    parts = [lit.mesh(lit.room(0.45)), *(lit.mesh(x, Role.SYNTHETIC) for x in objects)]
    return lit.scene_of(*parts, lights=(lit.LAMP,))


@pytest.mark.parametrize(
    "triangles",
    [lit.ball((0.5, 0.4, 0.5), 0.1, 20), lit.cuboid((0.4, 0.2, 0.6), (0.1, 0.05, 0.08), 30.0), cup((0.5, 0.4, 0.5))],
    ids=["ball", "turned box", "cup"],
)
def test_marks_are_those_of_brute_force(launcher, triangles):
    other = lit.cuboid((0.7, 0.15, 0.3), 0.05)
    uploaded = DeviceScene.upload(launcher, scene(other, triangles), np.zeros(3), 1.0)
    for eye in EYES:
        seen = uploaded.seen_by(launcher, lit.look_at(eye, lit.CENTER))
        marks = seen.geometry.hull.numpy()
        np.testing.assert_array_equal(marks[:12], np.where(on_hull(other, eye), 0, -1))
        np.testing.assert_array_equal(marks[12:], np.where(on_hull(triangles, eye), 1, -1))


def test_a_cup_is_partly_on_its_hull():
    share = on_hull(cup((0.5, 0.4, 0.5))).mean()
    assert 0.4 < share < 0.6


@pytest.mark.parametrize("many", [False, True], ids=["three bodies", "all as one"])
@pytest.mark.parametrize("quality", ["draft", "balanced"])
def test_the_picture_is_the_same_without_marks(monkeypatch, quality, many):
    """Objects side by side, one in a cup; each in the other's light."""
    monkeypatch.setattr(hull, "MOST_BODIES", 2 if many else 3)
    objects = cup((0.5, 0.3, 0.5)), lit.ball((0.5, 0.32, 0.47), 0.03, 10), lit.cuboid((0.62, 0.3, 0.55), 0.05, 20.0)
    moment = scene(*objects)
    options = {"quality": quality, "settings": SETTINGS, "width": 96, "height": 72, "threads": 2}
    marked = Relighter(moment, **options)
    frame = marked.render()
    marks = marked._uploaded[1].geometry.hull.numpy()
    assert (marks >= 0).mean() > (0.02 if many else 0.2)
    assert set(marks) == ({-1, 0} if many else {-1, 0, 1, 2})
    monkeypatch.setattr(hull, "MOST_TRIANGLES", 0)
    unmarked = Relighter(moment, **options)
    assert same(frame, unmarked.render())
    assert (unmarked._uploaded[1].geometry.hull.numpy() == -1).all()


def test_from_inside_of_an_object_its_walls_are_met(monkeypatch):
    """The camera is in a synthetic room with a lamp; its triangles are on its hull, but seen from the other side."""
    lamp = replace(lit.LAMP, position=(0.5, 0.85, 0.5))
    inside = lit.scene_of(lit.mesh(lit.room(0.4), Role.SYNTHETIC), lit.mesh(lit.room(0.8)), lights=(lamp,))
    options = {"settings": SETTINGS, "width": 48, "height": 36, "threads": 2}
    frame = Relighter(inside, **options).render()
    assert frame.comp.mean() > 0.0
    monkeypatch.setattr(hull, "MOST_TRIANGLES", 0)
    assert same(frame, Relighter(inside, **options).render())


def test_a_camera_that_moves_on_alone_is_marked_for(monkeypatch):
    """The uploaded scene is kept, its marks are not; the picture is that of a new start."""
    still = scene(lit.ball((0.5, 0.4, 0.5), 0.1, 20))
    turned = replace(still, camera=lit.look_at(EYES[1], lit.CENTER))
    options = {"settings": SETTINGS, "width": 64, "height": 48, "threads": 2}
    moving = Relighter(still, **options)
    moving.render()
    before = moving._uploaded[1].geometry.hull.numpy().copy()
    moving.set_scene(turned)
    frame = moving.render()
    after = moving._uploaded[1].geometry.hull.numpy()
    assert ((before >= 0) != (after >= 0)).mean() > 0.3
    assert same(frame, Relighter(turned, **options).render())
