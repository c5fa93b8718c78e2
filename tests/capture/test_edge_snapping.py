"""Depth jumps go where the photograph has its edges: against NumPy twins, and against the truth."""

from __future__ import annotations

from dataclasses import replace

import depth_scene as ds
import numpy as np
import pytest
import warp as wp

from warp_dvct.capture.noise import KinectNoise
from warp_dvct.kernels import edge_snapping as kernels
from warp_dvct.passes.depth_filter import DepthFilter, FilterOptions, Guide, _lens_of, _limits

WIDTH, HEIGHT, COUNT = 40, 30, 1200
OPTIONS = FilterOptions()
LENS = (50.0, 51.0, 19.0, 15.0)
LIMITS = OPTIONS.edge * OPTIONS.noise, OPTIONS.edge_share


@pytest.fixture
def inverse() -> np.ndarray:
    """A near block whose edge is frayed, before a far wall with holes."""
    rng = np.random.default_rng(3)
    u = np.indices((HEIGHT, WIDTH))[1]
    rho = np.where(u + rng.integers(-1, 2, (HEIGHT, WIDTH)) < 20, 0.9, 0.45)
    rho[rng.random(rho.shape) < 0.03] = 0.0
    return rho.astype(np.float32)


@pytest.fixture
def guide() -> np.ndarray:
    """Two colours that meet in a straight line, and noise; some pixels outside of the photograph."""
    rng = np.random.default_rng(5)
    colors = np.where(np.indices((HEIGHT, WIDTH))[1][..., None] < 20, [0.8, 0.3, 0.2], [0.2, 0.4, 0.6])
    colors = colors + rng.normal(0.0, 0.02, colors.shape)
    colors[:3, :5] = -1.0
    return colors.astype(np.float32)


def apart(a, b):
    return (a > 0) & (b > 0) & (np.abs(a - b) > LIMITS[0] + LIMITS[1] * np.maximum(a, b))


def marks(inverse: np.ndarray) -> np.ndarray:
    """Twin of _mark_jumps."""
    padded = np.pad(inverse, 1)
    sides = padded[1:-1, 2:], padded[1:-1, :-2], padded[2:, 1:-1], padded[:-2, 1:-1]
    return np.any([apart(inverse, side) for side in sides], axis=0).astype(np.int32)


def snapped(inverse, guide, mark, contrast) -> np.ndarray:
    """Twin of _snap, pixel by pixel."""
    out = inverse.astype(np.float64)
    for y in range(HEIGHT):
        for x in range(WIDTH):
            rho = inverse[y, x]
            band = np.s_[max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3]
            if rho <= 0 or guide[y, x, 0] < 0 or not mark[band].any():
                continue
            around = np.s_[max(y - 3, 0) : y + 4, max(x - 3, 0) : x + 4]
            r, c = inverse[around], guide[around]
            middle = 0.5 * (r[r > 0].min() + r.max())
            sure = (r > 0) & (mark[around] == 0) & (c[..., 0] >= 0)
            near, far = sure & (r > middle), sure & (r <= middle)
            if not (near.any() and far.any()):
                continue
            ring = inverse[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2]
            beside_near = (ring > middle).sum() - (rho > middle)
            beside_far = ((ring > 0) & (ring <= middle)).sum() - (rho <= middle)
            cn, cf = c[near].mean(0), c[far].mean(0)
            if np.linalg.norm(cn - cf) <= contrast:
                continue
            dn, df = np.linalg.norm(guide[y, x] - cn), np.linalg.norm(guide[y, x] - cf)
            if rho > middle and df < 0.7 * dn and beside_far >= 3:
                out[y, x] = r[far].mean()
            elif rho <= middle and dn < 0.7 * df and beside_near >= 3:
                out[y, x] = r[near].mean()
    return out


def test_kernels_are_their_twins_and_the_edge_becomes_straight(launcher, inverse, guide):
    lens = _lens_of(LENS, (WIDTH, HEIGHT))
    rho = launcher.array(inverse.ravel(), wp.float32)
    mark, out = launcher.empty(COUNT, wp.int32), launcher.empty(COUNT, wp.float32)
    launcher.launch(kernels._mark_jumps, COUNT, [lens, _limits(OPTIONS), rho], [mark])
    np.testing.assert_array_equal(mark.numpy().reshape(inverse.shape), marks(inverse))
    colors = launcher.array(guide.reshape(-1, 3), wp.vec3)
    flag = launcher.empty(5 * 4, wp.int32)
    launcher.launch(kernels._flag_tiles, 5 * 4, [lens, mark, 5], [flag])
    near = np.pad(marks(inverse), 2)
    flags = [[near[y : y + 12, x : x + 12].any() for x in range(0, WIDTH, 8)] for y in range(0, HEIGHT, 8)]
    np.testing.assert_array_equal(flag.numpy().reshape(4, 5), flags)
    launcher.launch(kernels._snap, COUNT, [lens, rho, colors, mark, flag, 5, 0.08], [out])
    expected = snapped(inverse, guide, marks(inverse), 0.08)
    np.testing.assert_allclose(out.numpy().reshape(inverse.shape), expected, rtol=1e-5)
    known = (inverse > 0) & (guide[..., 0] >= 0)
    truth = np.where(np.indices(inverse.shape)[1] < 20, 0.9, 0.45)
    wrong = [(np.abs(r - truth) > 0.1)[known].sum() for r in (inverse, expected)]
    assert wrong[0] > 10
    assert wrong[1] <= 1
    launcher.launch(kernels._snap, COUNT, [lens, rho, colors, mark, flag, 5, 10.0], [out])
    np.testing.assert_array_equal(out.numpy(), inverse.ravel())


def test_colours_are_taken_from_where_the_photograph_shows_the_surface(launcher, inverse):
    rng = np.random.default_rng(0)
    photo = rng.random((25, 33, 3)).astype(np.float32)
    other, shift = (40.0, 42.0, 15.0, 13.0), np.array([0.1, -0.05, 0.02])
    inputs = [
        _lens_of(LENS, (WIDTH, HEIGHT)),
        launcher.array(inverse.ravel(), wp.float32),
        wp.mat33(*np.eye(3).ravel().tolist()),
        wp.vec3(*shift.tolist()),
        _lens_of(other, (33, 25)),
        launcher.array(photo.reshape(-1, 3), wp.vec3),
    ]
    out = launcher.empty(COUNT, wp.vec3)
    launcher.launch(kernels._sample_guide, COUNT, inputs, [out])
    v, u = np.indices(inverse.shape)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = 1.0 / inverse.astype(np.float64)
        p = np.stack([(u - LENS[2]) / LENS[0] * z, (v - LENS[3]) / LENS[1] * z, z], -1) + shift
        x = np.floor(other[0] * p[..., 0] / p[..., 2] + other[2] + 0.5)
        y = np.floor(other[1] * p[..., 1] / p[..., 2] + other[3] + 0.5)
        inside = (inverse > 0) & (x >= 0) & (x < 33) & (y >= 0) & (y < 25)
    expected = np.full((HEIGHT, WIDTH, 3), -1.0)
    expected[inside] = photo[y[inside].astype(int), x[inside].astype(int)]
    same = np.isclose(out.numpy().reshape(expected.shape), expected).all(-1)
    assert same.mean() > 0.995  # a place between two pixels may go to either in float32
    assert 0.2 < inside.mean() < 0.98


def test_a_photograph_halves_what_is_on_the_wrong_side(launcher):
    """Colour by true normals: the block's sides, the walls and the floor differ."""
    lens, pose = ds.LENS, ds.poses(1)[0]
    true, normal = ds.seen(launcher, ds.corner(), lens, pose)
    measured = KinectNoise.only("lateral", "disparity").apply(true, normal, lens, 0, 0)
    codes = np.rint(255.0 * (0.5 + 0.5 * normal)).astype(np.uint8)
    numbers = lens.fx, lens.fy, lens.cx, lens.cy
    guide = Guide(codes, numbers, np.eye(4))
    wrong = []
    for options in (replace(OPTIONS, snap=0), OPTIONS):
        depth = DepthFilter(launcher, numbers, lens.size, options).update(measured, pose, guide).depth()
        wrong.append((np.abs(depth - true) > 0.15)[(true > 0) & (depth > 0)].sum())
    assert wrong[0] > 30
    assert wrong[1] < 0.5 * wrong[0]
