"""Depth images as meshes: no cracks, no gap at depth jumps, few triangles where it is flat."""

from __future__ import annotations

from dataclasses import replace

import depth_scene as ds
import lit_scenes as lit
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warp_dvct.capture.grid import BLOCK, GridLimits, depth_grid, grid_mesh
from warp_dvct.capture.intrinsics import Intrinsics
from warp_dvct.capture.simulate import DepthEye

LIMITS = GridLimits(0.019, 0.02, 0.001)
LENS = Intrinsics(97, 70, 90.0, 91.0, 47.0, 36.0)
TOWARDS = np.broadcast_to(np.float32([0.0, 0.0, -1.0]), (70, 97, 3))


def seen_again(launcher, grid, lens) -> np.ndarray:
    """Inverse depth of the grid by rays; 0 where they miss it."""
    scene = lit.scene_of(grid_mesh(grid, np.eye(4), 0, None, "/grid"))
    depth, _ = DepthEye(launcher, scene, lens).look(np.eye(4))
    return np.divide(1.0, depth, out=np.zeros_like(depth), where=depth > 0)


@pytest.fixture(scope="module")
def corner(launcher):
    """Inverse depth and normals of the corner of a room with a block, and a hole."""
    depth, normal = ds.seen(launcher, ds.corner(), LENS, ds.poses(1)[0])
    depth[5:20, 70:90] = 0.0
    return np.divide(1.0, depth, out=np.zeros_like(depth), where=depth > 0), normal


def test_the_camera_sees_its_depth_again(launcher, corner):
    inverse, normal = corner
    grid = depth_grid(inverse, normal, LENS, LIMITS)
    again = seen_again(launcher, grid, LENS)
    known = inverse > 0
    assert (again > 0)[known].mean() > 0.995
    assert (again > 0)[~known].mean() < 0.1
    both = known & (again > 0)
    # Beside a jump the ray through a vertex may meet the surface behind it.
    off = np.abs(again - inverse)[both] > 1.5 * LIMITS.tolerance
    assert off.mean() < 0.02
    triangles = grid.points[grid.triangles]
    facing = (np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]) * triangles[:, 0]).sum(-1)
    assert (facing < 0).all()
    assert len(grid.triangles) < 0.3 * 2 * inverse.size


@given(st.integers(0, 1000))
@settings(max_examples=8, deadline=None)
def test_there_are_no_cracks(seed):
    """Between pixels, too: rays that meet no pixel's centre all hit, whatever the surface."""
    from warp_dvct.launch import Launcher

    rng = np.random.default_rng(seed)
    v, u = np.indices((70, 97))
    inverse = 0.5 + 0.001 * u + 0.0005 * v
    for _ in range(4):  # bumps of all sizes, none of which is a jump
        x, y, size = rng.uniform(0, 97), rng.uniform(0, 70), rng.uniform(2, 20)
        inverse += rng.uniform(-0.01, 0.01) * np.exp(-((u - x) ** 2 + (v - y) ** 2) / size**2)
    grid = depth_grid(inverse.astype(np.float32), TOWARDS, LENS, LIMITS)
    shifted = replace(LENS, cx=LENS.cx - rng.uniform(0.05, 0.45), cy=LENS.cy + rng.uniform(0.05, 0.45))
    again = seen_again(Launcher("cpu", threads=2), grid, shifted)
    assert (again > 0).mean() == 1.0
    assert np.abs(again - inverse).max() < 0.01


def test_no_gap_is_seen_at_a_jump_and_no_surface_spans_it(launcher):
    inverse = np.full((70, 97), 0.5, np.float32)
    inverse[20:50, 30:60] = 1.0
    grid = depth_grid(inverse, TOWARDS, LENS, LIMITS)
    for shift in (0.0, 0.3, -0.4, 0.5):
        again = seen_again(launcher, grid, replace(LENS, cx=LENS.cx + shift, cy=LENS.cy - shift))
        assert (again > 0).all()
        # Each is on one of both surfaces: nothing is between.
        assert np.minimum(np.abs(again - 0.5), np.abs(again - 1.0)).max() < 1e-5
        assert abs(int((again > 0.75).sum()) - 900) < 70


def test_holes_stay_holes_and_planes_are_coarse():
    inverse = np.full((2 * BLOCK + 1, 2 * BLOCK + 1), 0.5, np.float32)
    lens = Intrinsics(65, 65, 60.0, 60.0, 32.0, 32.0)
    normal = np.broadcast_to(np.float32([0.0, 0.0, -1.0]), (65, 65, 3))
    flat = depth_grid(inverse, normal, lens, LIMITS)
    assert len(flat.triangles) == 8
    inverse[10:20, 40:45] = 0.0
    grid = depth_grid(inverse, normal, lens, LIMITS)
    middle = grid.pixels[grid.triangles].mean(1)
    inside = (middle[:, 0] > 40) & (middle[:, 0] < 44) & (middle[:, 1] > 10) & (middle[:, 1] < 19)
    assert not inside.any()
    assert (grid.points[:, 2] > 1.0).all()
    nothing = depth_grid(np.zeros((65, 65), np.float32), normal, lens, LIMITS)
    assert len(nothing.triangles) == 0
