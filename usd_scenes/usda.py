"""Small writers of .usda text, so that the bundled stages come out the same bytes on every machine.

Text rather than ``Usd.Stage``: number formatting and property order then do not depend on the installed USD.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

Vec3 = tuple[float, float, float]
MATERIALS = "/World/Materials"


def number(value: float) -> str:
    """Up to six decimals, no trailing zeros, never ``-0``."""
    text = f"{value:.6f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text


def vec(values: Iterable[float]) -> str:
    """``(x, y, z)``."""
    return "(" + ", ".join(number(v) for v in values) + ")"


def array(items: Iterable[str]) -> str:
    """``[a, b]``."""
    return "[" + ", ".join(items) + "]"


def prim(kind: str, name: str, body: Sequence[str] = (), apis: Sequence[str] = (), extra: Sequence[str] = ()) -> str:
    """A ``def`` block; ``body`` holds properties and child prims, ``extra`` further lines of prim metadata."""
    meta = ["prepend apiSchemas = " + array(f'"{a}"' for a in apis)] if apis else []
    meta += extra
    head = f'def {kind} "{name}"' + (" (\n" + indent(meta) + "\n)" if meta else "")
    return head + "\n{\n" + (indent(body) + "\n" if body else "") + "}"


def indent(blocks: Sequence[str]) -> str:
    """Four spaces before every line; a blank line around nested prims."""
    lines: list[str] = []
    for i, block in enumerate(blocks):
        if i and (block.startswith("def ") or blocks[i - 1].startswith("def ")):
            lines.append("")
        lines += ["    " + line if line else "" for line in block.split("\n")]
    return "\n".join(lines)


def place(translate: Vec3 = (0, 0, 0), turn: float = 0.0, scale: float = 1.0, pitch: float = 0.0) -> list[str]:
    """Xform ops: scale, then pitch about X, then turn about Y [degrees], then translate."""
    ops, order = [], []
    for name, kind, text, used in (
        ("translate", "double3", vec(translate), any(translate)),
        ("rotateY", "float", number(turn), turn != 0),
        ("rotateX", "float", number(pitch), pitch != 0),
        ("scale", "float3", vec((scale,) * 3), scale != 1),
    ):
        if used:
            ops.append(f"{kind} xformOp:{name} = {text}")
            order.append(f'"xformOp:{name}"')
    return [*ops, f"uniform token[] xformOpOrder = {array(order)}"] if ops else []


def bound(material: str) -> str:
    """The material binding of a prim that applies MaterialBindingAPI."""
    return f"rel material:binding = <{MATERIALS}/{material}>"


def mesh(
    name: str,
    points: Sequence[Vec3],
    faces: Sequence[Sequence[int]],
    material: str,
    xform: Sequence[str] = (),
    uvs: Sequence[tuple[float, float]] | None = None,
    double_sided: bool = False,
) -> str:
    """A polygon mesh without subdivision, one-sided by default; ``uvs`` are per vertex."""
    low, high = ([pick(p[k] for p in points) for k in range(3)] for pick in (min, max))
    body = [
        f"uniform bool doubleSided = {int(double_sided)}",
        f"float3[] extent = {array([vec(low), vec(high)])}",
        f"int[] faceVertexCounts = {array(str(len(f)) for f in faces)}",
        f"int[] faceVertexIndices = {array(str(i) for f in faces for i in f)}",
        bound(material),
        f"point3f[] points = {array(vec(p) for p in points)}",
    ]
    if uvs is not None:
        body.append(f'texCoord2f[] primvars:st = {array(vec(t) for t in uvs)} (\n    interpolation = "vertex"\n)')
    body += ['uniform token subdivisionScheme = "none"', *xform]
    return prim("Mesh", name, body, apis=["MaterialBindingAPI"])


def box(name: str, size: Vec3, base: Vec3, material: str, turn: float = 0.0, inward: bool = False) -> str:
    """A box of ``size`` standing on ``base`` (the centre of its bottom face), turned about Y by ``turn`` degrees."""
    x, y, z = size[0] / 2, size[1], size[2] / 2
    points = [(sx * x, sy * y, sz * z) for sy in (0, 1) for sz in (-1, 1) for sx in (-1, 1)]
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    if inward:
        faces = [f[::-1] for f in faces]
    return mesh(name, points, faces, material, place(base, turn))


def quad(
    name: str,
    corner: Vec3,
    u: Vec3,
    v: Vec3,
    material: str,
    uv_repeat: float | None = None,
    double_sided: bool = False,
) -> str:
    """A parallelogram whose front faces u x v; ``uv_repeat`` gives it texture coordinates 0 … uv_repeat."""

    def at(a: float, b: float) -> Vec3:
        x, y, z = (c + a * p + b * q for c, p, q in zip(corner, u, v, strict=True))
        return x, y, z

    uvs = None if uv_repeat is None else [(a * uv_repeat, b * uv_repeat) for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))]
    points = [at(0, 0), at(1, 0), at(1, 1), at(0, 1)]
    return mesh(name, points, [(0, 1, 2, 3)], material, uvs=uvs, double_sided=double_sided)


def sphere(name: str, radius: float, centre: Vec3, material: str) -> str:
    """A Sphere gprim."""
    extent = array([vec((-radius,) * 3), vec((radius,) * 3)])
    body = [f"float3[] extent = {extent}", bound(material), f"double radius = {number(radius)}", *place(centre)]
    return prim("Sphere", name, body, apis=["MaterialBindingAPI"])


def cylinder(name: str, radius: float, height: float, base: Vec3, material: str) -> str:
    """A Cylinder gprim standing upright on ``base``."""
    low = (-radius, -height / 2, -radius)
    body = [
        'uniform token axis = "Y"',
        f"float3[] extent = {array([vec(low), vec(-c for c in low)])}",
        f"double height = {number(height)}",
        bound(material),
        f"double radius = {number(radius)}",
        *place((base[0], base[1] + height / 2, base[2])),
    ]
    return prim("Cylinder", name, body, apis=["MaterialBindingAPI"])


def surface(name: str, inputs: Sequence[str], nodes: Sequence[str] = ()) -> str:
    """A Material around one UsdPreviewSurface with the given ``inputs`` lines and further shader ``nodes``."""
    path = f"{MATERIALS}/{name}"
    shader = prim(
        "Shader", "Surface", ['uniform token info:id = "UsdPreviewSurface"', *inputs, "token outputs:surface"]
    )
    return prim("Material", name, [f"token outputs:surface.connect = <{path}/Surface.outputs:surface>", shader, *nodes])


LAMBERT = (
    "float inputs:roughness = 1",
    "color3f inputs:specularColor = (0, 0, 0)",
    "int inputs:useSpecularWorkflow = 1",
)


def lambert(name: str, albedo: Vec3) -> str:
    """A pure Lambert material: the specular workflow with F0 = 0."""
    return surface(name, [f"color3f inputs:diffuseColor = {vec(albedo)}", *LAMBERT])


def textured_lambert(name: str, file: str) -> str:
    """A pure Lambert material whose albedo is a linear image over the primvar ``st``."""
    path = f"{MATERIALS}/{name}"
    texture = prim(
        "Shader",
        "Texture",
        [
            'uniform token info:id = "UsdUVTexture"',
            f"asset inputs:file = @./{file}@",
            'token inputs:sourceColorSpace = "raw"',
            f"float2 inputs:st.connect = <{path}/Coordinates.outputs:result>",
            'token inputs:wrapS = "repeat"',
            'token inputs:wrapT = "repeat"',
            "float3 outputs:rgb",
        ],
    )
    coordinates = prim(
        "Shader",
        "Coordinates",
        [
            'uniform token info:id = "UsdPrimvarReader_float2"',
            'string inputs:varname = "st"',
            "float2 outputs:result",
        ],
    )
    albedo = f"color3f inputs:diffuseColor.connect = <{path}/Texture.outputs:rgb>"
    return surface(name, [albedo, *LAMBERT], [texture, coordinates])


def glossy(name: str, color: Vec3, roughness: float, metallic: float = 0.0) -> str:
    """A metallic-workflow material; a dielectric of ior 1.5 where ``metallic`` is 0."""
    return surface(
        name,
        [
            f"color3f inputs:diffuseColor = {vec(color)}",
            "float inputs:ior = 1.5",
            f"float inputs:metallic = {number(metallic)}",
            f"float inputs:roughness = {number(roughness)}",
        ],
    )


def rect_light(name: str, width: float, height: float, intensity: float, xform: Sequence[str]) -> str:
    """A RectLight; it emits along its -Z."""
    extent = array([vec((-width / 2, -height / 2, 0)), vec((width / 2, height / 2, 0))])
    body = [
        f"float3[] extent = {extent}",
        f"float inputs:height = {number(height)}",
        f"float inputs:intensity = {number(intensity)}",
        f"float inputs:width = {number(width)}",
        *xform,
    ]
    return prim("RectLight", name, body)


def camera(name: str, position: Vec3, turn: float, pitch: float, width_angle: float, near: float = 0.01) -> str:
    """A 16:9 camera, ``width_angle`` degrees wide; what is nearer than ``near`` metres is cut away."""
    focal = 18 / math.tan(math.radians(width_angle) / 2)
    body = [
        f"float2 clippingRange = {vec((near, 1000))}",
        f"float focalLength = {number(focal)}",
        "float horizontalAperture = 36",
        "float verticalAperture = 20.25",
        *place(position, turn, pitch=pitch),
    ]
    return prim("Camera", name, body)


def role(name: str, reality: str, children: Sequence[str]) -> str:
    """An Xform that marks all below it as ``real`` or ``synthetic``."""
    return prim("Xform", name, [f'token primvars:dvct:reality = "{reality}"', *children])


def stage(name: str, doc: str, children: Sequence[str]) -> str:
    """A whole stage: Y up, metres, ``/World``, and ``/Render`` with a 640x360 product of ``/World/Camera``."""
    product = prim("RenderProduct", "Product", [f'token productName = "{name}.exr"'])
    settings = prim(
        "RenderSettings",
        "Settings",
        [
            "rel camera = </World/Camera>",
            "rel products = </Render/Settings/Product>",
            "uniform int2 resolution = (640, 360)",
            product,
        ],
    )
    head = [
        '    defaultPrim = "World"',
        f'    doc = "{doc}"',
        "    metersPerUnit = 1",
        '    renderSettingsPrimPath = "/Render/Settings"',
        '    upAxis = "Y"',
    ]
    world = prim("Xform", "World", children, extra=['kind = "assembly"'])
    body = [world, prim("Scope", "Render", [settings])]
    return "#usda 1.0\n(\n" + "\n".join(head) + "\n)\n\n" + "\n\n".join(body) + "\n"
