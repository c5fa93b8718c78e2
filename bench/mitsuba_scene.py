"""A Scene as Mitsuba 3 sees it: meshes, materials, lights and camera; what has no counterpart is refused by name."""

from __future__ import annotations

import math
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from warp_dvct.errors import OptionError
from warp_dvct.scene import Camera, Light, LightKind, Material, Mesh, Role, Scene, Texture, Wrap

SUN_DISTANCE = 1.0e4  # metres at which a distant light of some angle is a disk
WRAPS = {Wrap.REPEAT: "repeat", Wrap.CLAMP: "clamp", Wrap.MIRROR: "mirror"}
LAMBERT = "diffuse"
GLOSSY = "principled (its diffuse albedo lowered by what our mean Fresnel reflection takes, not angle by angle)"


def describe_materials(scene: Scene) -> str:
    """How the scene's materials are mapped, for the line above the figures."""
    kinds = {LAMBERT if _is_lambert(m) else GLOSSY for m in _used(scene)}
    return " and ".join(sorted(kinds))


def mitsuba_description(
    mi: Any, scene: Scene, roles: Collection[Role], folder: Path, *, width: int, height: int, bounces: int, aov: bool
) -> dict[str, Any]:
    """What ``mi.load_dict`` takes. As in our pictures finite lights are not seen by the camera and pixels are boxes.

    Args:
        roles: Which meshes. folder: Takes the meshes as PLY. aov: Also albedo and normal, six channels after RGB.
    Raises:
        OptionError: Something in the scene has no counterpart; the message names it.
    """
    dome = any(light.kind == LightKind.DOME for light in scene.lights)
    path = {"type": "path", "max_depth": bounces + 2, "rr_depth": 100, "hide_emitters": not dome}
    integrator = {"type": "aov", "aovs": "albedo:albedo,normal:sh_normal", "image": path} if aov else path
    film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}}
    film |= {"pixel_format": "rgb", "component_format": "float32"}
    sensor = _sensor(mi, scene.camera) | {"film": film, "sampler": {"type": "independent"}}
    description: dict[str, Any] = {"type": "scene", "integrator": integrator, "sensor": sensor}
    for i, mesh in enumerate(scene.meshes):
        if mesh.role not in roles:
            continue
        for material in np.unique(mesh.materials):
            file = folder / f"mesh{i}_{material}.ply"
            _write_ply(file, mesh, mesh.materials == material)
            bsdf = _bsdf(mi, scene, scene.materials[material])
            smooth = mesh.corner_normals is not None
            description[file.stem] = {"type": "ply", "filename": str(file), "face_normals": not smooth, "bsdf": bsdf}
    for i, light in enumerate(scene.lights):
        description[f"light{i}"] = _emitter(mi, light)
    return description


def _sensor(mi: Any, camera: Camera) -> dict[str, Any]:
    if not math.isclose(camera.tan_left, -camera.tan_right) or not math.isclose(camera.tan_bottom, -camera.tan_top):
        raise OptionError(f"{camera.path or 'the camera'}: Mitsuba is only given centred cameras; remove the offset")
    to_world = np.asarray(camera.to_world) @ np.diag([-1.0, 1.0, -1.0, 1.0])  # it looks along +z with x to the left
    fov = 2 * math.degrees(math.atan(camera.tan_right))
    clip = {"near_clip": float(camera.near), "far_clip": float(camera.far)}
    return {"type": "perspective", "fov": fov, "fov_axis": "x", "to_world": mi.ScalarTransform4f(to_world), **clip}


def _write_ply(file: Path, mesh: Mesh, chosen: np.ndarray) -> None:
    """Every corner a vertex of its own, with shading normal and texture coordinates where there are any."""
    if mesh.corner_colors is not None:
        raise OptionError(f"{mesh.path}: vertex colours are not mapped to Mitsuba")
    corners = [mesh.points[mesh.triangles[chosen]]]
    names = ["x", "y", "z"]
    if mesh.corner_normals is not None:
        corners.append(mesh.corner_normals[chosen])
        names += ["nx", "ny", "nz"]
    if mesh.corner_uvs is not None:
        corners.append(mesh.corner_uvs[chosen])
        names += ["u", "v"]
    vertices = np.concatenate(corners, -1).reshape(-1, len(names)).astype("<f4")
    faces = np.zeros(len(vertices) // 3, [("n", "u1"), ("index", "<i4", 3)])
    faces["n"], faces["index"] = 3, np.arange(len(vertices)).reshape(-1, 3)
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    head += [f"property float {name}" for name in names]
    head += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    file.write_bytes("\n".join(head).encode() + vertices.tobytes() + faces.tobytes())


def _used(scene: Scene) -> list[Material]:
    return [scene.materials[i] for i in sorted({int(i) for m in scene.meshes for i in np.unique(m.materials)})]


def _is_lambert(material: Material) -> bool:
    if material.specular_color is not None:
        return max(material.specular_color) == 0
    return material.metallic == 0 and material.ior == 1


def _bsdf(mi: Any, scene: Scene, material: Material) -> dict[str, Any]:
    if _is_lambert(material):
        return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": _color(mi, scene, material, 1.0)}}
    if material.roughness_texture is not None:
        raise OptionError(f"{material.name}: a roughness texture is not mapped to Mitsuba")
    f0, metallic = ((material.ior - 1) / (material.ior + 1)) ** 2, float(material.metallic)
    if material.specular_color is not None:
        f0, metallic = min(max(float(np.mean(material.specular_color)), 0.0), 0.9), 0.0
    # Ours takes (1 - F) towards light and eye from the diffuse lobe; the cosine-weighted mean of Schlick's F is this.
    mean_fresnel = f0 + (min(50 * f0, 1.0) - f0) / 21
    color = _color(mi, scene, material, metallic + (1 - metallic) * (1 - mean_fresnel) ** 2)
    lobes = {"roughness": float(material.roughness), "metallic": metallic, "eta": _eta(f0)}
    return {"type": "twosided", "bsdf": {"type": "principled", "base_color": color, **lobes}}


def _eta(f0: float) -> float:
    """Index of refraction whose reflectance at normal incidence is ``f0``; Mitsuba takes none below 1."""
    return (1 + math.sqrt(f0)) / (1 - math.sqrt(f0)) if f0 > 0 else 1.0 + 1e-3


def _color(mi: Any, scene: Scene, material: Material, scale: float) -> dict[str, Any]:
    if material.base_color_texture is not None:
        return _bitmap(mi, scene.textures[material.base_color_texture], scale)
    return {"type": "rgb", "value": [scale * float(v) for v in material.base_color]}


def _bitmap(mi: Any, texture: Texture, scale: float) -> dict[str, Any]:
    if texture.wrap_s != texture.wrap_t or texture.wrap_s not in WRAPS:
        raise OptionError(f"{texture.name}: wrap modes that differ, or black, are not mapped to Mitsuba")
    pixels = mi.Bitmap(np.ascontiguousarray(texture.pixels * scale, np.float32))
    return {"type": "bitmap", "bitmap": pixels, "raw": True, "wrap_mode": WRAPS[texture.wrap_s]}


def _emitter(mi: Any, light: Light) -> dict[str, Any]:
    transform = mi.ScalarTransform4f
    rgb = {"type": "rgb", "value": [float(v) for v in light.radiance]}
    area = {"type": "area", "radiance": rgb}
    black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
    position, direction = [float(v) for v in light.position], np.asarray(light.direction, float)
    if light.cone_angle < math.pi:
        raise OptionError(f"{light.path}: Mitsuba's spot has neither a radius nor this falloff; leave the stage out")
    if light.kind == LightKind.POINT:
        return {"type": "point", "position": position, "intensity": rgb}
    if light.kind == LightKind.SPHERE:
        return {"type": "sphere", "center": position, "radius": float(light.radius), "emitter": area, "bsdf": black}
    if light.kind in (LightKind.RECT, LightKind.DISK):
        columns = np.eye(4)
        columns[:3] = np.stack([light.axis_x, light.axis_y, direction, light.position], 1)
        if np.linalg.det(columns) < 0:
            columns[:3, 0] *= -1  # the emitting side is that of z
        shape = "rectangle" if light.kind == LightKind.RECT else "disk"
        return {"type": shape, "to_world": transform(columns), "emitter": area, "bsdf": black}
    if light.kind == LightKind.DISTANT and light.angle == 0.0:
        return {"type": "directional", "direction": direction.tolist(), "irradiance": rgb}
    if light.kind == LightKind.DISTANT:
        up = [0.0, 0.0, 1.0] if abs(direction[2]) < 0.9 else [1.0, 0.0, 0.0]
        look = transform().look_at((-direction * SUN_DISTANCE).tolist(), [0, 0, 0], up)
        to_world = look @ transform().scale(SUN_DISTANCE * math.tan(light.angle / 2))
        return {"type": "disk", "to_world": to_world, "emitter": area, "bsdf": black}
    if light.texture is None:
        return {"type": "constant", "radiance": rgb}
    turn = np.eye(4)
    turn[:3, :3] = light.rotation
    pixels = mi.Bitmap(np.ascontiguousarray(light.texture * np.asarray(light.radiance, np.float32)))
    return {"type": "envmap", "bitmap": pixels, "to_world": transform(turn)}
