"""Bound materials to Lambert + GGX with at most a base colour and a roughness texture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_dvct.errors import StageError
from warp_dvct.scene import Material, Texture
from warp_dvct.usd.context import Context, shared_path
from warp_dvct.usd.shading import Connection, UVSource, read_connection, read_texture_node, shader_id
from warp_dvct.usd.textures import ImageCache

if TYPE_CHECKING:
    from pxr import Usd, UsdShade

FALLBACK_COLOR = (0.18, 0.18, 0.18)  # UsdGeomGprim's displayColor where none is authored
# inputs of UsdPreviewSurface that have no part in Lambert + GGX, and the value that does nothing
NOT_MODELLED: dict[str, Any] = {
    "emissiveColor": (0.0, 0.0, 0.0),
    "clearcoat": 0.0,
    "opacity": 1.0,
    "normal": (0.0, 0.0, 1.0),
    "displacement": 0.0,
    "occlusion": 1.0,
}
INSTEAD = {"opacity": ": drawn opaque", "emissiveColor": ": it gives no light"}


@dataclass(frozen=True)
class Look:
    """A material and what it wants from the geometry.

    Attributes:
        material: With indices into ``Materials.textures``.
        uv: Where texture coordinates come from; None where it has no texture.
        color: Primvar that the base colour is read from, or None. ``material.base_color`` is white then.
        color_fallback: Base colour where the geometry lacks that primvar.
    """

    material: Material
    uv: UVSource | None = None
    color: str | None = None
    color_fallback: tuple[float, float, float] = FALLBACK_COLOR


# Without a material: the display colour as a matte surface.
PLAIN = Look(Material((1.0, 1.0, 1.0), roughness=1.0, ior=1.0, name="displayColor"), color="displayColor")


class Materials:
    """Reads each material once, however many prims and instances use it.

    Attributes:
        materials, textures: What ``Scene`` gets; they grow as prims are read.
    """

    def __init__(self, ctx: Context, images: ImageCache) -> None:
        self._ctx = ctx
        self._images = images
        self._looks: dict[str, Look] = {}
        self._index: dict[Material, int] = {}
        self._texture_index: dict[tuple, int] = {}
        self.materials: list[Material] = []
        self.textures: list[Texture] = []

    def index(self, material: Material) -> int:
        """The material's place in ``materials``; equal ones share it."""
        if material not in self._index:
            self._index[material] = len(self.materials)
            self.materials.append(material)
        return self._index[material]

    def bound(self, prims: Sequence[Usd.Prim]) -> list[Look]:
        """The look of each mesh, gprim or GeomSubset, by purpose "full" and then by all-purpose bindings."""
        from pxr import UsdShade

        if not prims:
            return []
        found, bindings = UsdShade.MaterialBindingAPI.ComputeBoundMaterials(list(prims), UsdShade.Tokens.full)
        return [self._look(m) if m else self._unbound(binding) for m, binding in zip(found, bindings, strict=True)]

    def _unbound(self, binding: Usd.Relationship) -> Look:
        """The look without a material, which is listed where a binding names one that is not there."""
        if binding:
            names = ", ".join(str(path) for path in binding.GetTargets())
            self._ctx.notices.add(
                binding.GetPrim().GetPath(), f"is bound to {names}, which is no material; drawn with its display colour"
            )
        return PLAIN

    def _look(self, material: UsdShade.Material) -> Look:
        key = shared_path(material.GetPrim())
        if key not in self._looks:
            self._looks[key] = self._read(material)
        return self._looks[key]

    def _read(self, material: UsdShade.Material) -> Look:
        path = str(material.GetPath())
        shader = material.ComputeSurfaceSource()[0]
        if not shader:
            self._ctx.notices.add(path, "has no UsdPreviewSurface; drawn with its display colour")
            return PLAIN
        kind = shader_id(shader)
        if kind != "UsdPreviewSurface":
            self._ctx.notices.add(path, f"its shader '{kind}' is not UsdPreviewSurface; drawn with its display colour")
            return PLAIN
        return self._preview_surface(shader, path)

    def _preview_surface(self, shader: UsdShade.Shader, path: str) -> Look:
        for name, neutral in NOT_MODELLED.items():
            self._note_unless(shader, name, neutral, path)
        specular_workflow = bool(self._constant(shader, "useSpecularWorkflow", 0, path))
        base = read_connection(shader, "diffuseColor", self._ctx)
        color, fallback, base_color = None, FALLBACK_COLOR, FALLBACK_COLOR
        base_texture, uv = None, None
        if base is not None and base.kind.startswith("UsdPrimvarReader_float3"):
            color, fallback, base_color = self._color_reader(base, path)
        elif base is not None and base.kind == "UsdUVTexture":
            base_texture, uv, base_color = self._texture(base, path, "diffuseColor")
        else:
            base_color = self._rgb(self._constant(shader, "diffuseColor", FALLBACK_COLOR, path), path, "diffuseColor")
        roughness, rough_texture, uv = self._roughness(shader, uv, path)
        ior = float(self._constant(shader, "ior", 1.5, path))
        if not ior > 0.0:
            self._ctx.notices.add(path, f"ior is {ior}; 1.5 is used")
            ior = 1.5
        specular = None
        if specular_workflow:
            value = self._constant(shader, "specularColor", (0.0, 0.0, 0.0), path)
            specular = self._rgb(value, path, "specularColor")
        metallic = 0.0 if specular_workflow else float(np.clip(self._constant(shader, "metallic", 0.0, path), 0.0, 1.0))
        material = Material(base_color, metallic, roughness, ior, specular, base_texture, rough_texture, name=path)
        return Look(material, uv, color, fallback)

    def _roughness(
        self, shader: UsdShade.Shader, uv: UVSource | None, path: str
    ) -> tuple[float, int | None, UVSource | None]:
        """Constant, texture and coordinates; a mesh has one set of coordinates, that of the base colour wins."""
        source = read_connection(shader, "roughness", self._ctx)
        if source is None or source.kind != "UsdUVTexture":
            return float(np.clip(self._constant(shader, "roughness", 0.5, path), 0.0, 1.0)), None, uv
        texture, own, mean = self._texture(source, path, "roughness")
        if texture is not None and uv is not None and own != uv:
            self._ctx.notices.add(
                path, "roughness uses other texture coordinates than diffuseColor; the mean of its texture is used"
            )
            return mean[0], None, uv
        return mean[0], texture, own if uv is None else uv

    def _texture(
        self, source: Connection, path: str, name: str
    ) -> tuple[int | None, UVSource | None, tuple[float, float, float]]:
        """Index, coordinates and mean of a UsdUVTexture; without a file its fallback is the mean."""
        node = read_texture_node(source, self._ctx, self._images)
        if node.key not in self._texture_index and node.texture is not None:
            pixels = node.texture.pixels
            if np.isnan(pixels).any():
                raise StageError(f"{path}: the texture of {name}, '{node.texture.name}', has NaN values; repair it")
            if pixels.size and (pixels.min() < 0.0 or pixels.max() > 1.0 + 1e-6):
                self._ctx.notices.add(path, f"the texture of {name} leaves [0, 1] and is clamped")
            texture = replace(node.texture, pixels=np.ascontiguousarray(np.clip(pixels, 0.0, 1.0), np.float32))
            self._texture_index[node.key] = len(self.textures)
            self.textures.append(texture)
        if node.texture is None:
            return None, None, self._rgb(node.fallback, path, name)
        index = self._texture_index[node.key]
        mean = self.textures[index].pixels.mean((0, 1), dtype=np.float64)
        return index, node.uv, (float(mean[0]), float(mean[1]), float(mean[2]))

    def _color_reader(
        self, source: Connection, path: str
    ) -> tuple[str, tuple[float, float, float], tuple[float, float, float]]:
        """Primvar name, its fallback, and the white that the primvar is multiplied into."""
        name = str(source.value("varname", "") or "displayColor")
        fallback = self._rgb(source.value("fallback", (0.0, 0.0, 0.0)), path, "diffuseColor")
        return name, fallback, (1.0, 1.0, 1.0)

    def _constant(self, shader: UsdShade.Shader, name: str, default: Any, path: str) -> Any:
        """The value of an input; where a texture drives it that is not modelled, and its mean stands in."""
        source = read_connection(shader, name, self._ctx)
        if source is None:
            value = _input_value(shader, name, self._ctx)
            if value is None or _is_like(value, default):
                return default if value is None else value
            self._ctx.notices.add(path, f"{name} is {value!r}, which is no {_word(default)}; the default is used")
            return default
        if source.kind == "UsdUVTexture":
            node = read_texture_node(source, self._ctx, self._images)
            mean = node.fallback if node.texture is None else node.texture.pixels.mean((0, 1), dtype=np.float64)
            self._ctx.notices.add(path, f"a texture on {name} is not supported; its mean is used")
            return tuple(float(x) for x in mean[:3]) if isinstance(default, tuple) else float(mean[0])
        self._ctx.notices.add(path, f"'{source.kind}' on {name} is not supported; the default is used")
        return default

    def _note_unless(self, shader: UsdShade.Shader, name: str, neutral: Any, path: str) -> None:
        if read_connection(shader, name, self._ctx) is not None:
            self._ctx.notices.add(path, f"{name} is not modelled{INSTEAD.get(name, '')}")
            return
        value = _input_value(shader, name, self._ctx)
        if value is not None and not (_is_like(value, neutral) and np.allclose(np.array(value, dtype=float), neutral)):
            self._ctx.notices.add(path, f"{name} is not modelled{INSTEAD.get(name, '')}")

    def _rgb(self, value: Any, path: str, name: str) -> tuple[float, float, float]:
        rgb = np.array(value, dtype=np.float64)[:3]
        if (rgb < 0.0).any() or (rgb > 1.0).any() or not np.isfinite(rgb).all():
            self._ctx.notices.add(path, f"{name} {tuple(map(float, rgb))} leaves [0, 1] and is clamped")
            rgb = np.clip(np.nan_to_num(rgb), 0.0, 1.0)
        return float(rgb[0]), float(rgb[1]), float(rgb[2])


def _is_like(value: Any, default: Any) -> bool:
    """Whether an input's value can stand for ``default``: as many finite numbers."""
    try:
        numbers = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        return False
    return numbers.shape == np.shape(default) and bool(np.isfinite(numbers).all())


def _word(default: Any) -> str:
    return "colour" if isinstance(default, tuple) else "finite number"


def _input_value(shader: UsdShade.Shader, name: str, ctx: Context) -> Any:
    """The input's value, from the material's interface where it is connected to that."""
    given = shader.GetInput(name)
    if not given:
        return None
    attributes = given.GetValueProducingAttributes()
    return attributes[0].Get(ctx.time) if attributes else None
