"""Shading points of the camera's rays: where objects are looked for, and that they are found there."""

from __future__ import annotations

import lit_scenes as lit
import numpy as np
import pytest

from warp_dvct.passes import gbuffer
from warp_dvct.scene import Role

BOX = lit.cuboid((0.5, 0.5, 0.5), 0.1, 30.0)
EYES = {
    "in front": ((0.6, 0.7, 1.5), (0.5, 0.5, 0.5), 0.4),
    "at the border": ((0.5, 0.6, 1.2), (0.72, 0.5, 0.5), 0.3),
    "out of view": ((0.5, 0.6, 1.2), (1.4, 0.5, 0.3), 0.3),
    "behind the camera": ((0.5, 0.6, 1.2), (0.5, 0.6, 2.0), 0.4),
    "beside the camera": ((0.62, 0.52, 0.5), (0.62, 0.45, 0.1), 1.2),
    "around the camera": ((0.5, 0.5, 0.5), (0.5, 0.45, 0.1), 0.5),
}


@pytest.mark.parametrize("where", EYES)
def test_objects_are_found_where_they_are_looked_for(launcher, monkeypatch, where):
    """The window of the picture that an object may reach holds all of it, from anywhere; and is no larger than the
    box that it comes from needs."""
    eye, target, half = EYES[where]
    room = lit.mesh(lit.room(2.0))
    scene = lit.scene_of(room, lit.mesh(BOX, Role.SYNTHETIC), camera=lit.look_at(eye, target, half=half))
    uploaded = lit.upload(launcher, scene)
    shape = 67, 53
    first, last, top, bottom = gbuffer.objects_window(uploaded, *shape)

    def roles() -> np.ndarray:
        buffer = gbuffer.render_gbuffer(launcher, uploaded, *shape, edge_samples=0, behind=False)
        return buffer.points.role.numpy()[: shape[0] * shape[1]].reshape(shape[::-1])

    looked = roles()
    monkeypatch.setattr(gbuffer, "objects_window", lambda *_: (0, shape[0] - 1, 0, shape[1] - 1))
    everywhere = roles()
    np.testing.assert_array_equal(looked, everywhere)
    rows, columns = np.nonzero(everywhere == Role.SYNTHETIC)
    assert (len(rows) > 0) == (where in ("in front", "at the border", "beside the camera", "around the camera"))
    if where == "in front":
        assert (last - first) * (bottom - top) < 4 * len(rows)
        assert first >= columns.min() - 12
        assert last <= columns.max() + 12
    if where == "out of view":
        assert last < 0


def test_objects_that_went_are_taken_out(launcher):
    """A shot's next frame shows the real scene where the object was, outside of its new window as well."""
    camera = lit.look_at((0.5, 0.6, 1.4), (0.5, 0.5, 0.5), half=0.4)

    def upload(shift: float):
        box = lit.mesh(BOX + np.array([shift, 0.0, 0.0]), Role.SYNTHETIC)
        return lit.upload(launcher, lit.scene_of(lit.mesh(lit.room(2.0)), box, camera=camera))

    before, after = upload(-0.2), upload(0.2)
    view = gbuffer.new_view(launcher, before, 60, 40, 4)
    for scene in (before, after):
        moved = gbuffer.render_gbuffer(launcher, scene, 60, 40, edge_samples=2, behind=False, view=view)
    fresh = gbuffer.render_gbuffer(launcher, after, 60, 40, edge_samples=2, behind=False)
    assert moved.count == fresh.count
    for name in ("role", "triangle", "slot", "position", "normal"):
        got, expected = (getattr(b.points, name).numpy()[: b.count] for b in (moved, fresh))
        np.testing.assert_array_equal(got, expected, name)
