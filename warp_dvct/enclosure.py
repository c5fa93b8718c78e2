"""Synthetic surfaces cut to the closed room that the camera is in: what is beyond its walls neither shows nor lights.

Volumes, shadow maps and points follow the size of the synthetic objects. A synthetic ground a thousand times as wide as
the room would make them as coarse; the part of it in the room is all that matters.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from warp_dvct.scene import Camera, Mesh, Role, Scene

CLOSED = 1e-3  # how far from a whole number a closed surface's winding number may be
MARGIN = 1e-3  # of the room's size: what reaches no farther out of its bounds is left as it is
BLOCK = 1 << 20  # triangles whose solid angles are found at a time


def within_enclosure(scene: Scene) -> Scene:
    """The scene with its synthetic triangles cut to the real surfaces' bounds, where these enclose the camera.

    They do where every corner of the near plane (the eye, where it is at 0) has a winding number other than 0 and a
    whole one, as inside of closed meshes, whichever way they face. Scans with holes do not. Triangles inside of the
    bounds stay as they are; others are cut, and their attributes interpolated. What a depth camera saw of one frame
    encloses nothing.
    """
    real, synthetic = (_bounds_of_points(scene, role) for role in (Role.REAL, Role.SYNTHETIC))
    if real is None or synthetic is None or scene.captured:
        return scene
    margin = MARGIN * float(np.max(real[1] - real[0]))
    low, high = real[0] - margin, real[1] + margin
    if (np.all(synthetic[0] >= low) and np.all(synthetic[1] <= high)) or not _encloses(scene, low, high):
        return scene
    meshes = (mesh if mesh.role == Role.REAL else cut_to(mesh, low, high) for mesh in scene.meshes)
    clouds = []
    for cloud in scene.point_clouds:
        inside = np.all((cloud.points >= low) & (cloud.points <= high), 1)
        if cloud.role == Role.SYNTHETIC and not inside.all():
            colors = None if cloud.colors is None else cloud.colors[inside]
            cloud = replace(
                cloud,
                points=cloud.points[inside],
                normals=cloud.normals[inside],
                radii=cloud.radii[inside],
                colors=colors,
            )
        clouds.append(cloud)
    return replace(
        scene,
        meshes=tuple(m for m in meshes if len(m.triangles)),
        point_clouds=tuple(c for c in clouds if len(c.points)),
    )


def _bounds_of_points(scene: Scene, role: Role) -> tuple[np.ndarray, np.ndarray] | None:
    """Bounds of all points of a role's meshes, whether or not a triangle uses them: this runs for every frame."""
    points = [m.points for m in scene.meshes if m.role == role and len(m.triangles)]
    if not points:
        return None
    low = np.array([min(p[:, k].min() for p in points) for k in range(3)])
    return low, np.array([max(p[:, k].max() for p in points) for k in range(3)])


def _encloses(scene: Scene, low: np.ndarray, high: np.ndarray) -> bool:
    eyes = _near_corners(scene.camera)
    if not np.all((eyes > low) & (eyes < high)):
        return False
    real = [m for m in scene.meshes if m.role == Role.REAL]
    for eye in eyes:
        winding = sum(winding_number(m, eye) for m in real)
        if round(winding) == 0 or abs(winding - round(winding)) > CLOSED:
            return False
    return True


def _near_corners(camera: Camera) -> np.ndarray:
    """Where camera rays begin, world metres: ``[4, 3]``, or ``[1, 3]`` where all begin at the eye."""
    eye = camera.to_world[:3, 3]
    if camera.near <= 0.0:
        return eye[None]
    edges = [(x, y) for x in (camera.tan_left, camera.tan_right) for y in (camera.tan_bottom, camera.tan_top)]
    local = np.array([(x, y, -1.0) for x, y in edges]) * camera.near
    return eye + local @ camera.to_world[:3, :3].T


def winding_number(mesh: Mesh, point: np.ndarray) -> float:
    """How often a mesh goes around a point: its signed solid angle over 4 pi (Van Oosterom and Strackee 1983)."""
    total = 0.0
    for first in range(0, len(mesh.triangles), BLOCK):
        corners = mesh.points[mesh.triangles[first : first + BLOCK]] - point
        a, b, c = (corners[:, k] for k in range(3))
        la, lb, lc = (np.linalg.norm(x, axis=-1) for x in (a, b, c))
        volume = np.einsum("ij,ij->i", a, np.cross(b, c))
        ab, ac, bc = (np.einsum("ij,ij->i", x, y) for x, y in ((a, b), (a, c), (b, c)))
        total += float(np.arctan2(volume, la * lb * lc + ab * lc + ac * lb + bc * la).sum())
    return total / (2.0 * math.pi)


def cut_to(mesh: Mesh, low: np.ndarray, high: np.ndarray) -> Mesh:
    """A mesh without what lies outside of a box: triangles that cross its border are cut there (Sutherland and Hodgman
    1974), those inside keep their corners to the bit."""
    corners = mesh.points[mesh.triangles]
    outside = np.any((corners < low) | (corners > high), (1, 2))
    if not outside.any():
        return mesh
    parent = np.flatnonzero(outside)
    weights = np.tile(np.eye(3), (len(parent), 1, 1))
    for axis in range(3):
        for sign, bound in ((-1.0, -low[axis]), (1.0, high[axis])):
            depth = bound - sign * np.einsum("nck,nk->nc", weights, corners[parent][:, :, axis])
            parent, weights = _cut(parent, weights, depth)
    keep = np.concatenate([np.flatnonzero(~outside), parent])
    weights = np.concatenate([np.tile(np.eye(3), (int((~outside).sum()), 1, 1)), weights])

    def at_corners(values: np.ndarray | None) -> np.ndarray | None:
        return None if values is None else np.einsum("nck,nkd->ncd", weights, values[keep]).astype(values.dtype)

    normals = at_corners(mesh.corner_normals)
    if normals is not None:
        size = np.linalg.norm(normals, axis=-1, keepdims=True)
        normals = np.where(size > 0.0, normals / np.where(size > 0.0, size, 1.0), 0.0).astype(np.float32)
    return replace(
        mesh,
        points=np.einsum("nck,nkd->ncd", weights, corners[keep]).reshape(-1, 3),
        triangles=np.arange(3 * len(keep), dtype=np.int32).reshape(-1, 3),
        materials=mesh.materials[keep],
        corner_normals=normals,
        corner_uvs=at_corners(mesh.corner_uvs),
        corner_colors=at_corners(mesh.corner_colors),
    )


def _cut(parent: np.ndarray, weights: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut pieces ``[n, 3 corners, 3 weights]`` where ``depth`` of their corners ``[n, 3]`` falls below 0."""
    inside = depth >= 0.0
    count = inside.sum(1)
    parents, pieces = [parent[count == 3]], [weights[count == 3]]
    for members, odd in ((count == 1, True), (count == 2, False)):
        # The corner that is alone on its side comes first.
        first = np.argmax(inside[members] == odd, 1)
        order = (first[:, None] + np.arange(3)) % 3
        w = np.take_along_axis(weights[members], order[:, :, None], 1)
        d = np.take_along_axis(depth[members], order, 1)
        a, b, c = w[:, 0], w[:, 1], w[:, 2]
        ab = a + (b - a) * (d[:, 0] / (d[:, 0] - d[:, 1]))[:, None]
        ac = a + (c - a) * (d[:, 0] / (d[:, 0] - d[:, 2]))[:, None]
        for corners in ((a, ab, ac),) if odd else ((ab, b, c), (ab, c, ac)):
            parents.append(parent[members])
            pieces.append(np.stack(corners, 1))
    return np.concatenate(parents), np.concatenate(pieces)
