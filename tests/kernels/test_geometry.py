"""Ray queries, ray offsets and camera rays, against brute force and closed forms."""

import numpy as np
import pytest
import warp as wp

from warp_dvct.device_scene import DeviceScene
from warp_dvct.errors import StageError
from warp_dvct.kernels.geometry import (
    FAR,
    CameraFrame,
    Geometry,
    camera_depth,
    camera_project,
    camera_ray,
    occluded_by_real,
    occluded_by_synthetic,
    offset_point,
    trace_all,
    trace_real,
    trace_synthetic,
)
from warp_dvct.scene import Camera, Material, Mesh, Role, Scene

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

CAMERA = Camera(np.eye(4), -0.5, 0.5, -0.5, 0.5)


@wp.kernel
def _query_rays(
    first: int,
    geo: Geometry,
    origin_in: wp.array(dtype=wp.vec3),
    direction_in: wp.array(dtype=wp.vec3),
    t_max: float,
    triangle_out: wp.array2d(dtype=int),
    t_out: wp.array2d(dtype=float),
    weights_out: wp.array(dtype=wp.vec2),
    occluded_out: wp.array2d(dtype=int),
):
    i = first + wp.tid()
    o = origin_in[i]
    d = direction_in[i]
    real = trace_real(geo, o, d, t_max)
    synthetic = trace_synthetic(geo, o, d, t_max)
    nearest = trace_all(geo, o, d, t_max)
    triangle_out[i, 0] = wp.where(real.found == 1, real.triangle, -1)
    triangle_out[i, 1] = wp.where(synthetic.found == 1, synthetic.triangle, -1)
    triangle_out[i, 2] = wp.where(nearest.found == 1, nearest.triangle, -1)
    t_out[i, 0] = real.t
    t_out[i, 1] = synthetic.t
    t_out[i, 2] = nearest.t
    weights_out[i] = wp.vec2(nearest.u, nearest.v)
    occluded_out[i, 0] = wp.where(occluded_by_real(geo, o, d, t_max), 1, 0)
    occluded_out[i, 1] = wp.where(occluded_by_synthetic(geo, o, d, t_max), 1, 0)


@wp.kernel
def _leave_surface(
    first: int,
    geo: Geometry,
    point_in: wp.array(dtype=wp.vec3),
    normal_in: wp.array(dtype=wp.vec3),
    direction_in: wp.array(dtype=wp.vec3),
    t_out: wp.array(dtype=float),
):
    i = first + wp.tid()
    t_out[i] = trace_all(geo, offset_point(point_in[i], normal_in[i]), direction_in[i], FAR).t


@wp.kernel
def _shoot_camera(
    first: int,
    cam: CameraFrame,
    width: int,
    height: int,
    pixel_in: wp.array(dtype=wp.vec2),
    origin_out: wp.array(dtype=wp.vec3),
    direction_out: wp.array(dtype=wp.vec3),
    t_max_out: wp.array(dtype=float),
    projected_out: wp.array(dtype=wp.vec3),
    depth_out: wp.array(dtype=float),
):
    i = first + wp.tid()
    ray = camera_ray(cam, pixel_in[i][0], pixel_in[i][1], width, height)
    p = ray.origin + ray.direction * 2.0
    origin_out[i] = ray.origin
    direction_out[i] = ray.direction
    t_max_out[i] = ray.t_max
    projected_out[i] = camera_project(cam, p, width, height)
    depth_out[i] = camera_depth(cam, p)


def mesh(triangles, role, **more):
    """A mesh from loose triangles [t, 3, 3]."""
    count = len(triangles)
    indices = np.arange(3 * count, dtype=np.int32).reshape(-1, 3)
    return Mesh(np.asarray(triangles, float).reshape(-1, 3), indices, np.zeros(count, np.int32), role, **more)


def upload(launcher, *meshes, origin=(0, 0, 0), scale=1.0, camera=CAMERA):
    return DeviceScene.upload(launcher, Scene(meshes, (Material(),), (), (), camera), np.array(origin, float), scale)


def query(launcher, scene, origins, directions, t_max=float(FAR)):
    n = len(origins)
    out = [launcher.empty((n, 3), wp.int32), launcher.empty((n, 3), wp.float32)]
    out += [launcher.empty(n, wp.vec2), launcher.empty((n, 2), wp.int32)]
    rays = [launcher.array(np.asarray(a, np.float32), wp.vec3) for a in (origins, directions)]
    launcher.launch(_query_rays, n, [scene.geometry, *rays, t_max], out)
    return [o.numpy() for o in out]


def brute_force(triangles, origins, directions):
    """Moeller-Trumbore in float64: (nearest triangle or -1, distance or inf) per ray."""
    a, e1, e2 = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    d, o = directions[:, None], origins[:, None]
    p = np.cross(d, e2)
    det = (e1 * p).sum(-1)
    s = o - a
    u = (s * p).sum(-1) / det
    q = np.cross(s, np.broadcast_to(e1, s.shape))
    v = (d * q).sum(-1) / det
    t = (e2 * q).sum(-1) / det
    t = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, np.inf)
    nearest = t.argmin(1)
    return np.where(np.isfinite(t.min(1)), nearest, -1), t.min(1)


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def test_rays_agree_with_brute_force(launcher):
    rng = np.random.default_rng(5)
    soup = rng.uniform(-1, 1, (500, 1, 3)) + rng.uniform(-0.3, 0.3, (500, 3, 3))
    real, synthetic = soup[:300], soup[300:]
    # Given synthetic first: the upload has to put real triangles in front.
    scene = upload(launcher, mesh(synthetic, Role.SYNTHETIC), mesh(real, Role.REAL))
    origins, directions = rng.uniform(-2, 2, (2000, 3)), unit(rng.normal(size=(2000, 3)))
    triangle, t, weights, occluded = query(launcher, scene, origins, directions)
    expected = [brute_force(s, origins, directions) for s in (real, synthetic, soup)]
    for column, (index, distance) in enumerate(expected):
        hit = index >= 0
        assert 0.1 < hit.mean() < 0.99
        offset = 300 if column == 1 else 0
        agree = triangle[:, column] == np.where(hit, index + offset, -1)
        assert agree.mean() > 0.995  # an edge may go either way in float32
        np.testing.assert_allclose(t[hit & agree, column], distance[hit & agree], rtol=1e-4)
    np.testing.assert_array_equal(occluded, triangle[:, :2] >= 0)
    hit = triangle[:, 2] >= 0
    corners = scene.triangles_vs[triangle[hit, 2]]
    w = np.concatenate([weights[hit], 1 - weights[hit].sum(1, keepdims=True)], 1)
    point = (corners * w[..., None]).sum(1)
    np.testing.assert_allclose(point, origins[hit] + directions[hit] * t[hit, 2:], atol=1e-5)


def test_a_ray_ends_at_its_length(launcher):
    wall = np.array([[[-9, -9, -1], [9, -9, -1], [0, 9, -1]]])
    scene = upload(launcher, mesh(wall, Role.REAL), mesh(wall * [1, 1, 2], Role.SYNTHETIC))
    origins, directions = np.zeros((1, 3)), np.array([[0, 0, -1.0]])
    for t_max, found in ((0.9, [-1, -1, -1]), (1.5, [0, -1, 0]), (2.5, [0, 1, 0])):
        triangle, _, _, occluded = query(launcher, scene, origins, directions, t_max)
        assert triangle[0].tolist() == found
        assert occluded[0].tolist() == [int(i >= 0) for i in found[:2]]


@pytest.mark.parametrize("role", list(Role))
def test_a_scene_of_one_role_is_never_hit_by_rays_for_the_other(launcher, role):
    scene = upload(launcher, mesh([[[-9, -9, -1], [9, -9, -1], [0, 9, -1]]], role))
    triangle, _, _, occluded = query(launcher, scene, np.zeros((1, 3)), np.array([[0, 0, -1.0]]))
    assert triangle[0].tolist() == ([0, -1, 0] if role == Role.REAL else [-1, 0, 0])
    assert occluded[0].tolist() == [int(role == Role.REAL), int(role == Role.SYNTHETIC)]


def sphere(n=24):
    """A closed sphere of quads split in two, with fans at the poles."""
    theta, phi = np.linspace(0, np.pi, n + 1), np.linspace(0, 2 * np.pi, 2 * n + 1)
    p = np.stack([np.outer(np.sin(theta), np.cos(phi)), np.outer(np.sin(theta), np.sin(phi))], -1)
    p = np.concatenate([p, np.repeat(np.cos(theta)[:, None, None], 2 * n + 1, 1)], -1)
    p[:, -1] = p[:, 0]
    a, b, c, d = p[:-1, :-1], p[1:, :-1], p[1:, 1:], p[:-1, 1:]
    first, second = np.stack([a, b, c], -2)[:, :], np.stack([a, c, d], -2)
    return np.concatenate(
        [first[1:].reshape(-1, 3, 3) * 1.0, first[:1].reshape(-1, 3, 3), second[1:].reshape(-1, 3, 3)]
    )


def test_no_ray_slips_out_of_a_closed_surface(launcher):
    scene = upload(launcher, mesh(sphere(), Role.REAL))
    rng = np.random.default_rng(0)
    directions = unit(rng.normal(size=(20000, 3)))
    # Aim a quarter of the rays exactly at edges, where a leak would show first. (At vertices Warp 1.19's box test,
    # which is not conservative, loses about 1 % of the rays that are aimed at them.)
    corners = scene.triangles_vs.astype(np.float64)
    aims = np.concatenate([corners[:, 0] * w + corners[:, 1] * (1 - w) for w in (0.5, 0.3, 0.01)])
    origins = rng.uniform(-0.4, 0.4, (20000, 3)).astype(np.float32).astype(np.float64)
    directions[:5000] = unit(aims[rng.integers(0, len(aims), 5000)] - origins[:5000])
    triangle, _, _, _ = query(launcher, scene, origins, directions)
    assert (triangle[:, 0] < 0).sum() == 0


@pytest.mark.parametrize(("centre", "size"), [((0, 0, 0), 1.0), ((7, -30, 12), 1.0), ((0.5, 0.5, 0.5), 0.01)])
def test_an_offset_point_does_not_meet_its_own_surface(launcher, centre, size):
    rng = np.random.default_rng(2)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    flat = np.array([[[-1, -1, 0], [1, -1, 0], [1, 1, 0]], [[-1, -1, 0], [1, 1, 0], [-1, 1, 0]]], float)
    scene = upload(launcher, mesh(flat @ turn * size + centre, Role.REAL))
    corners = scene.triangles_vs
    normal = np.cross(corners[0, 1] - corners[0, 0], corners[0, 2] - corners[0, 0]).astype(np.float64)
    normal /= np.linalg.norm(normal)
    weights = rng.dirichlet([1, 1, 1], 5000).astype(np.float32)
    points = (corners[rng.integers(0, 2, 5000)] * weights[..., None]).sum(1)
    directions = unit(rng.normal(size=(5000, 3)))
    directions *= np.sign(directions @ normal)[:, None]
    directions[:1000] = unit(directions[:1000] + normal * (1e-3 - directions[:1000] @ normal)[:, None])  # grazing
    t = launcher.empty(5000, wp.float32)
    rays = [np.asarray(a, np.float32) for a in (points, np.broadcast_to(normal, (5000, 3)), directions)]
    launcher.launch(_leave_surface, 5000, [scene.geometry, *(launcher.array(a, wp.vec3) for a in rays)], [t])
    assert (t.numpy() < 1e17).sum() == 0


def test_upload_moves_points_in_float64(launcher):
    far = 1.0e7  # float32 metres are a metre apart here
    triangle = np.array([[[0, 0, 0], [0.25, 0, 0], [0, 0.25, 0]]])
    scene = upload(launcher, mesh(triangle + far, Role.REAL), origin=(far, far, far), scale=4.0)
    np.testing.assert_array_equal(scene.triangles_vs, triangle * 4.0)


def test_upload_names_the_mesh_with_a_wrong_index(launcher):
    bad = Mesh(np.zeros((3, 3)), np.array([[0, 1, 3]], np.int32), np.zeros(1, np.int32), Role.REAL, path="/World/Bad")
    with pytest.raises(StageError, match=r"/World/Bad: point index 3 "):
        upload(launcher, bad)
    bad = Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]], np.int32), np.full(1, 4, np.int32), Role.REAL, path="/World/Bad")
    with pytest.raises(StageError, match=r"/World/Bad: material index 4 "):
        upload(launcher, bad)
    with pytest.raises(ValueError, match="scale is 0"):
        upload(launcher, scale=0.0)


def test_camera_rays_pass_the_pixels_and_keep_to_the_clipping_range(launcher):
    rng = np.random.default_rng(3)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    to_world = np.eye(4)
    to_world[:3, :3], to_world[:3, 3] = turn, (3, -2, 5)
    camera = Camera(to_world, -0.3, 0.5, -0.2, 0.4, near=0.5, far=20.0)
    scene = upload(launcher, mesh(sphere(4), Role.REAL), origin=(1, 1, 1), scale=0.5, camera=camera)
    pixels = np.concatenate([[[0, 0], [64, 48], [64, 0]], rng.uniform(0, 1, (50, 2)) * [64, 48]]).astype(np.float32)
    out = [launcher.empty(len(pixels), t) for t in (wp.vec3, wp.vec3, wp.float32, wp.vec3, wp.float32)]
    launcher.launch(_shoot_camera, len(pixels), [scene.camera, 64, 48, launcher.array(pixels, wp.vec2)], out)
    origin, direction, t_max, projected, depth = (o.numpy().astype(np.float64) for o in out)
    through = np.stack([-0.3 + 0.8 * pixels[:, 0] / 64, 0.4 - 0.6 * pixels[:, 1] / 48, -np.ones(len(pixels))], 1)
    stretch = np.linalg.norm(through, axis=1, keepdims=True)
    expected_origin = ((3, -2, 5) - np.ones(3)) * 0.5 + through @ turn.T * 0.25
    np.testing.assert_allclose(direction, through / stretch @ turn.T, atol=1e-6)
    np.testing.assert_allclose(origin, expected_origin, atol=1e-6)
    np.testing.assert_allclose(t_max, 19.5 * 0.5 * stretch[:, 0], rtol=1e-6)
    np.testing.assert_allclose(projected[:, :2], pixels, atol=1e-4)
    np.testing.assert_allclose(projected[:, 2], 0.25 + 2 / stretch[:, 0], rtol=1e-6)
    np.testing.assert_allclose(depth, projected[:, 2], rtol=1e-6)
