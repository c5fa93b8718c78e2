"""Live filtering: each kernel against its NumPy twin, and what the filter makes of a simulated Kinect."""

from __future__ import annotations

import depth_scene as ds
import numpy as np
import pytest
import warp as wp

from warp_dvct.capture.noise import KinectNoise
from warp_dvct.errors import OptionError
from warp_dvct.kernels import depth_filter as kernels
from warp_dvct.passes.depth_filter import DepthFilter, FilterOptions, _limits

WIDTH, HEIGHT = 45, 37  # no multiples of the tiles
OPTIONS = FilterOptions()
EDGE, EDGE_SHARE = OPTIONS.edge * OPTIONS.noise, OPTIONS.edge_share
AGREE, AGREE_SHARE = OPTIONS.agree * OPTIONS.noise, OPTIONS.agree_share


def lens_of(width: int = WIDTH, height: int = HEIGHT):
    lens = kernels.Lens()
    lens.fx, lens.fy, lens.cx, lens.cy = 41.0, 43.0, 0.5 * width - 1.0, 0.5 * height
    lens.width, lens.height = width, height
    return lens


@pytest.fixture
def inverse() -> np.ndarray:
    """A slanted plane, a nearer block, noise, and holes."""
    rng = np.random.default_rng(4)
    v, u = np.indices((HEIGHT, WIDTH))
    rho = 0.4 + 0.002 * u + 0.003 * v
    rho[10:25, 12:30] = 0.9
    rho += rng.normal(0.0, OPTIONS.noise, rho.shape)
    rho[rng.random(rho.shape) < 0.05] = 0.0
    rho[5:9, 5:15] = 0.0
    return rho.astype(np.float32)


def same(a, b):
    return (a > 0) & (b > 0) & (np.abs(a - b) <= EDGE + EDGE_SHARE * np.maximum(a, b))


def run(launcher, kernel, inputs, *outputs) -> list[np.ndarray]:
    """Launch over a picture; arrays go to the device, outputs are given as types."""
    devices = [
        launcher.array(i, wp.vec3 if i.ndim == 2 else wp.dtype_from_numpy(i.dtype)) if isinstance(i, np.ndarray) else i
        for i in inputs
    ]
    made = [launcher.zeros(WIDTH * HEIGHT, o) for o in outputs]
    launcher.launch(kernel, WIDTH * HEIGHT, devices, made)
    return [m.numpy() for m in made]


def test_no_depth_stays_no_depth(launcher):
    (out,) = run(launcher, kernels._invert, [np.linspace(-1, 3, WIDTH * HEIGHT).astype(np.float32)], wp.float32)
    stored = np.linspace(-1, 3, WIDTH * HEIGHT).astype(np.float32)
    expected = np.where(stored > 0, 1.0 / np.maximum(stored, 0.01), 0.0)
    np.testing.assert_allclose(out, expected, rtol=1e-6)


def moved(inverse, lens, relative) -> np.ndarray:
    """Twin of _move_vertices: ``[h, w, 3]``."""
    v, u = np.indices(inverse.shape)
    with np.errstate(all="ignore"):
        z = 1.0 / inverse.astype(np.float64)
        p = np.stack([(u - lens.cx) / lens.fx * z, (v - lens.cy) / lens.fy * z, z], -1)
        p = p @ relative[:3, :3].T + relative[:3, 3]
        out = np.stack(
            [lens.fx * p[..., 0] / p[..., 2] + lens.cx, lens.fy * p[..., 1] / p[..., 2] + lens.cy, 1 / p[..., 2]], -1
        )
    return np.where(((inverse > 0) & (p[..., 2] > 0.01))[..., None], out, 0.0)


def drawn(inverse, weight, vertices) -> tuple[np.ndarray, np.ndarray]:
    """Twin of _draw_tiles: one triangle after the other over all pixels."""
    out, out_weight = np.zeros(inverse.shape), np.zeros(inverse.shape)
    y, x = np.indices(inverse.shape).astype(float)
    for j in range(inverse.shape[0] - 1):
        for i in range(inverse.shape[1] - 1):
            corners = [(j, i), (j, i + 1), (j + 1, i), (j + 1, i + 1)]
            for t in ((0, 1, 2), (1, 3, 2)):
                k = [corners[n] for n in t]
                r = [inverse[c] for c in k]
                if (
                    not (same(r[0], r[1]) and same(r[1], r[2]) and same(r[0], r[2]))
                    or min(vertices[c][2] for c in k) <= 0
                ):
                    continue
                a, b, c = (vertices[n] for n in k)
                area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
                if area <= 0:
                    continue
                edge = [(q[0] - p[0]) * (y - p[1]) - (x - p[0]) * (q[1] - p[1]) for p, q in ((b, c), (c, a), (a, b))]
                rho = sum(e * n[2] for e, n in zip(edge, (a, b, c), strict=True)) / area
                inside = (np.minimum(np.minimum(*edge[:2]), edge[2]) >= 0) & (rho > out)
                out = np.where(inside, rho, out)
                mean = sum(e * weight[n] for e, n in zip(edge, k, strict=True)) / area
                out_weight = np.where(inside, mean, out_weight)
    return out, out_weight


def test_the_warp_draws_what_a_plain_rasteriser_draws(launcher, inverse):
    lens = lens_of()
    relative = np.eye(4)
    a = 0.06
    relative[:3, :3] = [[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]]
    relative[:3, 3] = 0.21, -0.08, -0.12
    weight = np.random.default_rng(1).uniform(1, 9, inverse.shape).astype(np.float32)
    vertices = moved(inverse, lens, relative)
    turn, shift = wp.mat33(*relative[:3, :3].ravel().tolist()), wp.vec3(*relative[:3, 3].tolist())
    (found,) = run(launcher, kernels._move_vertices, [lens, inverse.ravel(), turn, shift], wp.vec3)
    np.testing.assert_allclose(found, vertices.reshape(-1, 3), rtol=2e-5, atol=2e-5)

    depth_filter = DepthFilter(launcher, (lens.fx, lens.fy, lens.cx, lens.cy), (WIDTH, HEIGHT), OPTIONS)
    state = launcher.array(inverse.ravel(), wp.float32), launcher.array(weight.ravel(), wp.float32), relative
    depth_filter._state = state
    warped, warped_weight = (w.numpy().reshape(inverse.shape) for w in depth_filter._warp(np.eye(4)))
    expected, expected_weight = drawn(inverse, weight, found.reshape(HEIGHT, WIDTH, 3).astype(np.float64))
    # A pixel's centre on an edge may fall to either side in float32.
    apart = (np.abs(warped - expected) > 1e-5) | (np.abs(warped_weight - expected_weight) > 1e-3)
    assert apart.mean() < 0.002
    assert (expected > 0).mean() > 0.5


def test_an_unmoved_camera_gets_its_own_depth_back(launcher, inverse):
    lens = lens_of()
    depth_filter = DepthFilter(launcher, (lens.fx, lens.fy, lens.cx, lens.cy), (WIDTH, HEIGHT), OPTIONS)
    ones = launcher.full(inverse.size, 1.0, wp.float32)
    depth_filter._state = launcher.array(inverse.ravel(), wp.float32), ones, np.eye(4)
    warped = depth_filter._warp(np.eye(4))[0].numpy().reshape(inverse.shape)
    there = warped > 0
    assert there.mean() > 0.6
    np.testing.assert_allclose(warped[there], inverse[there], rtol=1e-4)
    assert not (there & (inverse == 0)).any()


def test_merge_averages_what_agrees_and_restarts_what_does_not(launcher):
    rng = np.random.default_rng(2)
    count = WIDTH * HEIGHT
    new, old = rng.uniform(0.3, 1.0, (2, count)).astype(np.float32)
    close = rng.random(count) < 0.5
    old[close] = new[close] + rng.normal(0, 0.004, close.sum()).astype(np.float32)
    new[rng.random(count) < 0.2] = 0.0
    old[rng.random(count) < 0.2] = 0.0
    weight = np.where(old > 0, rng.uniform(0.2, 12, count), 0).astype(np.float32)
    out = run(launcher, kernels._merge, [_limits(OPTIONS), new, old, weight, 8.0], wp.float32, wp.float32, wp.int32)
    agree = np.abs(new - old) <= AGREE + AGREE_SHARE * np.maximum(new, old)
    both, carried = (new > 0) & (old > 0) & agree, (new <= 0) & (old > 0) & (weight > 1)
    inverse = np.where(both, (weight * old + new) / (weight + 1), np.where(carried, old, new))
    total = np.where(both, np.minimum(weight + 1, 8), np.where(new > 0, 1, np.where(carried, weight - 1, 0)))
    kind = np.where(new > 0, kernels.MEASURED, np.where(carried, kernels.CARRIED, kernels.NOTHING))
    np.testing.assert_allclose(out[0], inverse, rtol=1e-5)
    np.testing.assert_allclose(out[1], total, rtol=1e-5)
    np.testing.assert_array_equal(out[2], kind)
    assert both.sum() > 100
    assert carried.sum() > 100


def neighbours(image: np.ndarray) -> np.ndarray:
    padded = np.pad(image, 1)
    return np.stack([padded[dy : dy + HEIGHT, dx : dx + WIDTH] for dy in range(3) for dx in range(3)])


def test_holes_take_the_farther_surface_and_are_marked(launcher, inverse):
    kind = np.where(inverse > 0, int(kernels.MEASURED), 0).astype(np.int32)
    lens = lens_of()
    out = run(launcher, kernels._fill, [lens, _limits(OPTIONS), inverse.ravel(), kind.ravel()], wp.float32, wp.int32)
    around = neighbours(inverse)
    far = np.where(around > 0, around, np.inf).min(0)
    chosen = same(around, np.where(np.isfinite(far), far, 0.0))
    mean = (around * chosen).sum(0) / np.maximum(chosen.sum(0), 1)
    np.testing.assert_allclose(out[0].reshape(inverse.shape), np.where(inverse > 0, inverse, mean), rtol=1e-5)
    expected = np.where(inverse > 0, kernels.MEASURED, np.where(mean > 0, kernels.FILLED, kernels.NOTHING))
    np.testing.assert_array_equal(out[1].reshape(inverse.shape), expected)


@pytest.mark.parametrize("step", [1, 4])
def test_smoothing_is_its_twin(launcher, inverse, step):
    limit = 4.0 * OPTIONS.noise
    (out,) = run(launcher, kernels._smooth, [lens_of(), limit, step, inverse.ravel()], wp.float32)
    total, weight = 4.0 * inverse.astype(np.float64), np.full(inverse.shape, 4.0)
    padded = np.pad(inverse, step)
    for dy, dx, w in ((0, 1, 2.0), (1, 0, 2.0), (1, 1, 1.0), (-1, 1, 1.0)):
        a, b = (padded[step + s * dy * step :, step + s * dx * step :][:HEIGHT, :WIDTH] for s in (1, -1))
        good = (a > 0) & (b > 0) & (np.abs(0.5 * (a + b) - inverse) <= limit)
        total += np.where(good, w * (a + b), 0.0)
        weight += np.where(good, 2.0 * w, 0.0)
    np.testing.assert_allclose(out.reshape(inverse.shape), np.where(inverse > 0, total / weight, 0.0), rtol=1e-5)


def test_a_plane_passes_smoothing_unchanged_and_has_its_normal(launcher):
    lens = lens_of()
    v, u = np.indices((HEIGHT, WIDTH))
    normal = np.array([0.5, -0.6, -0.6245])
    normal /= np.linalg.norm(normal)
    rays = np.stack([(u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy, np.ones(u.shape)], -1)
    inverse = (rays @ normal / -1.5).astype(np.float32)
    assert inverse.min() > 0.0
    inputs = [lens, 4.0 * OPTIONS.noise, 2, inverse.ravel()]
    (smooth,) = run(launcher, kernels._smooth, inputs, wp.float32)
    np.testing.assert_allclose(smooth.reshape(inverse.shape), inverse, rtol=3e-6)
    (found,) = run(launcher, kernels._find_normals, [lens, _limits(OPTIONS), inverse.ravel()], wp.vec3)
    assert ds.angle(found.reshape(*inverse.shape, 3), normal).max() < 0.1


def test_normals_are_their_twin_and_zero_where_nothing_is(launcher, inverse):
    lens = lens_of()
    (found,) = run(launcher, kernels._find_normals, [lens, _limits(OPTIONS), inverse.ravel()], wp.vec3)
    padded = np.pad(inverse, 1)
    v, u = np.indices(inverse.shape)

    def derivative(before, after):
        back, forth = same(before, inverse), same(after, inverse)
        value = np.where(back & forth, 0.5 * (after - before), np.where(forth, after - inverse, inverse - before))
        return np.where(back | forth, value, np.nan)

    du = derivative(padded[1:-1, :-2], padded[1:-1, 2:])
    dv = derivative(padded[:-2, 1:-1], padded[2:, 1:-1])
    n = -np.stack([du * lens.fx, dv * lens.fy, inverse - du * (u - lens.cx) - dv * (v - lens.cy)], -1)
    n = np.nan_to_num(n / np.linalg.norm(n, axis=-1, keepdims=True))
    np.testing.assert_allclose(found.reshape(n.shape), n, atol=2e-4)
    assert (found.reshape(n.shape)[inverse == 0] == 0).all()


@pytest.fixture(scope="module")
def stream(launcher):
    """True and measured depth of a moving camera, and what the filter made of it."""
    scene = ds.corner()
    lens = ds.LENS
    depth_filter = DepthFilter(launcher, (lens.fx, lens.fy, lens.cx, lens.cy), lens.size)
    frames = []
    for k, pose in enumerate(ds.poses(8)):
        true, normal = ds.seen(launcher, scene, lens, pose)
        measured = KinectNoise().apply(true, normal, lens, 0, k)
        frames.append((true, normal, measured, depth_filter.update(measured, pose)))
    return frames


def test_filtered_normals_have_at_most_half_the_error_of_raw_ones(stream):
    _, normal, measured, filtered = stream[-1]
    raw = ds.paper_normals(measured, ds.LENS)
    compared = (np.linalg.norm(raw, axis=-1) > 0.5) & (np.linalg.norm(filtered.normals(), axis=-1) > 0.5)
    assert compared.mean() > 0.7
    error = ds.angle(filtered.normals(), normal)[compared].mean()
    assert error <= 0.5 * ds.angle(raw, normal)[compared].mean()
    assert error < 12.0


def test_filtered_depth_is_nearer_to_the_truth(stream):
    for true, _, measured, filtered in stream[2:]:
        both = (measured > 0) & (true > 0) & (filtered.depth() > 0)
        raw = np.abs(measured - true)[both]
        assert np.median(np.abs(filtered.depth() - true)[both]) < 0.5 * np.median(raw)


def test_nothing_is_nearer_than_anything_that_was_measured(stream):
    """Invalid depth is never a surface at the origin, in any frame."""
    for true, _, _, filtered in stream:
        depth = filtered.depth()
        assert depth[depth > 0].min() > 0.8 * true[true > 0].min()
        kinds = filtered.kinds()
        assert ((kinds == int(kernels.NOTHING)) == (depth == 0)).all()
        weights = filtered.weight.numpy().reshape(depth.shape)
        assert (weights[kinds == int(kernels.FILLED)] == 0).all()


def test_what_moved_away_is_forgotten_at_once(launcher):
    """Where new depth disagrees with old, the new one wins."""
    lens = ds.LENS
    depth_filter = DepthFilter(launcher, (lens.fx, lens.fy, lens.cx, lens.cy), lens.size, FilterOptions(smooth=0))
    near, far = np.full((lens.height, lens.width), 1.0, np.float32), np.full((lens.height, lens.width), 2.0, np.float32)
    for _ in range(5):
        depth_filter.update(near, np.eye(4))
    filtered = depth_filter.update(far, np.eye(4))
    np.testing.assert_allclose(filtered.depth(), 2.0, rtol=1e-6)
    assert (filtered.weight.numpy() == 1.0).all()


def test_a_lost_measurement_is_carried_as_long_as_it_had_been_seen(launcher):
    lens = ds.LENS
    depth_filter = DepthFilter(launcher, (lens.fx, lens.fy, lens.cx, lens.cy), lens.size, FilterOptions(fill=0))
    wall, nothing = np.full((lens.height, lens.width), 1.5, np.float32), np.zeros((lens.height, lens.width), np.float32)
    for _ in range(3):
        depth_filter.update(wall, np.eye(4))
    kinds = [depth_filter.update(nothing, np.eye(4)).kinds()[60, 80] for _ in range(4)]
    assert kinds == [int(kernels.CARRIED)] * 2 + [int(kernels.NOTHING)] * 2


def test_a_depth_image_of_another_size_is_refused(launcher):
    depth_filter = DepthFilter(launcher, (10.0, 10.0, 4.0, 4.0), (9, 9))
    with pytest.raises(OptionError, match=r"\(5, 9\)"):
        depth_filter.update(np.ones((5, 9), np.float32), np.eye(4))


def test_any_number_of_threads_gives_the_same_bytes(stream, launcher):
    from warp_dvct.launch import Launcher

    lens = ds.LENS
    single = DepthFilter(Launcher("cpu", threads=1), (lens.fx, lens.fy, lens.cx, lens.cy), lens.size)
    for (_, _, measured, _), pose in zip(stream, ds.poses(8), strict=True):
        again = single.update(measured, pose)
    filtered = stream[-1][3]
    assert (again.inverse.numpy() == filtered.inverse.numpy()).all()
    assert (again.normal.numpy() == filtered.normal.numpy()).all()
