"""The scene as plain data: NumPy arrays in metres and float64; no USD, no Warp.

World space is right-handed and in metres. Colours and radiometric quantities are linear Rec.709. Readers
(``warp_dvct.usd``) produce a :class:`Scene`; plans and methods consume it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np


class Role(IntEnum):
    """Whether geometry exists in the photographed scene or is inserted into it."""

    REAL = 0
    SYNTHETIC = 1


class LightRole(IntEnum):
    """A plate light already lights the photograph; an added light is new, so its light is all delta."""

    PLATE = 0
    ADDED = 1


class LightKind(IntEnum):
    """Emitter shapes. The values are shared with ``kernels/lights.py``."""

    POINT = 0
    SPHERE = 1
    RECT = 2
    DISK = 3
    DISTANT = 4
    DOME = 5


class Wrap(IntEnum):
    """Texture addressing outside [0, 1]; BLACK returns zero."""

    REPEAT = 0
    CLAMP = 1
    MIRROR = 2
    BLACK = 3


@dataclass(frozen=True)
class Texture:
    """An image used by a material.

    Attributes:
        pixels: Linear values with ``scale`` and ``bias`` already applied, float32, shape ``[h, w, 3]``; row 0 is the
            image's top, which is v = 1 in USD texture coordinates. A scalar map repeats its value in all channels.
        wrap_s, wrap_t: Addressing along u and v.
        name: Where it came from, for messages.
    """

    pixels: np.ndarray
    wrap_s: Wrap = Wrap.REPEAT
    wrap_t: Wrap = Wrap.REPEAT
    name: str = ""


@dataclass(frozen=True)
class Material:
    """UsdPreviewSurface reduced to Lambert + GGX.

    The BRDF is ``base_color * (1 - metallic) / pi * (1 - F(n.l)) (1 - F(n.v))`` plus a GGX lobe with Schlick Fresnel.
    In the metallic workflow ``f0 = lerp(((ior - 1) / (ior + 1))**2, base_color, metallic)``; in the specular workflow
    ``f0 = specular_color`` and ``metallic`` is 0. Grazing reflectance is ``min(50 * max(f0), 1)``, so ``f0 = 0`` is a
    pure Lambert surface.

    Attributes:
        base_color: Diffuse albedo (or metal reflectance), linear RGB in [0, 1].
        metallic: In [0, 1].
        roughness: Perceptual roughness in [0, 1]; the GGX alpha is its square.
        ior: Index of refraction of a dielectric; 1 means no specular reflection.
        specular_color: F0 of the specular workflow, or None for the metallic workflow.
        base_color_texture, roughness_texture: Indices into ``Scene.textures``; they replace the constant value.
        name: Prim path.
    """

    base_color: tuple[float, float, float] = (0.18, 0.18, 0.18)
    metallic: float = 0.0
    roughness: float = 0.5
    ior: float = 1.5
    specular_color: tuple[float, float, float] | None = None
    base_color_texture: int | None = None
    roughness_texture: int | None = None
    name: str = ""

    @property
    def reflects(self) -> bool:
        """Whether it has a specular lobe."""
        if self.specular_color is not None:
            return max(self.specular_color) > 0.0
        return self.ior != 1.0 or self.metallic > 0.0


@dataclass(frozen=True)
class Mesh:
    """Triangles of one prim, in world space; counter-clockwise seen from the front.

    Attributes:
        points: float64, shape ``[v, 3]``, metres.
        triangles: int32, shape ``[t, 3]``.
        materials: Index into ``Scene.materials`` per triangle, int32, shape ``[t]``.
        role: Real or synthetic.
        double_sided: False where only the front is meant to be seen: the voxelisation then stores the front alone.
        corner_normals: Unit shading normals per triangle corner, float32, ``[t, 3, 3]``; None for faceted.
        corner_uvs: Texture coordinates per corner, float32, ``[t, 3, 2]``; None where nothing needs them.
        corner_colors: Multiplied into the material's base colour, float32 ``[t, 3, 3]``; None for white.
        path: Prim path (of the instance), for messages and statistics.
        scanned: The triangles stand for the points of a cloud, which imperfect shadow maps take instead of them.
    """

    points: np.ndarray
    triangles: np.ndarray
    materials: np.ndarray
    role: Role
    double_sided: bool = False
    corner_normals: np.ndarray | None = None
    corner_uvs: np.ndarray | None = None
    corner_colors: np.ndarray | None = None
    path: str = ""
    scanned: bool = False


@dataclass(frozen=True)
class PointCloud:
    """Points of one prim, as a scan has them, in world space: each stands for a disc of surface.

    Attributes:
        points: float64, shape ``[n, 3]``, metres.
        normals: Unit normals, float32 ``[n, 3]``; of arbitrary sign where they were estimated (then double-sided).
        radii: Of the discs, metres, positive, float32 ``[n]``: half of UsdGeom's widths.
        role: Real or synthetic.
        material: Index into ``Scene.materials``; without textures, as points have no coordinates.
        colors: Multiplied into the material's base colour, float32 ``[n, 3]``; None for white.
        double_sided: Whether both sides of the discs are meant to be seen.
        path: Prim path (of the instance), for messages and statistics.
    """

    points: np.ndarray
    normals: np.ndarray
    radii: np.ndarray
    role: Role
    material: int = 0
    colors: np.ndarray | None = None
    double_sided: bool = False
    path: str = ""


@dataclass(frozen=True)
class Light:
    """An emitter; UsdLux semantics already resolved.

    Attributes:
        kind: Shape.
        radiance: Emitted radiance [W m^-2 sr^-1], linear RGB: intensity * 2**exposure * color * blackbody, after
            ``normalize``. For POINT it is radiant intensity [W sr^-1]; for DISTANT the radiance of the disc of half
            angle ``angle / 2``, or, where ``angle`` is 0, the irradiance [W m^-2] on a plane facing it; for DOME the
            factor of ``texture``.
        position: Centre in world metres (POINT, SPHERE, RECT, DISK).
        axis_x, axis_y: RECT: half edges in metres; DISK: the two radius vectors (both in metres, they may differ
            under non-uniform scale).
        direction: Unit direction in which RECT and DISK emit (their -Z), DISTANT light travels, or a spot's axis.
        radius: SPHERE radius in metres.
        angle: DISTANT: full angle of the disc [rad].
        cone_angle: Spot: half angle [rad] outside which nothing is emitted; pi for no spot.
        cone_softness: Spot: the fraction [0, 1] of the cone angle over which the edge falls off (smoothstep).
        texture: DOME: lat-long radiance, float32 ``[h, w, 3]``, laid out as UsdLux says (image centre = +Z, a quarter
            in from the left = +X, top row = +Y in the light's space); None for a constant dome.
        rotation: DOME: 3x3, from the light's space to the world.
        role: Plate or added.
        path: Prim path.
    """

    kind: LightKind
    radiance: tuple[float, float, float]
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    axis_x: tuple[float, float, float] = (0.0, 0.0, 0.0)
    axis_y: tuple[float, float, float] = (0.0, 0.0, 0.0)
    direction: tuple[float, float, float] = (0.0, 0.0, -1.0)
    radius: float = 0.0
    angle: float = 0.0
    cone_angle: float = float(np.pi)
    cone_softness: float = 0.0
    texture: np.ndarray | None = None
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    role: LightRole = LightRole.PLATE
    path: str = ""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera.

    Attributes:
        to_world: 4x4 float64, column vectors (``p_ws = to_world @ p_cs``), rigid; looks along -z, y up.
        tan_left, tan_right, tan_bottom, tan_top: The image's edges on the plane at distance 1 (left and bottom are
            negative for a centred camera): aperture offsets are in here.
        near, far: Clipping range in metres.
        path: Prim path.
        distortion: Of its lens, OpenCV's coefficients (``warp_dvct.lens``); the edges are those of the bent image.
    """

    to_world: np.ndarray
    tan_left: float
    tan_right: float
    tan_bottom: float
    tan_top: float
    near: float = 0.0
    far: float = float("inf")
    path: str = ""
    distortion: tuple[float, ...] = ()

    @property
    def aspect(self) -> float:
        """Width over height."""
        return (self.tan_right - self.tan_left) / (self.tan_top - self.tan_bottom)


@dataclass(frozen=True)
class Notice:
    """Something that was met and is not modelled: reported once per prim path."""

    path: str
    message: str

    def __str__(self) -> str:
        return f"{self.path}: {self.message}"


def _used_points(mesh: Mesh) -> np.ndarray:
    """Those that a triangle has for a corner, each once."""
    used = np.zeros(len(mesh.points), bool)
    used[mesh.triangles.ravel()] = True
    return mesh.points if used.all() else mesh.points[used]


@dataclass(frozen=True)
class Scene:
    """Everything that a picture needs, at one time code.

    Attributes:
        captured: The real scene is what a depth camera saw: pixels without real surface are holes, not background.
    """

    meshes: tuple[Mesh, ...]
    materials: tuple[Material, ...]
    textures: tuple[Texture, ...]
    lights: tuple[Light, ...]
    camera: Camera
    plate: str | None = None
    notices: tuple[Notice, ...] = ()
    point_clouds: tuple[PointCloud, ...] = ()
    captured: bool = False

    def bounds(self, role: Role | None = None) -> tuple[np.ndarray, np.ndarray] | None:
        """Axis-aligned bounds (low, high) in metres of the geometry of a role, or of all; None where there is none."""
        points = [_used_points(m) for m in self.meshes if role is None or m.role == role]
        points += [c.points for c in self.point_clouds if role is None or c.role == role]
        points = [p for p in points if len(p)]
        if not points:
            return None
        # Column by column: NumPy's minimum over the rows of [n, 3] takes ten times as long.
        low = np.array([min(p[:, k].min() for p in points) for k in range(3)])
        return low, np.array([max(p[:, k].max() for p in points) for k in range(3)])
