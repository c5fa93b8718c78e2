"""The small scene that twins and kernels both see: a closed room with a shiny pyramid in it, and its float64 twin."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp

from warp_dvct.bench.twins.numbers import dot, unit
from warp_dvct.device_scene import DeviceScene
from warp_dvct.scene import Camera, Light, LightKind, Material, Mesh, Role, Scene

MATERIALS = (
    Material(base_color=(0.6, 0.5, 0.4), ior=1.0),
    Material(base_color=(0.3, 0.5, 0.7), roughness=0.5, ior=1.5),
)
POINT = Light(LightKind.POINT, (1.0, 0.9, 0.8), position=(0.35, 0.81, 0.57))
LAMP = Light(
    LightKind.RECT,
    (5.0, 6.0, 7.0),
    position=(0.5, 0.85, 0.5),
    axis_x=(0.11, 0.0, 0.02),
    axis_y=(-0.02, 0.0, 0.12),
    direction=(0.0, -1.0, 0.0),
)
SUN = Light(LightKind.DISTANT, (2.0, 2.0, 1.5), direction=(0.36, -0.8, 0.48))


def _mesh(points: Any, triangles: Any, role: Role, material: int) -> Mesh:
    return Mesh(
        np.asarray(points, float), np.asarray(triangles, np.int32), np.full(len(triangles), material, np.int32), role
    )


def make_scene(*lights: Light, closed: bool = True) -> Scene:
    """Walls 0.8 wide, slightly turned so that nothing lies on voxel planes; open: the floor alone."""
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float) * 0.4
    a = 0.2
    turn = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    quads = [(0, 4, 5, 1), (2, 3, 7, 6), (0, 1, 3, 2), (4, 6, 7, 5), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [t for q in (quads if closed else quads[:1]) for t in ((q[0], q[2], q[1]), (q[0], q[3], q[2]))]
    tip = np.array([(0.4, 0.11, 0.35), (0.66, 0.11, 0.42), (0.48, 0.11, 0.62), (0.52, 0.42, 0.47)])
    faces = [(0, 1, 2), (0, 3, 1), (1, 3, 2), (2, 3, 0)]
    to_world = np.eye(4)
    to_world[:3, 3] = (0.5, 0.55, 0.85)
    camera = Camera(to_world, -0.71, 0.7, -0.92, 0.4)
    meshes = (_mesh(corners @ turn.T + 0.5, triangles, Role.REAL, 0), _mesh(tip, faces, Role.SYNTHETIC, 1))
    return Scene(meshes, MATERIALS, (), lights, camera)


@dataclass(frozen=True)
class Twin:
    """The uploaded scene's own numbers (its float32 corners) in float64, and brute-force rays against them.

    Attributes:
        scene: As given. device: As the kernels see it. corners: ``[t, 3, 3]``, real triangles first.
    """

    scene: Scene
    device: DeviceScene
    corners: np.ndarray

    @staticmethod
    def upload(launcher: Any, scene: Scene) -> Twin:
        """Volume space is world space."""
        device = DeviceScene.upload(launcher, scene, np.zeros(3), 1.0)
        return Twin(scene, device, device.triangles_vs.astype(np.float64))

    @cached_property
    def normals(self) -> np.ndarray:
        """Unit, ``[t, 3]``."""
        return unit(np.cross(self.corners[:, 1] - self.corners[:, 0], self.corners[:, 2] - self.corners[:, 0]))

    @property
    def reals(self) -> int:
        """How many triangles are real."""
        return self.device.synthetic_first

    def device_normals(self, launcher: Any) -> Any:
        """The normals for kernels."""
        return launcher.array(self.normals.astype(np.float32), wp.vec3)

    def nearest(self, origin: np.ndarray, direction: np.ndarray, which: slice) -> tuple[np.ndarray, np.ndarray]:
        """Distance (inf where there is none) and index of the first triangle of a slice that each ray meets.

        Moeller and Trumbore 1997.
        """
        a, b, c = (self.corners[which, k] for k in range(3))
        e1, e2 = b - a, c - a
        p = np.cross(direction[:, None], e2[None])
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = 1.0 / dot(e1[None], p)
            s = origin[:, None] - a[None]
            u = dot(s, p) * scale
            q = np.cross(s, e1[None])
            v = dot(direction[:, None], q) * scale
            t = dot(e2[None], q) * scale
        t = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, np.inf)
        first = t.argmin(1)
        return t[np.arange(len(t)), first], first + (which.start or 0)

    @property
    def real(self) -> slice:
        """Real triangles."""
        return slice(0, self.reals)

    @property
    def synthetic(self) -> slice:
        """Synthetic triangles."""
        return slice(self.reals, len(self.corners))

    def spawn(self, position: np.ndarray, triangle: np.ndarray, facing: np.ndarray) -> np.ndarray:
        """Ray origins off their triangles, towards ``facing`` normals, as ``materials.spawn_point`` moves them."""
        reach = np.abs(self.corners[triangle]).max((1, 2))
        return position + facing * (2.0e-6 * reach)[:, None]
