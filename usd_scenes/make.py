"""Writes the bundled stages and their textures beside this file: ``python -m warp_dvct.usd_scenes.make``.

The stages are committed; a test checks that they are what this script makes.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warp_dvct.usd_scenes import usda
from warp_dvct.usd_scenes.usda import Vec3

# The room: metres, x to the right, y up, the camera near the wall z = FRONT and looking along -z.
SIDE, TOP, BACK, FRONT = 1.8, 2.2, -1.8, 2.2
WHITE, RED, GREEN = (0.73, 0.73, 0.73), (0.63, 0.065, 0.05), (0.14, 0.45, 0.091)
EYE, EYE_PITCH, EYE_ANGLE = (0.0, 1.25, 2.1), -14.0, 60.0
SUN_ANGLE = 1.0  # degrees
WALL = 0.001  # metres, the partition of thin_wall


def stages() -> dict[str, str]:
    """Name and text of every stage."""
    return {
        "bunny": bunny(),
        "colour_bleeding": colour_bleeding(),
        "double_shadow": double_shadow(),
        "furnace": furnace(),
        "ground_dome": ground_dome(),
        "room_area": room_area(),
        "room_glossy": room_glossy(),
        "room_spot": room_spot(),
        "thin_wall": thin_wall(),
    }


def textures() -> dict[str, np.ndarray]:
    """File name and linear float16 pixels, row 0 on top, of every texture."""
    return {"sky.exr": sky(), "paving.exr": paving()}


def room_area() -> str:
    """A coloured room under an area light, with a diffuse sphere and box inserted."""
    doc = "Closed room, red and green side walls, light below the ceiling; a white ball and a blue crate are inserted."
    return usda.stage("room_area", doc, [room_camera(), ceiling_light(), room(), diffuse_objects(), room_materials()])


def room_spot() -> str:
    """The same room and objects, lit by one spot."""
    spot = usda.prim(
        "SphereLight",
        "Light",
        [
            f"float3[] extent = {usda.array([usda.vec((-0.06,) * 3), usda.vec((0.06,) * 3)])}",
            "float inputs:intensity = 1900",
            "float inputs:radius = 0.06",
            "float inputs:shaping:cone:angle = 40",
            "float inputs:shaping:cone:softness = 0.5",
            *usda.place((-0.9, 2.05, 0.9), turn=-38, pitch=-58),
        ],
        apis=["ShapingAPI"],
    )
    doc = "The room of room_area lit by one spot: most of the picture is indirect light."
    return usda.stage("room_spot", doc, [room_camera(), spot, room(), diffuse_objects(), room_materials()])


def room_glossy() -> str:
    """The room with a glossy floor; the inserted objects are glossy too."""
    objects = usda.role(
        "Synthetic",
        "synthetic",
        [
            usda.sphere("Ball", 0.25, (0.5, 0.25, -0.1), "Chrome"),
            usda.box("Crate", (0.36, 0.56, 0.36), (-0.2, 0, -0.45), "Lacquer", turn=28),
        ],
    )
    glossy = [
        usda.glossy("Floor", (0.55, 0.5, 0.45), roughness=0.25, metallic=0.4),
        usda.glossy("Chrome", (0.9, 0.88, 0.85), roughness=0.15, metallic=1.0),
        usda.glossy("Lacquer", (0.1, 0.2, 0.55), roughness=0.25),
    ]
    doc = (
        "The room of room_area with a glossy floor; a chrome ball and a lacquered box are inserted and mirrored in it."
    )
    children = [room_camera(), ceiling_light(), room(floor="Floor"), objects, room_materials(glossy)]
    return usda.stage("room_glossy", doc, children)


def double_shadow() -> str:
    """A synthetic ball hangs between a lamp and a real box: the box's shadow must not be taken off twice."""
    box = usda.box("Box", (0.5, 0.6, 0.5), (0.15, 0, -0.3), "Wood", turn=15)
    ball = usda.role("Synthetic", "synthetic", [usda.sphere("Ball", 0.3, (-0.33, 1.12, -0.28), "White")])
    doc = (
        "Figures 4 and 5 of Knecht 2012: a synthetic ball between a lamp and a real box, whose shadow is there already."
    )
    materials = room_materials([usda.lambert("Wood", (0.5, 0.36, 0.22))])
    lamp = spot("Light", 2600, 0.04, 32, (-1.2, 2.05, -0.25), turn=-92, pitch=-47)
    return usda.stage("double_shadow", doc, [room_camera(), lamp, room(furniture=box), ball, materials])


def colour_bleeding() -> str:
    """A lamp lights a real blue block, which tints the room; a synthetic green box is put into the beam."""
    block = usda.box("Block", (0.5, 1.3, 1.2), (1.0, 0, -0.6), "Blue")
    objects = usda.role("Synthetic", "synthetic", [usda.box("Box", (0.3, 0.66, 0.7), (-0.75, 0, -0.6), "Leaf")])
    doc = "Figures 6 and 14 to 16 of Knecht 2012: a synthetic box takes the light off a real one that tints the room."
    materials = room_materials([usda.lambert("Leaf", (0.2, 0.5, 0.1))])
    lamp = spot("Light", 9000, 0.04, 14, (-1.7, 0.6, -0.6), turn=-90, pitch=2)
    return usda.stage("colour_bleeding", doc, [room_camera(), lamp, room(furniture=block), objects, materials])


def spot(name: str, intensity: float, radius: float, cone: float, position: Vec3, turn: float, pitch: float) -> str:
    """A SphereLight with a soft-edged cone of half angle ``cone`` degrees."""
    return usda.prim(
        "SphereLight",
        name,
        [
            f"float3[] extent = {usda.array([usda.vec((-radius,) * 3), usda.vec((radius,) * 3)])}",
            f"float inputs:intensity = {usda.number(intensity)}",
            f"float inputs:radius = {usda.number(radius)}",
            f"float inputs:shaping:cone:angle = {usda.number(cone)}",
            "float inputs:shaping:cone:softness = 0.3",
            *usda.place(position, turn=turn, pitch=pitch),
        ],
        apis=["ShapingAPI"],
    )


def ground_dome() -> str:
    """Paved ground under a sky texture and a sun."""
    dome = usda.prim(
        "DomeLight",
        "Sky",
        [
            "float inputs:intensity = 0.75",
            "asset inputs:texture:file = @./sky.exr@",
            'token inputs:texture:format = "latlong"',
        ],
    )
    sun = usda.prim(
        "DistantLight",
        "Sun",
        [
            f"float inputs:angle = {usda.number(SUN_ANGLE)}",
            "color3f inputs:color = (1, 0.93, 0.82)",
            "float inputs:intensity = 13500",
            *usda.place(turn=-48, pitch=-42),
        ],
    )
    real = [
        usda.quad("Ground", (-40, 0, 40), (80, 0, 0), (0, 0, -80), "Paving", uv_repeat=80),
        usda.box("Block", (0.7, 0.9, 0.7), (-1.15, 0, -0.9), "Brick", turn=20),
    ]
    objects = [
        usda.sphere("Ball", 0.34, (0.7, 0.34, 0.2), "White"),
        usda.cylinder("Drum", 0.24, 0.7, (-0.2, 0, -0.1), "Teal"),
    ]
    materials = [
        usda.textured_lambert("Paving", "paving.exr"),
        usda.lambert("Brick", (0.5, 0.24, 0.17)),
        usda.lambert("White", (0.75, 0.75, 0.75)),
        usda.lambert("Teal", (0.08, 0.4, 0.42)),
    ]
    children = [
        usda.camera("Camera", (0.15, 1.7, 4.0), 0, -13, 46),
        dome,
        sun,
        usda.role("Real", "real", real),
        usda.role("Synthetic", "synthetic", objects),
        usda.prim("Scope", "Materials", materials),
    ]
    return usda.stage(
        "ground_dome", "Paved ground under a lat-long sky and a sun; a ball and a drum are inserted.", children
    )


def furnace() -> str:
    """One convex block of three parts under a constant dome: its radiance is its albedo, exactly."""
    middle = [usda.box("Middle", (0.6, 0.6, 0.6), (0, 0, 0), "White")]
    ends = [
        usda.box("Left", (0.5, 0.6, 0.6), (-0.55, 0, 0), "White"),
        usda.box("Right", (0.5, 0.6, 0.6), (0.55, 0, 0), "Half"),
    ]
    children = [
        usda.camera("Camera", (0.55, 1.15, 2.3), 12, -20, 48),
        usda.prim("DomeLight", "Sky", ["float inputs:intensity = 1"]),
        usda.role("Real", "real", middle),
        usda.role("Synthetic", "synthetic", ends),
        usda.prim("Scope", "Materials", [usda.lambert("White", (1, 1, 1)), usda.lambert("Half", (0.5, 0.5, 0.5))]),
    ]
    doc = "White furnace: a dome of radiance 1 around one convex block; all is 1, the right part (albedo 0.5) is 0.5."
    return usda.stage("furnace", doc, children)


def bunny() -> str:
    """The Stanford bunny of the warp-lang package on a real table, lit by a window at the side.

    The asset is a search path; ``usd_scenes.path("bunny")`` replaces it by the installed file.
    """
    window = usda.rect_light("Light", 1.3, 1.3, 8, usda.place((-SIDE + 0.02, 1.35, 0.2), turn=-90))
    scale = 0.42
    model = usda.prim(
        "Xform",
        "Bunny",
        [usda.bound("Clay"), *usda.place((0.1, 0.5 - 0.021163 * scale, 0.05), turn=-20, scale=scale)],
        apis=["MaterialBindingAPI"],
        extra=["prepend references = @warp/examples/assets/bunny.usd@"],
    )
    table = usda.box("Table", (1.5, 0.5, 0.9), (0.05, 0, 0), "Wood", turn=8)
    materials = room_materials([usda.lambert("Wood", (0.48, 0.3, 0.16)), usda.glossy("Clay", (0.7, 0.62, 0.5), 0.45)])
    children = [
        room_camera(),
        window,
        room(furniture=table),
        usda.role("Synthetic", "synthetic", [model]),
        materials,
    ]
    return usda.stage(
        "bunny", "The Stanford bunny of warp-lang on a real table, lit from a window at the left.", children
    )


def thin_wall() -> str:
    """Two rooms with a wall of 1 mm between them, seen through the front wall; one is lit, the other is dark."""
    over = 0.01  # how far the partition reaches into floor, ceiling and walls, so that no light passes by its edges
    middle, high = 0.2, TOP + 2 * over
    partition = usda.role(
        "Partition",
        "real",
        [
            usda.box(
                "Board",
                (WALL, high, middle - BACK + over),
                (0, -over, (middle + BACK - over) / 2),
                "White",
            ),
            usda.quad(
                "Sheet", (0, -over, middle), (0, 0, FRONT + over - middle), (0, high, 0), "White", double_sided=True
            ),
        ],
    )
    lamp = usda.rect_light("Light", 0.6, 0.9, 16, usda.place((SIDE / 2, TOP - 0.01, 0.1), pitch=-90))
    objects = [
        usda.sphere("Ball", 0.22, (0.62, 0.22, 0.75), "White"),
        usda.box("Crate", (0.36, 0.56, 0.36), (0.45, 0, -0.3), "Blue", turn=28),
    ]
    children = [
        usda.camera("Camera", (-0.2, 1.15, 6), 0, -2, 48, near=4),
        lamp,
        room(),
        partition,
        usda.role("Synthetic", "synthetic", objects),
        room_materials(),
    ]
    doc = "Two rooms, one lit and one dark, with a partition of 1 mm; a white ball and a blue crate in the lit one."
    return usda.stage("thin_wall", doc, children)


def room(floor: str = "White", furniture: str | None = None) -> str:
    """Six inward-facing walls and a piece of furniture; real."""
    w, h, d = 2 * SIDE, TOP, FRONT - BACK
    walls = [
        usda.quad("Floor", (-SIDE, 0, FRONT), (w, 0, 0), (0, 0, -d), floor),
        usda.quad("Ceiling", (-SIDE, h, BACK), (w, 0, 0), (0, 0, d), "White"),
        usda.quad("BackWall", (-SIDE, 0, BACK), (w, 0, 0), (0, h, 0), "White"),
        usda.quad("FrontWall", (SIDE, 0, FRONT), (-w, 0, 0), (0, h, 0), "White"),
        usda.quad("LeftWall", (-SIDE, 0, FRONT), (0, 0, -d), (0, h, 0), "Red"),
        usda.quad("RightWall", (SIDE, 0, BACK), (0, 0, d), (0, h, 0), "Green"),
    ]
    furniture = furniture or usda.box("Cupboard", (0.6, 1.2, 0.5), (-1.05, 0, -1.1), "White", turn=20)
    return usda.role("Real", "real", [*walls, furniture])


def diffuse_objects() -> str:
    """A white ball and a blue crate; synthetic."""
    objects = [
        usda.sphere("Ball", 0.25, (0.5, 0.25, -0.1), "White"),
        usda.box("Crate", (0.36, 0.56, 0.36), (-0.2, 0, -0.45), "Blue", turn=28),
    ]
    return usda.role("Synthetic", "synthetic", objects)


def room_camera() -> str:
    """Inside of the room, looking in and a little down."""
    return usda.camera("Camera", EYE, 0, EYE_PITCH, EYE_ANGLE)


def ceiling_light() -> str:
    """A square light just below the ceiling."""
    return usda.rect_light("Light", 0.9, 0.9, 13, usda.place((0, TOP - 0.01, 0.1), pitch=-90))


def room_materials(more: list[str] | None = None) -> str:
    """The walls' and objects' materials."""
    colours: dict[str, Vec3] = {"White": WHITE, "Red": RED, "Green": GREEN, "Blue": (0.12, 0.22, 0.55)}
    return usda.prim("Scope", "Materials", [*(usda.lambert(n, c) for n, c in colours.items()), *(more or [])])


def sky(width: int = 128, height: int = 64) -> np.ndarray:
    """A clear sky in UsdLux's lat-long layout: pale at the horizon, blue above, grey below, brighter around the sun."""
    elevation = (0.5 - (np.arange(height) + 0.5) / height) * np.pi
    around = (np.arange(width) + 0.5) / width * 2 * np.pi
    up = np.clip(np.sin(elevation), 0, 1)[:, None, None]
    down = np.clip(-elevation / 0.4, 0, 1)[:, None, None]
    horizon, zenith, below = np.array([0.72, 0.78, 0.85]), np.array([0.16, 0.31, 0.66]), np.array([0.2, 0.18, 0.16])
    colour = np.where(down > 0, horizon + (below - horizon) * down, horizon + (zenith - horizon) * up**0.45)
    glow = 1 + 0.35 * np.cos(around - 3.98)[None, :, None] * np.cos(elevation)[:, None, None]
    return np.broadcast_to(colour * glow, (height, width, 3)).astype(np.float16)


def paving(size: int = 64) -> np.ndarray:
    """Linear albedo of a metre of paving: 2x2 slabs of slightly different grey with darker joints."""
    y, x = np.mgrid[0:size, 0:size]
    slab = np.array([[0.40, 0.34], [0.36, 0.43]])[(2 * y) // size, (2 * x) // size]
    joint = np.minimum(x % (size // 2), y % (size // 2)) < 2
    grey = np.where(joint, 0.16, slab)[..., None]
    return (grey * np.array([1.0, 0.97, 0.9])).astype(np.float16)


def write_exr(path: Path, pixels: np.ndarray) -> None:
    """Half-float RGB, uncompressed."""
    import OpenEXR  # only this script needs it here, not those who ask for a stage's path

    header = {"compression": OpenEXR.NO_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"RGB": np.ascontiguousarray(pixels)}).write(str(path))


def write_all(folder: Path) -> list[Path]:
    """Write every stage and texture into ``folder``; returns the paths."""
    paths = []
    for name, text in stages().items():
        paths.append(folder / f"{name}.usda")
        paths[-1].write_text(text, encoding="utf-8", newline="\n")
    for name, pixels in textures().items():
        paths.append(folder / name)
        write_exr(paths[-1], pixels)
    return paths


if __name__ == "__main__":
    for written in write_all(Path(__file__).parent):
        print(written)
