"""Registration: a photograph whose colours are places, seen from beside the depth camera."""

from __future__ import annotations

import depth_scene as ds
import numpy as np
import pytest

from warp_dvct.capture.intrinsics import Intrinsics
from warp_dvct.capture.registration import register_color, sample, undistorted_depth
from warp_dvct.capture.stage import CaptureRig

OTHER = Intrinsics(150, 130, 120.0, 121.0, 74.0, 66.0)


@pytest.fixture(scope="module")
def views(launcher):
    """True depth, the world position that each depth pixel sees, and a photograph whose colours are positions."""
    extrinsic = np.eye(4)
    extrinsic[:3, :3] = ds.lit.turned(2.0)
    extrinsic[:3, 3] = -0.08, 0.01, 0.02
    rig = CaptureRig(ds.LENS, OTHER, extrinsic)
    pose = ds.poses(1)[0]
    scene = ds.corner()
    depth, _ = ds.seen(launcher, scene, rig.depth, pose)
    color_pose = pose @ np.linalg.inv(extrinsic)
    photo_depth, _ = ds.seen(launcher, scene, OTHER, color_pose)

    def places(lens, image, at):
        return (lens.rays() * image[..., None]) @ at[:3, :3].T + at[:3, 3]

    return rig, depth, places(rig.depth, depth, pose), places(OTHER, photo_depth, color_pose), photo_depth


def test_each_depth_pixel_gets_the_colour_of_its_own_place(views):
    rig, depth, place, photo, _ = views
    done = register_color(depth, photo.astype(np.float32), rig)
    assert done.visible.mean() > 0.6
    # Beside depth jumps a bilinear sample mixes both surfaces.
    error = np.linalg.norm(done.color - place, axis=-1)[done.visible]
    assert np.median(error) < 1e-3
    assert (error > 0.05).mean() < 0.04
    # Taking both images for aligned is wrong everywhere.
    naive = np.linalg.norm(photo[:120, :150] - place[:, :150], axis=-1)
    assert np.median(naive) > 0.03


def test_what_the_photograph_does_not_see_gets_no_colour(views):
    """Against the oracle of true visibility: the place's depth in the photograph's camera, and what is seen there."""
    rig, depth, _, photo, photo_depth = views
    done = register_color(depth, photo.astype(np.float32), rig)
    points = rig.depth.rays() * depth[..., None] @ rig.depth_to_color[:3, :3].T + rig.depth_to_color[:3, 3]
    front, inside = sample(photo_depth[..., None], done.uv)
    hidden = inside & (depth > 0) & (points[..., 2] > 1.1 * front[..., 0])
    assert hidden.sum() > 50
    assert (done.visible & hidden).sum() < 0.15 * hidden.sum()
    assert (done.color[~done.visible] == 0).all()
    clear = inside & (depth > 0) & (points[..., 2] < 1.01 * front[..., 0])
    assert (done.visible & clear).sum() > 0.97 * clear.sum()


def test_bytes_stay_bytes(views):
    rig, depth, *_ = views
    photo = np.full((130, 150, 3), 77, np.uint8)
    done = register_color(depth, photo, rig)
    assert done.color.dtype == np.uint8
    assert (done.color[done.visible] == 77).all()
    with pytest.raises(ValueError, match="no colour camera"):
        register_color(depth, photo, CaptureRig(ds.LENS))


def test_depth_of_a_distorting_lens_is_moved_never_mixed(launcher):
    bent = Intrinsics(160, 120, 146.25, 146.25, 79.5, 59.5, (0.2, -0.1))
    rng = np.random.default_rng(0)
    depth = rng.choice(np.array([0.0, 1.0, 2.0], np.float32), (120, 160))
    moved, lens = undistorted_depth(depth, bent)
    assert not lens.is_distorted
    assert set(np.unique(moved)) <= {0.0, 1.0, 2.0}
    v, u = 30, 20
    x, y = np.rint(bent.project(lens.rays()[v, u])).astype(int)
    assert moved[v, u] == depth[y, x]
    same, _ = undistorted_depth(depth, ds.LENS)
    assert same is depth
