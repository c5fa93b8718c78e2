"""One small scene in all its extremes, every method on it, and the numbers that come out before they become halves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import lit_scenes as lit
import numpy as np

import warp_dvct.relighter as relighter_module
from warp_dvct.layers import Layers
from warp_dvct.relighter import Relighter
from warp_dvct.scene import Camera, Light, LightKind, Material, Mesh, Role, Scene

WIDTH, HEIGHT = 32, 24
COARSE = {
    "volume.resolution": 32,
    "volume.coarse": 24,
    "rsm.texels": 64,
    "gather.rays": 16,
    "gather.stride": 4,
    "gather.object_rays": 16,
    "shadows.samples": 4,
    "shadows.probes": 4,
    "glossy.rays": 2,
    "patches.count": 256,
    "patches.rays": 16,
    "antialias": 2,
    "bounces": 3,
    "vpls.count": 48,
    "vpls.further": 24,
    "vpls.sky": 32,
    "vpls.map": 48,
    "ism.size": 32,
    "ism.points": 128,
    "ism.blocks": 4,
    "samples": 16,
}
# The method, and what makes it another one.
METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    "rays": ("delta-cones", {}),
    "cones": ("delta-cones", {"gather": "cones", "shadows": "cone", "glossy": "cones"}),
    "ism": ("instant-radiosity", {"visibility": "ism"}),
    "vpl-rays": ("instant-radiosity", {"visibility": "ray"}),
    "path": ("path-trace", {}),
}
FAST_METHODS = ("rays", "cones", "vpl-rays", "path")  # ism draws its maps anew for every scene, for most of the time

WHITE = Material(base_color=(0.7, 0.7, 0.7), ior=1.0)
RED = Material(base_color=(0.7, 0.2, 0.1), ior=1.0)
SHINY = Material(base_color=(0.4, 0.5, 0.6), roughness=0.3)


def lamp(**more: Any) -> Light:
    """A square lamp under the ceiling."""
    return Light(
        LightKind.RECT,
        **{
            "radiance": (9.0, 8.0, 7.0),
            "position": (0.5, 0.87, 0.5),
            "axis_x": (0.1, 0, 0),
            "axis_y": (0, 0, 0.1),
            "direction": (0, -1, 0),
            **more,
        },
    )


def ball(material: int = 2) -> Mesh:
    """The shiny synthetic ball on the floor."""
    return lit.mesh(lit.ball((0.62, 0.22, 0.42), 0.12, rings=10), Role.SYNTHETIC, material)


def crate(material: int = 0) -> Mesh:
    """The synthetic box on the floor, turned."""
    return lit.mesh(lit.cuboid((0.36, 0.2, 0.38), (0.08, 0.1, 0.08), 25.0), Role.SYNTHETIC, material)


def room(*objects: Mesh, lights: tuple[Light, ...] | None = None, materials: Any = (WHITE, RED, SHINY)) -> Scene:
    """A closed room 0.8 wide with a red side; by default with the ball, the box and the lamp in it."""
    walls = lit.room(0.4)
    colors = np.where(walls.mean(1)[:, 0] < 0.11, 1, 0).astype(np.int32)
    camera = lit.look_at((0.5, 0.55, 0.86), (0.5, 0.35, 0.4), half=0.6, aspect=WIDTH / HEIGHT)
    return lit.scene_of(
        replace(lit.mesh(walls), materials=colors),
        *(objects or (ball(), crate())),
        lights=(lamp(),) if lights is None else lights,
        materials=materials,
        camera=camera,
    )


@dataclass(frozen=True)
class Numbers:
    """What a method hands to the composite, as float64 ``[h, w, …]``, and the finished layers."""

    before: np.ndarray
    delta: np.ndarray
    synthetic: np.ndarray
    layers: Layers

    @property
    def picture(self) -> np.ndarray:
        """The finished picture before it is rounded to halves."""
        return self.before * (1.0 - self.synthetic[..., 3:]) + self.delta + self.synthetic[..., :3]


def numbers(scene: Any, method: str, *, width: int = WIDTH, height: int | None = HEIGHT, **settings: Any) -> Numbers:
    """Render with every launch checked (``check=True``): a NaN, an infinity or a wrong range fails by itself."""
    name, more = METHODS[method]
    caught: list[Any] = []
    real = relighter_module.composite

    def catch(launcher: Any, radiance: Any, plate: Any) -> Layers:
        caught.append(radiance)
        return real(launcher, radiance, plate)

    relighter_module.composite = catch
    try:
        options = {"method": name, "settings": COARSE | more | {k.replace("__", "."): v for k, v in settings.items()}}
        relighter = Relighter(scene, width=width, height=height, threads=2, check=True, **options)
        layers = relighter.render()
    finally:
        relighter_module.composite = real
    assert layers.invalid == 0
    shape = layers.depth.shape

    def host(array: Any) -> np.ndarray:
        return array.numpy().astype(np.float64).reshape(*shape, -1)

    return Numbers(host(caught[0].before), host(caught[0].delta), host(caught[0].synthetic), layers)


def assert_same(one: np.ndarray, other: np.ndarray, *, mean: float, odd: float = 0.02) -> None:
    """Two pictures are the same: their mean difference is at most ``mean`` of the mean, once the share ``odd`` of the
    pixels that differ most is left out (a ray that slips past an edge by one rounding lights its pixel otherwise)."""
    assert one.shape == other.shape
    difference = np.sort(np.abs(one - other).max(-1).ravel())
    kept = difference[: max(1, int(len(difference) * (1.0 - odd)))]
    size = np.abs(other).max(-1).mean()
    assert kept.mean() <= mean * size, f"mean difference {kept.mean() / max(size, 1e-300):.2e} of the mean"


Place = Callable[[np.ndarray], np.ndarray]


def moved(scene: Scene, scale: float = 1.0, turn: np.ndarray | None = None, shift: Any = (0.0, 0.0, 0.0)) -> Scene:
    """The whole scene, lights and camera included, scaled, then turned, then shifted; the picture stays as it is."""
    turn = np.eye(3) if turn is None else turn

    def point(p: Any) -> Any:
        return scale * np.asarray(p, float) @ turn.T + np.asarray(shift, float)

    def light(x: Light) -> Light:
        radiance = tuple(np.asarray(x.radiance) * (scale**2 if x.kind == LightKind.POINT else 1.0))
        axes = {name: tuple(scale * turn @ getattr(x, name)) for name in ("axis_x", "axis_y")}
        return replace(
            x,
            radiance=radiance,
            position=tuple(point(x.position)),
            direction=tuple(turn @ np.asarray(x.direction)),
            radius=scale * x.radius,
            rotation=turn @ x.rotation,
            **axes,
        )

    def camera(x: Camera) -> Camera:
        to_world = np.eye(4)
        to_world[:3, :3] = turn @ x.to_world[:3, :3]
        to_world[:3, 3] = point(x.to_world[:3, 3])
        return replace(x, to_world=to_world, near=scale * x.near, far=scale * x.far)

    def mesh(x: Mesh) -> Mesh:
        normals = None if x.corner_normals is None else (x.corner_normals @ turn.T).astype(np.float32)
        return replace(x, points=point(x.points), corner_normals=normals)

    return replace(
        scene,
        meshes=tuple(mesh(m) for m in scene.meshes),
        lights=tuple(light(x) for x in scene.lights),
        camera=camera(scene.camera),
    )
