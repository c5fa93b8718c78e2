"""Shader networks of UsdPreviewSurface: what drives an input, texture nodes and their coordinates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_dvct.errors import StageError
from warp_dvct.scene import Texture, Wrap
from warp_dvct.usd.context import Context
from warp_dvct.usd.textures import ImageCache, as_rgb, asset_file

if TYPE_CHECKING:
    from pxr import Sdf, Usd, UsdShade

# "useMetadata" falls back to black in the specification, which draws dark seams at every border texel;
# renderers repeat, and so do we.
WRAPS = {"repeat": Wrap.REPEAT, "clamp": Wrap.CLAMP, "mirror": Wrap.MIRROR, "black": Wrap.BLACK}
IDENTITY = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0)


@dataclass(frozen=True)
class UVSource:
    """Texture coordinates: ``uv' = (a u + c v + e, b u + d v + f)`` of a primvar.

    Attributes:
        primvar: Its name; empty for the constant ``fallback``.
        affine: (a, b, c, d, e, f).
        fallback: Coordinates where the geometry lacks the primvar.
    """

    primvar: str
    affine: tuple[float, ...] = IDENTITY
    fallback: tuple[float, float] = (0.0, 0.0)

    def apply(self, uv: np.ndarray) -> np.ndarray:
        """Transform coordinates ``[..., 2]``."""
        a, b, c, d, e, f = self.affine
        return np.stack([a * uv[..., 0] + c * uv[..., 1] + e, b * uv[..., 0] + d * uv[..., 1] + f], -1)


@dataclass(frozen=True)
class Connection:
    """The shader output that drives an input.

    Attributes:
        shader: The upstream node.
        output: Its output's name, e.g. "rgb".
        kind: Its ``info:id``.
        ctx: The reading.
    """

    shader: UsdShade.Shader
    output: str
    kind: str
    ctx: Context

    def value(self, name: str, default: Any) -> Any:
        """A constant input of the node, directly or through the material's interface."""
        from pxr import UsdShade

        given = self.shader.GetInput(name)
        attributes = given.GetValueProducingAttributes() if given else []
        if not attributes or UsdShade.Output.IsOutput(attributes[0]):
            return default
        value = attributes[0].Get(self.ctx.time)
        return default if value is None else value


@dataclass(frozen=True)
class TextureNode:
    """A UsdUVTexture.

    Attributes:
        texture: Pixels with scale and bias applied, or None where it names no file.
        uv: Its coordinates.
        fallback: Value without a file, RGB.
        key: Equal for equal textures.
    """

    texture: Texture | None
    uv: UVSource
    fallback: tuple[float, float, float]
    key: tuple


def shader_id(shader: UsdShade.Shader) -> str:
    """``info:id``, or the empty string where the node has none."""
    return str(shader.GetIdAttr().Get() or "")


def read_connection(shader: UsdShade.Shader, name: str, ctx: Context) -> Connection | None:
    """The node that drives an input, through node graphs and interfaces; None for a constant."""
    from pxr import UsdShade

    given = shader.GetInput(name)
    attributes = given.GetValueProducingAttributes() if given else []
    if not attributes or not UsdShade.Output.IsOutput(attributes[0]):
        return None
    node = UsdShade.Shader(attributes[0].GetPrim())
    return Connection(node, UsdShade.Output(attributes[0]).GetBaseName(), shader_id(node), ctx)


def read_texture_node(source: Connection, ctx: Context, images: ImageCache) -> TextureNode:
    """Read a UsdUVTexture's file and coordinates.

    Raises:
        StageError: The file is missing or cannot be read; the message names the prim and the file.
    """
    prim = source.shader.GetPrim()
    uv = _coordinates(source, ctx)
    scale = tuple(float(x) for x in source.value("scale", (1.0, 1.0, 1.0, 1.0)))
    bias = tuple(float(x) for x in source.value("bias", (0.0, 0.0, 0.0, 0.0)))
    fallback = tuple(float(x) for x in source.value("fallback", (0.0, 0.0, 0.0, 1.0)))
    value = source.value("file", None)
    if value is None or not value.path:
        ctx.notices.add(prim.GetPath(), "a UsdUVTexture without a file; its fallback is used")
        first = "rgba".find(source.output) if len(source.output) == 1 else -1
        rgb = fallback[:3] if first < 0 else (fallback[first],) * 3
        return TextureNode(None, uv, (rgb[0], rgb[1], rgb[2]), ())
    attribute = source.shader.GetInput("file").GetValueProducingAttributes()[0]
    space = _color_space(source, attribute)
    if "<UDIM>" in value.path:
        pixels, uv, file = _udim(attribute, value, space, uv, images)
        wraps = (Wrap.CLAMP, Wrap.CLAMP)
    else:
        file = asset_file(attribute, value, "texture")
        pixels = images.read(file, space, str(prim.GetPath()))
        wraps = (_wrap(source, "wrapS"), _wrap(source, "wrapT"))
    pixels = _channels(pixels, source.output, scale, bias)
    key = (file, space, source.output, scale, bias, wraps)
    return TextureNode(Texture(pixels, *wraps, name=file), uv, (fallback[0], fallback[1], fallback[2]), key)


def _color_space(source: Connection, attribute: Usd.Attribute) -> str:
    """sourceColorSpace, or where it is not authored the colorSpace metadata of the file attribute."""
    authored = source.shader.GetInput("sourceColorSpace")
    space = str(source.value("sourceColorSpace", "auto"))
    if space not in ("auto", "raw", "sRGB"):
        raise StageError(f"{source.shader.GetPath()}: sourceColorSpace is '{space}'; it must be auto, raw or sRGB")
    if not authored and attribute.HasColorSpace():
        named = str(attribute.GetColorSpace()).lower()
        return "sRGB" if "srgb" in named and "lin" not in named else "raw"
    return space


def _wrap(source: Connection, name: str) -> Wrap:
    mode = str(source.value(name, "useMetadata"))
    if mode not in (*WRAPS, "useMetadata"):
        source.ctx.notices.add(source.shader.GetPath(), f"{name} is '{mode}', which is no wrap mode; repeated")
    return WRAPS.get(mode, Wrap.REPEAT)


def _channels(pixels: np.ndarray, output: str, scale: tuple, bias: tuple) -> np.ndarray:
    """Apply scale and bias and pick the output: rgb, or one channel repeated."""
    if output in ("r", "g", "b"):
        k = "rgb".index(output)
        one = as_rgb(pixels)[..., k : k + 1] * np.float32(scale[k]) + np.float32(bias[k])
        return np.repeat(one, 3, 2)
    if output == "a":
        alpha = pixels[..., -1:] if pixels.shape[2] in (2, 4) else np.ones_like(pixels[..., :1])
        return np.repeat(alpha * np.float32(scale[3]) + np.float32(bias[3]), 3, 2)
    if scale[:3] == (1.0, 1.0, 1.0) and bias[:3] == (0.0, 0.0, 0.0):
        return as_rgb(pixels)
    return as_rgb(pixels) * np.array(scale[:3], np.float32) + np.array(bias[:3], np.float32)


def _coordinates(source: Connection, ctx: Context) -> UVSource:
    """Follow ``st`` through UsdTransform2d nodes to a UsdPrimvarReader_float2."""
    node, name = source, "st"
    total = np.eye(3)  # for row vectors (u, v, 1)
    passed = set()
    while True:
        given = read_connection(node.shader, name, ctx)
        if given is not None and given.shader.GetPath() in passed:
            raise StageError(f"{given.shader.GetPath()}: its input is its own output, through a circle; reconnect it")
        affine = tuple(float(x) for x in total[:, :2][[0, 0, 1, 1, 2, 2], [0, 1, 0, 1, 0, 1]])
        if given is None:
            value = node.value(name, (0.0, 0.0))
            ctx.notices.add(source.shader.GetPath(), f"{name} is not connected to a UsdPrimvarReader; it is constant")
            return UVSource("", affine, (float(value[0]), float(value[1])))
        if given.kind == "UsdTransform2d":
            total = _transform2d(given) @ total
            node, name = given, "in"
            passed.add(given.shader.GetPath())
            continue
        if not given.kind.startswith("UsdPrimvarReader_float2"):
            ctx.notices.add(
                source.shader.GetPath(), f"'{given.kind}' on {name} is not supported; the primvar st is used"
            )
            return UVSource("st", affine)
        fallback = given.value("fallback", (0.0, 0.0))
        primvar = str(given.value("varname", "") or "st")
        return UVSource(primvar, affine, (float(fallback[0]), float(fallback[1])))


def _transform2d(node: Connection) -> np.ndarray:
    """``in * scale``, then turned counter-clockwise by ``rotation`` degrees, then moved: 3x3 for row vectors."""
    scale, move = node.value("scale", (1.0, 1.0)), node.value("translation", (0.0, 0.0))
    angle = np.radians(float(node.value("rotation", 0.0)))
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    m = np.eye(3)
    m[:2, :2] = np.diag([float(scale[0]), float(scale[1])]) @ turn
    m[2, :2] = [float(move[0]), float(move[1])]
    if not np.isfinite(m).all():
        raise StageError(f"{node.shader.GetPath()}: scale, rotation or translation is NaN or infinite; correct it")
    return m


def _udim(
    attribute: Usd.Attribute, value: Sdf.AssetPath, space: str, uv: UVSource, images: ImageCache
) -> tuple[np.ndarray, UVSource, str]:
    """All tiles side by side in one image, each at the size of the largest, and coordinates to match.

    Tiles that do not exist are black. Bilinear lookups blend neighbours at a tile's border.
    """
    from pxr import UsdShade

    owner = str(attribute.GetPrim().GetPath())
    layer = attribute.GetPropertyStack()[0].layer
    tiles = UsdShade.UdimUtils.ResolveUdimTilePaths(value.path, layer)
    if not tiles:
        raise StageError(f"{owner}: no tile of the texture '{value.path}' exists; correct the path or add the files")
    read = [(int(number) - 1001, images.read(file, space, owner)) for file, number in tiles]
    columns, rows = [n % 10 for n, _ in read], [n // 10 for n, _ in read]
    left, low = min(columns), min(rows)
    across, up = max(columns) - left + 1, max(rows) - low + 1
    height, width = (max(p.shape[k] for _, p in read) for k in (0, 1))
    atlas = np.zeros((up * height, across * width, max(p.shape[2] for _, p in read)), np.float32)
    for (_, pixels), column, row in zip(read, columns, rows, strict=True):
        y, x = (up - 1 - (row - low)) * height, (column - left) * width
        lines = np.arange(height) * pixels.shape[0] // height
        dots = np.arange(width) * pixels.shape[1] // width
        atlas[y : y + height, x : x + width, : pixels.shape[2]] = pixels[lines][:, dots]
    a, b, c, d, e, f = uv.affine
    affine = (a / across, b / up, c / across, d / up, (e - left) / across, (f - low) / up)
    return atlas, UVSource(uv.primvar, affine, uv.fallback), value.path
