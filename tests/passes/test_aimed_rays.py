"""Rays aimed at the synthetic objects: they change the noise of what objects change, not its mean."""

from __future__ import annotations

from dataclasses import replace

import lit_scenes as lit
import numpy as np
import pytest
import warp as wp

from warp_dvct import usd_scenes
from warp_dvct.kernels import aim
from warp_dvct.kernels.materials import Surface
from warp_dvct.relighter import Relighter
from warp_dvct.scene import Role
from warp_dvct.targets import make_targets, targets_of, two_boxes
from warp_dvct.usd.read import read_stage

POINTWISE = {"gather.stride": 1, "gather.smoothing": 0, "gather.detail": 0, "bounces": 1, "antialias": 0}


@pytest.fixture(scope="module")
def stage():
    return read_stage(usd_scenes.path("room_spot"))


def change(stage, rays, aimed, seed=0):
    """The change on real surfaces where nothing but indirect light changes, and everything a pixel across."""
    settings = {**POINTWISE, "gather.rays": rays, "gather.aimed": aimed, "seed": seed, "gather.object_rays": 1}
    picture = Relighter(stage, width=48, height=27, settings=settings).render(np.full((27, 48, 3), 0.5, np.float32))
    return picture.delta * (picture.mask_synthetic == 0.0)[..., None]


def tiles_of(picture):
    """Means over 8 x 9 pixels."""
    return picture.reshape(3, 9, 6, 8, 3).mean((1, 3))


def test_the_mean_stays_and_half_the_rays_have_less_noise(stage):
    """Against 2048 rays all over the hemisphere: aimed rays come to the same, in every tile of the picture; 8 and 8 of
    them are closer to it than 32 that are not aimed."""
    truth = change(stage, 2048, 0.0)
    size = np.abs(truth).mean()
    many = change(stage, 2048, 0.25)
    assert np.abs(tiles_of(many - truth)).max() < 0.03 * size
    assert np.abs(many - truth).mean() < 0.05 * size
    plain, aimed = (
        np.mean([np.abs(change(stage, 32, share, seed) - truth) for seed in range(3)]) for share in (0.0, 0.25)
    )
    assert aimed < 0.9 * plain


@wp.kernel
def _sector(
    first: int,
    targets: aim.Targets,
    position: wp.array(dtype=wp.vec3),
    normal: wp.array(dtype=wp.vec3),
    xi: wp.array(dtype=wp.vec2),
    rays_out: wp.array(dtype=wp.int32),
    share_out: wp.array(dtype=wp.float32),
    disk_out: wp.array(dtype=wp.vec2),
    inside_out: wp.array(dtype=wp.int32),
):
    i = first + wp.tid()
    s = Surface()
    s.position = position[i]
    s.normal = normal[i]
    aimed = aim.aim_at(targets, s, 4)
    rays_out[i] = aimed.rays
    share_out[i] = aimed.sector.share
    disk = aim.sector_point(aimed.sector, xi[i])
    disk_out[i] = disk
    inside_out[i] = wp.where(aim.in_sector(aimed.sector, disk), 1, 0)


def sectors(launcher, low, high, position, normal, xi):
    targets = make_targets(np.array([[low, high]]))
    count = len(position)
    arrays = [lit.launcher_vectors(launcher, np.asarray(v, float)) for v in (position, normal)]
    outputs = [launcher.zeros(count, kind) for kind in (wp.int32, wp.float32, wp.vec2, wp.int32)]
    launcher.launch(_sector, count, [targets, *arrays, launcher.array(np.asarray(xi, np.float32), wp.vec2)], outputs)
    return [o.numpy() for o in outputs]


def test_sectors_hold_the_box_and_their_own_points(launcher):
    """From random points and normals, down to boxes a thousandth of their distance wide: directions to points of the
    box over the horizon lie in the sector, and so do the sector's own points, away from its rim."""
    rng = np.random.default_rng(3)
    count = 4000
    middle = rng.normal(size=3)
    half = np.array([0.4, 0.2, 0.3])
    position = middle + rng.normal(size=(count, 3)) * rng.uniform(0.5, 300.0, (count, 1))
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    xi = rng.uniform(0.01, 0.99, (count, 2))
    rays, share, disk, inside = sectors(launcher, middle - half, middle + half, position, normal, xi)
    aimed = rays > 0
    assert 0.4 < aimed.mean() < 0.7  # the others look away, or the box is all around them
    assert (share[aimed] > 0.0).all()
    assert (share[aimed] < float(aim.WIDEST)).all()
    assert inside[aimed].mean() > 0.999
    height = np.sqrt(np.maximum(1.0 - (disk.astype(float) ** 2).sum(1), 0.0))
    t = np.stack(np.vectorize(tangent, signature="(k)->(k)")(normal), 0)
    b = np.cross(normal, t)
    way = t * disk[:, :1] + b * disk[:, 1:] + normal * height[:, None]
    toward = middle - position
    far = np.linalg.norm(toward, axis=1)
    apart = np.degrees(np.arccos(np.clip((way * toward).sum(1) / far, -1.0, 1.0)))
    seen = np.degrees(np.arcsin(np.minimum(np.linalg.norm(half) / far, 1.0)))
    over = (toward * normal).sum(1) > np.linalg.norm(half)  # wholly over the horizon
    assert (apart[aimed & over] < 2.5 * seen[aimed & over] + 1.0).all()  # and not far beyond the box


def boxes(*middles, half=0.1):
    return np.array([[np.asarray(m, float) - half, np.asarray(m, float) + half] for m in middles])


def test_objects_that_stand_apart_have_two_boxes():
    """Neighbours share one; two far ones have their own; of three, the two that are closest share one; parts of one
    thing, and any number of them, are joined first; every object stays in a box."""
    assert targets_of(np.zeros((0, 2, 3))).count == 0
    assert targets_of(boxes((0, 0, 0))).count == 1
    assert targets_of(boxes((0, 0, 0), (0.25, 0, 0))).count == 1
    np.testing.assert_allclose(two_boxes(boxes((0, 0, 0), (5, 0, 2))), boxes((0, 0, 0), (5, 0, 2)))
    found = two_boxes(boxes((0, 0, 0), (5, 0, 2), (0.4, 0, 0)))
    assert sorted(found[:, 1, 0]) == pytest.approx([0.5, 5.1])
    rng = np.random.default_rng(0)
    many = boxes(*rng.uniform(-0.5, 0.5, (400, 3)), *rng.uniform((8.5, -0.5, 3.5), (9.5, 0.5, 4.5), (300, 3)))
    found = two_boxes(many)
    assert len(found) == 2
    assert sorted(np.round(found[:, 0, 0])) == [-1, 8]
    held = (found[:, None, 0] <= many[:, 0]).all(-1) & (found[:, None, 1] >= many[:, 1]).all(-1)
    assert held.any(0).all()


def test_two_far_objects_are_both_aimed_at(stage):
    """Objects at two ends of the room: the mean stays, as far as 8192 even rays say, and 12 and 12 rays have less noise
    than with one box around both."""
    moved = []
    objects = [m for m in stage.meshes if m.role == Role.SYNTHETIC]
    for mesh, place in zip(objects, ((1.3, 0.0, 0.5), (-1.3, 0.0, -0.9)), strict=True):
        low, high = mesh.points.min(0), mesh.points.max(0)
        foot = np.array([0.5 * (low[0] + high[0]), low[1], 0.5 * (low[2] + high[2])])
        moved.append(replace(mesh, points=0.6 * (mesh.points - foot) + place))
    apart = replace(stage, meshes=(*(m for m in stage.meshes if m.role == Role.REAL), *moved))
    truth = change(apart, 8192, 0.0)
    tiles = np.abs(tiles_of(change(apart, 2048, 0.375) - truth))
    assert tiles.mean() < 0.03 * np.abs(truth).mean()
    assert tiles.max() < 0.2 * np.abs(truth).mean()

    def noise():
        return np.mean([np.abs(change(apart, 32, 0.375, seed) - truth) for seed in range(3)])

    both = noise()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("warp_dvct.targets.APART", 0.0)  # always one box
        one = noise()
    assert both < 0.9 * one


def tangent(n):
    sign = 1.0 if n[2] >= 0.0 else -1.0
    a = -1.0 / (sign + n[2])
    return np.array([1.0 + sign * n[0] * n[0] * a, sign * n[0] * n[1] * a, -sign * n[0]])
