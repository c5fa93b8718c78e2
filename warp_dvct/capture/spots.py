"""Where on a real surface something is to stand: at a picked pixel, in any frame of a capture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from warp_dvct.capture.intrinsics import Intrinsics
from warp_dvct.capture.stage import Capture
from warp_dvct.errors import OptionError

if TYPE_CHECKING:
    from pxr import Usd

PICK_RADIUS = 4.0  # pixels around the picked one in which a depth is looked for
FIRST_REACH = 0.03  # metres around the picked point to which the first plane is fitted
OFF_PLANE = 0.015  # metres; what is farther off the first plane is another surface
LEAST_POINTS = 12
SAME_WAY = float(np.cos(np.radians(20.0)))  # between a spot's normal and that of the surface it is moved onto
ROUNDS = 8  # of re-weighting; Tukey's biweight settles in fewer


@dataclass(frozen=True)
class Spot:
    """A place on a surface, in the world (metres, y up).

    Attributes:
        position: Point on the surface.
        normal: Unit, away from the surface.
        forward: Unit, along the surface: where the front of what stands there looks.
        roughness: Root mean square distance in metres of the surface around from its plane; 0 where not known.
    """

    position: np.ndarray
    normal: np.ndarray
    forward: np.ndarray
    roughness: float = 0.0


def make_spot(position: np.ndarray, normal: np.ndarray, toward: np.ndarray, roughness: float = 0.0) -> Spot:
    """A spot whose forward direction is that of ``toward``, laid onto the surface."""
    up = normal / np.linalg.norm(normal)
    flat = toward - up * (up @ toward)
    if np.linalg.norm(flat) < 1e-6:  # seen from straight above: any direction will do
        flat = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    return Spot(np.asarray(position, np.float64), up, flat / np.linalg.norm(flat), roughness)


def frame_index(capture: Capture, time: float) -> int:
    """The frame of a time code.

    Raises:
        OptionError: There is none; it says which there are.
    """
    nearest = int(np.argmin(np.abs(np.asarray(capture.times) - time)))
    if abs(capture.times[nearest] - time) > 1e-3:
        raise OptionError(
            f"--frame {time:g}: '{capture.path}' has frames {capture.times[0]:g} to {capture.times[-1]:g}"
        )
    return nearest


def spot_at_pixel(
    capture: Capture, index: int, pixel: tuple[float, float], *, reach: float = 0.1, surface: np.ndarray | None = None
) -> Spot:
    """The surface that a pixel of the photograph shows (of the depth image where there is no photograph).

    Args:
        index: Frame.
        pixel: Column and row, from 0.
        reach: Metres around the point over which the plane is fitted: about the radius of what is to stand there.
        surface: Points of the fused surface, world metres ``[n, 3]``; None takes the frame's own depth.
    Raises:
        OptionError: The pixel is outside, has no depth near it, or its surroundings are no surface.
    """
    lens, pose = camera_of(capture, index)
    if not (0 <= pixel[0] < lens.width and 0 <= pixel[1] < lens.height):
        raise OptionError(f"--pixel {pixel[0]:g},{pixel[1]:g} is outside of the {lens.width} x {lens.height} picture")
    depth_pose = known_pose(capture, index)
    local = depth_points(capture.rig.depth, capture.depth(index))
    points = local @ depth_pose[:3, :3].T + depth_pose[:3, 3]
    eye = pose[:3, 3]
    seen = lens.project((points - eye) @ pose[:3, :3])
    off = np.hypot(seen[:, 0] - pixel[0], seen[:, 1] - pixel[1])
    near = off <= PICK_RADIUS
    if not near.any():
        raise OptionError(
            f"--pixel {pixel[0]:g},{pixel[1]:g} of {capture.name(index)} has no depth within {PICK_RADIUS:g} pixels;"
            " pick another, or another --frame"
        )
    # The nearest of what projects there is what is seen.
    distance = np.linalg.norm(points - eye, axis=-1)
    front = near & (distance < distance[near].min() + 2.0 * OFF_PLANE)
    seed = points[np.flatnonzero(front)[np.argmin(off[front])]]
    where = f"--pixel {pixel[0]:g},{pixel[1]:g} of {capture.name(index)}"
    normal, offset, roughness = fit_plane(points if surface is None else surface, seed, reach, where)
    normal = normal if normal @ (eye - seed) > 0.0 else -normal
    # Where the pixel's own ray meets the plane.
    ray = pose[:3, :3] @ _direction(lens, pixel)
    position = eye + ray * (normal @ (offset - eye)) / (normal @ ray)
    return make_spot(position, normal, eye - position, roughness)


def snapped(spot: Spot, points: np.ndarray, reach: float) -> Spot:
    """A spot moved onto the measured surface below it; as it is, where nothing was measured that agrees with it.

    Args:
        points: Of the surface, world metres ``[n, 3]``.
        reach: Metres around the spot over which the plane is fitted.
    """
    near = points[np.linalg.norm(points - spot.position, axis=-1) < max(reach, FIRST_REACH)]
    if len(near) < LEAST_POINTS:
        return spot
    normal, offset, roughness = fit_plane(near, spot.position, reach, "the spot")
    normal = normal if normal @ spot.normal > 0.0 else -normal
    if normal @ spot.normal < SAME_WAY or np.linalg.norm(offset - spot.position) > 2.0 * OFF_PLANE:
        return spot
    return make_spot(offset, normal, spot.forward, roughness)


def camera_of(capture: Capture, index: int) -> tuple[Intrinsics, np.ndarray]:
    """Lens and pose of the camera whose pixels users see: the colour camera, or the depth camera without one."""
    known_pose(capture, index)
    color = capture.rig.color
    pose = capture.pose(index) if color is None else capture.color_pose(index)
    assert pose is not None
    return color or capture.rig.depth, pose


def known_pose(capture: Capture, index: int) -> np.ndarray:
    """A frame's pose.

    Raises:
        OptionError: It is not known.
    """
    pose = capture.pose(index)
    if pose is None:
        raise OptionError(f"the pose of {capture.name(index)} is not known; choose another --frame")
    return pose


def depth_points(lens: Intrinsics, depth: np.ndarray) -> np.ndarray:
    """Points of a depth image in the camera's space, ``[n, 3]`` metres; pixels without depth are left out."""
    rays = lens.rays()
    valid = (depth > 0.0) & np.isfinite(rays[..., 0])
    return rays[valid] * depth[valid][:, None].astype(np.float64)


def fit_plane(points: np.ndarray, seed: np.ndarray, reach: float, where: str) -> tuple[np.ndarray, np.ndarray, float]:
    """The plane through the surface around a point: normal (either sign), a point on it, and the rms distance from it.

    First to what is within 3 cm; then to all within ``reach`` that is near that plane, re-weighted by Tukey's biweight,
    so that other surfaces beside it do not tilt it.

    Raises:
        OptionError: Too few points.
    """
    distance = np.linalg.norm(points - seed, axis=-1)
    first = FIRST_REACH
    while (distance < first).sum() < LEAST_POINTS and first < max(reach, 4.0 * FIRST_REACH):
        first *= 1.5
    normal, center = _plane(points[distance < first], where)
    wide = points[(distance < max(reach, first)) & (np.abs((points - center) @ normal) < OFF_PLANE)]
    weight, off = np.ones(len(wide)), np.zeros(len(wide))
    for _ in range(ROUNDS):
        normal, center = _plane(wide, where, weight)
        off = (wide - center) @ normal
        scale = 4.685 * 1.4826 * max(float(np.median(np.abs(off))), 1e-6)
        weight = np.where(np.abs(off) < scale, (1.0 - (off / scale) ** 2) ** 2, 0.0)
    rms = float(np.sqrt((weight * off**2).sum() / weight.sum()))
    return normal, seed - normal * ((seed - center) @ normal), rms


def _plane(points: np.ndarray, where: str, weight: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    if len(points) < LEAST_POINTS:
        raise OptionError(f"{where}: only {len(points)} measured points are near it; pick what the frame measured")
    weight = np.ones(len(points)) if weight is None else weight
    center = weight @ points / weight.sum()
    spread = (points - center) * np.sqrt(weight)[:, None]
    return np.linalg.eigh(spread.T @ spread)[1][:, 0], center


def _direction(lens: Intrinsics, pixel: tuple[float, float]) -> np.ndarray:
    """Undistorted direction through a pixel, z = 1, in the camera's axes."""
    from warp_dvct.capture.intrinsics import undistort

    x, y = undistort(
        np.array((pixel[0] - lens.cx) / lens.fx), np.array((pixel[1] - lens.cy) / lens.fy), lens.distortion
    )
    return np.array([float(x), float(y), 1.0])


def fused_points(stage: Usd.Stage, capture: Capture) -> np.ndarray | None:
    """Vertices of the fused mesh beside the capture's cameras, world metres; None where there is none."""
    from pxr import UsdGeom

    from warp_dvct.usd.stage import world_frame

    prim = stage.GetPrimAtPath(f"{capture.depth_path.rpartition('/')[0]}/mesh")
    if not prim or not prim.IsA(UsdGeom.Mesh):
        return None
    points = np.asarray(UsdGeom.Mesh(prim).GetPointsAttr().Get(), np.float64)
    to_world = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(prim)) @ world_frame(stage)[1]
    return points @ to_world[:3, :3] + to_world[3, :3]
