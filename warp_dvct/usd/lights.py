"""UsdLux to Light documents, with the units of UsdLux resolved."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_dvct.errors import StageError
from warp_dvct.scene import Light, LightKind
from warp_dvct.usd.collect import Placed
from warp_dvct.usd.context import Context
from warp_dvct.usd.domes import read_dome_texture
from warp_dvct.usd.textures import ImageCache, as_rgb, asset_file

if TYPE_CHECKING:
    from pxr import Usd

BRIGHTEST = 1e30  # emission whose sums and squares over a picture float32 still holds
TUBE_FACES = 8  # of the prism that stands for a CylinderLight
EVEN = 1e-3  # relative difference of scales from which a sphere counts as stretched


@dataclass(frozen=True)
class _Emitter:
    """A light prim at one place."""

    prim: Usd.Prim
    path: str
    m: np.ndarray  # [4, 4] for row vectors, to the world in metres
    ctx: Context
    images: ImageCache

    def get(self, name: str, default: Any = None) -> Any:
        attribute = self.prim.GetAttribute(name)
        value = attribute.Get(self.ctx.time) if attribute else None
        return default if value is None else value

    def size(self, name: str) -> float:
        value = float(self.get(name))
        if not (np.isfinite(value) and value > 0.0):
            raise StageError(f"{self.path}: {name} is {value}; give the light a positive size")
        return value

    def note(self, message: str) -> None:
        self.ctx.notices.add(self.path, message)


def read_lights(placed: Placed, ctx: Context, images: ImageCache) -> list[Light]:
    """The lights of a prim, one per place; empty for a type that is not supported, which is noted.

    Raises:
        StageError: A size, intensity, colour or file is wrong.
    """
    kind = str(placed.prim.GetTypeName())
    reader = READERS.get(kind)
    if reader is None:
        ctx.notices.add(placed.path, f"a {kind} is not supported and gives no light")
        return []
    lights = []
    for number, m in enumerate(placed.matrices):
        path = placed.path if len(placed.matrices) == 1 else f"{placed.path}[{number}]"
        emitter = _Emitter(placed.prim, path, m, ctx, images)
        _note_unsupported(emitter)
        made = reader(emitter, _emission(emitter), {"role": placed.light_role, "path": path})
        lights += made if isinstance(made, list) else [made]
    return lights


def _emission(e: _Emitter) -> np.ndarray:
    """intensity * 2^exposure * color * blackbody, before ``normalize``."""
    from pxr import UsdLux

    intensity, exposure = float(e.get("inputs:intensity")), float(e.get("inputs:exposure"))
    value = np.array(e.get("inputs:color"), dtype=np.float64) * intensity * 2.0**exposure
    if e.get("inputs:enableColorTemperature", False):
        value = value * np.array(UsdLux.BlackbodyTemperatureAsRgb(float(e.get("inputs:colorTemperature"))))
    if not (np.abs(value) < BRIGHTEST).all() or (value < 0.0).any():
        raise StageError(
            f"{e.path}: its emission {tuple(map(float, value))} is negative, not finite or beyond {BRIGHTEST:g};"
            " correct intensity, exposure and color"
        )
    return value


def _per_area(e: _Emitter, value: np.ndarray, area: float) -> np.ndarray:
    """``normalize`` divides by the area [m^2] in the stage's own units: as renderers do, so that looks carry over."""
    return value / (area / e.ctx.metres**2) if e.get("inputs:normalize", False) else value


def _rgb(value: np.ndarray) -> tuple[float, float, float]:
    return float(value[0]), float(value[1]), float(value[2])


def _unit(vector: np.ndarray, e: _Emitter) -> np.ndarray:
    length = np.linalg.norm(vector)
    if not (np.isfinite(length) and length > 0.0):
        raise StageError(f"{e.path}: its transform flattens the light; repair its xformOps")
    return vector / length


def _shaping(e: _Emitter) -> dict[str, float]:
    """Cone of ShapingAPI: the angle is measured from the axis, so it is the half angle."""
    from pxr import UsdLux

    authored = e.prim.GetAttribute("inputs:shaping:cone:angle")
    if not (e.prim.HasAPI(UsdLux.ShapingAPI) or (authored and authored.HasAuthoredValue())):
        return {}
    if float(e.get("inputs:shaping:focus", 0.0)) != 0.0:
        e.note("shaping:focus is not modelled")
    file = e.get("inputs:shaping:ies:file")
    if file is not None and file.path:
        e.note("an IES profile is not modelled")
    angle = np.radians(float(e.get("inputs:shaping:cone:angle", 90.0)))
    softness = float(np.clip(e.get("inputs:shaping:cone:softness", 0.0), 0.0, 1.0))
    if not (np.isfinite(angle) and angle > 0.0):
        raise StageError(f"{e.path}: shaping:cone:angle is {np.degrees(angle)}; it must be positive")
    if np.isnan(softness):
        raise StageError(f"{e.path}: shaping:cone:softness is nan; give 0 to 1")
    return {"cone_angle": float(min(angle, np.pi)), "cone_softness": softness}


def _axis(e: _Emitter) -> tuple[float, float, float]:
    return _rgb(_unit(-e.m[2, :3], e))


def _sphere(e: _Emitter, value: np.ndarray, common: dict[str, Any]) -> Light:
    scales = np.linalg.norm(e.m[:3, :3], axis=1)
    if scales.max() > (1.0 + EVEN) * scales.min():
        e.note("an unevenly scaled SphereLight is drawn as a sphere of its mean radius")
    common = common | {"position": _rgb(e.m[3]), "direction": _axis(e)} | _shaping(e)
    radius = float(e.get("inputs:radius"))
    if e.get("treatAsPoint", False):
        # The limit of a small sphere: I = pi r^2 L; normalised L is 1 / (4 pi r^2), so that r drops out.
        metres = abs(np.linalg.det(e.m[:3, :3])) ** (1.0 / 3.0) * radius
        factor = 0.25 * e.ctx.metres**2 if e.get("inputs:normalize", False) else np.pi * metres**2
        if factor <= 0.0:
            raise StageError(f"{e.path}: radius is 0, so it has no power; set inputs:normalize or give it a radius")
        return Light(LightKind.POINT, _rgb(value * factor), **common)
    metres = abs(np.linalg.det(e.m[:3, :3])) ** (1.0 / 3.0) * e.size("inputs:radius")
    if metres <= 0.0:
        raise StageError(f"{e.path}: its transform flattens the light; repair its xformOps")
    return Light(LightKind.SPHERE, _rgb(_per_area(e, value, 4.0 * np.pi * metres**2)), radius=float(metres), **common)


def _flat(e: _Emitter, half_x: float, half_y: float) -> dict[str, Any]:
    """Half axes and the direction of emission, normal to them on the side of local -z."""
    x, y = e.m[0, :3] * half_x, e.m[1, :3] * half_y
    normal = _unit(np.cross(x, y), e)
    direction = -normal if np.dot(normal, e.m[2, :3]) > 0.0 else normal
    return {"axis_x": _rgb(x), "axis_y": _rgb(y), "direction": _rgb(direction), "position": _rgb(e.m[3])} | _shaping(e)


def _rect(e: _Emitter, value: np.ndarray, common: dict[str, Any]) -> Light:
    frame = _flat(e, 0.5 * e.size("inputs:width"), 0.5 * e.size("inputs:height"))
    area = 4.0 * float(np.linalg.norm(np.cross(frame["axis_x"], frame["axis_y"])))
    file = e.get("inputs:texture:file")
    if file is not None and file.path:
        e.note("a texture on a RectLight is not modelled; its mean colours the light")
        attribute = e.prim.GetAttribute("inputs:texture:file")
        pixels = as_rgb(e.images.read(asset_file(attribute, file, "texture"), "auto", e.path))
        value = value * pixels.mean((0, 1), dtype=np.float64)
    return Light(LightKind.RECT, _rgb(_per_area(e, value, area)), **frame, **common)


def _disk(e: _Emitter, value: np.ndarray, common: dict[str, Any]) -> Light:
    radius = e.size("inputs:radius")
    frame = _flat(e, radius, radius)
    area = np.pi * float(np.linalg.norm(np.cross(frame["axis_x"], frame["axis_y"])))
    return Light(LightKind.DISK, _rgb(_per_area(e, value, area)), **frame, **common)


def _cylinder(e: _Emitter, value: np.ndarray, common: dict[str, Any]) -> list[Light]:
    """A tube along local x without caps, as the faces of a prism with the tube's area.

    Seen from afar across its axis, a convex body is as wide in the mean as its outline is long over pi (Cauchy): so the
    prism sends the tube's power, and between 5 % less and 3 % more of it into single directions.
    """
    if e.get("treatAsLine", False):
        e.note("treatAsLine is not modelled: its radius counts")
    if _shaping(e):
        e.note("shaping of a CylinderLight is not modelled: it shines all round")
    e.note(f"a CylinderLight is drawn as a prism of {TUBE_FACES} RectLights")
    length, radius, path = e.size("inputs:length"), e.size("inputs:radius"), common.pop("path")
    half = np.pi / TUBE_FACES
    rim = radius * half / np.sin(half)  # of the prism, so that its outline is as long as the circle
    faces = []
    for turn in 2.0 * half * np.arange(TUBE_FACES):
        outwards = np.array([0.0, np.cos(turn), np.sin(turn)])
        along = rim * np.sin(half) * np.array([0.0, -np.sin(turn), np.cos(turn)])
        x, y = 0.5 * length * e.m[0, :3], along @ e.m[:3, :3]
        middle = rim * np.cos(half) * outwards @ e.m[:3, :3]
        normal = _unit(np.cross(x, y), e)
        faces.append((x, y, e.m[3, :3] + middle, normal if np.dot(normal, middle) > 0.0 else -normal))
    value = _per_area(e, value, 4.0 * sum(float(np.linalg.norm(np.cross(x, y))) for x, y, _, _ in faces))
    return [
        Light(
            LightKind.RECT,
            _rgb(value),
            axis_x=_rgb(x),
            axis_y=_rgb(y),
            position=_rgb(position),
            direction=_rgb(normal),
            path=f"{path}.face{number}",
            **common,
        )
        for number, (x, y, position, normal) in enumerate(faces)
    ]


def _distant(e: _Emitter, value: np.ndarray, common: dict[str, Any]) -> Light:
    """``normalize`` divides by pi sin^2(angle / 2): ``intensity`` is then the irradiance of a plane facing it."""
    degrees = float(e.get("inputs:angle"))
    if not (0.0 <= degrees <= 360.0):
        raise StageError(f"{e.path}: angle is {degrees}; give 0 to 360 degrees")
    angle = float(np.radians(degrees))
    if angle > 0.0 and e.get("inputs:normalize", False):
        sine = np.sin(0.5 * angle) ** 2
        value = value / (np.pi * (sine if angle <= np.pi else 2.0 - sine))
    return Light(LightKind.DISTANT, _rgb(value), direction=_axis(e), angle=angle, **common)


def _dome(e: _Emitter, value: np.ndarray, common: dict[str, Any]) -> Light:
    from pxr import UsdGeom

    if e.get("inputs:normalize", False):
        e.note("normalize has no effect on a DomeLight")
    if e.prim.GetRelationship("portals").HasAuthoredTargets():
        e.note("portals of a DomeLight are not used")
    pole = str(e.get("poleAxis", "Y"))
    z_up = pole == "Z" or (pole == "scene" and UsdGeom.GetStageUpAxis(e.ctx.stage) == UsdGeom.Tokens.z)
    rows = e.m[:3, :3]
    if z_up:  # the dome's y axis starts out along z, its z axis along -y
        rows = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]) @ rows
    u, _, vt = np.linalg.svd(rows)
    texture = read_dome_texture(e.prim, e.path, e.ctx, e.images)
    return Light(LightKind.DOME, _rgb(value), rotation=(u @ vt).T, texture=texture, **common)


READERS = {
    "SphereLight": _sphere,
    "RectLight": _rect,
    "DiskLight": _disk,
    "CylinderLight": _cylinder,
    "DistantLight": _distant,
    "DomeLight": _dome,
    "DomeLight_1": _dome,
}


def _note_unsupported(e: _Emitter) -> None:
    from pxr import Usd, UsdLux

    for name, what in (("lightLink", "light linking"), ("shadowLink", "shadow linking")):
        collection = Usd.CollectionAPI(e.prim, name)
        rules = collection.GetExcludesRel().HasAuthoredTargets() or collection.GetIncludesRel().HasAuthoredTargets()
        expression = collection.GetMembershipExpressionAttr()
        if rules or (expression and expression.HasAuthoredValue()) or collection.GetIncludeRootAttr().Get() is False:
            e.note(f"{what} is not modelled: it lights everything")
    for name in ("diffuse", "specular"):
        if float(e.get(f"inputs:{name}", 1.0)) != 1.0:
            e.note(f"inputs:{name} is not modelled")
    if UsdLux.LightAPI(e.prim).GetFiltersRel().HasAuthoredTargets():
        e.note("light filters are not modelled")
    if e.prim.HasAPI(UsdLux.ShadowAPI):
        if not e.get("inputs:shadow:enable", True):
            e.note("inputs:shadow:enable is not modelled: it casts shadows")
        if not np.allclose(np.array(e.get("inputs:shadow:color", (0.0, 0.0, 0.0)), dtype=float), 0.0):
            e.note("inputs:shadow:color is not modelled")
