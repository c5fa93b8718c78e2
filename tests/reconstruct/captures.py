"""The truth of simulated captures, and where real ones lie."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warp_dvct.scene import Role, Scene

DATA = Path(__file__).parents[3] / "shared" / "data" / "captures"


def real_triangles(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, triangles and base colour per triangle of a scene's real part."""
    points, triangles, colors, count = [], [], [], 0
    for mesh in scene.meshes:
        if mesh.role == Role.REAL:
            points.append(mesh.points)
            triangles.append(mesh.triangles + count)
            colors.append(np.array([scene.materials[k].base_color for k in mesh.materials]))
            count += len(mesh.points)
    return np.concatenate(points), np.concatenate(triangles), np.concatenate(colors)


def nearest(scene: Scene, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance in metres of points from a scene's real surface, and the base colour there."""
    from warp_dvct.capture.fusion import open3d_for_reconstruction

    o3d = open3d_for_reconstruction(2)
    corners, triangles, colors = real_triangles(scene)
    tensor = o3d.core.Tensor
    cast = o3d.t.geometry.RaycastingScene()
    cast.add_triangles(tensor(corners.astype(np.float32)), tensor(triangles.astype(np.uint32)))
    found = cast.compute_closest_points(tensor(np.ascontiguousarray(points, np.float32)))
    return np.linalg.norm(found["points"].numpy() - points, axis=-1), colors[found["primitive_ids"].numpy()]
