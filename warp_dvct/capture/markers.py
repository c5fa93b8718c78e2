"""Square fiducial markers (ArUco, AprilTag): where they are, and where the camera is that sees them.

A marker's axes: x to its right, y to its top, z out of it. Corners are where the edges meet, found in linear light:
OpenCV's own, to fractions of a pixel of sRGB codes, put markers 1.5 % too far away, these 0.02 %.

Garrido-Jurado et al. 2014, "Automatic Generation and Detection of Highly Reliable Fiducial Markers"; Collins and
Bartoli 2014, "Infinitesimal Plane-Based Pose Estimation".
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from warp_dvct.capture.intrinsics import COEFFICIENTS, Intrinsics
from warp_dvct.capture.registration import sample
from warp_dvct.capture.spots import Spot, depth_points, known_pose, make_spot, snapped
from warp_dvct.capture.stage import Capture
from warp_dvct.capture.tracking import Track
from warp_dvct.errors import DvctError, OptionError
from warp_dvct.image import srgb_to_linear

LINEAR = srgb_to_linear(np.arange(256) / 255.0)
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
MOST_ERROR = 2.0  # pixels rms between a marker's corners and where its pose puts them
LEAST_EDGE = 12.0  # pixels: smaller markers have no reliable pose
AMBIGUOUS = 1.5  # of the reprojection errors of the two poses that a square may have: nearer than that, it is not used
REFINEMENTS = 2  # of corners by edges
FARTHEST = 3.0  # pixels that they move a corner; more is another edge
WIDEST = 3.0  # pixels to both sides of an edge that are looked at
ROUNDS = 3  # of poses of frames and of markers in turns


@dataclass(frozen=True)
class Sighting:
    """A marker in a picture.

    Attributes:
        id: Its number in the dictionary.
        corners: Top left, top right, bottom right, bottom left as it is printed, pixels ``[4, 2]``.
        pose: Marker to camera (OpenCV axes), 4x4, metres.
        error: Root mean square distance in pixels of the corners from where the pose puts them.
        ambiguous: Whether the mirrored pose fits about as well.
    """

    id: int
    corners: np.ndarray
    pose: np.ndarray
    error: float
    ambiguous: bool


def load_cv2() -> Any:
    """OpenCV with its markers.

    Raises:
        OptionError: It is not installed, or too old.
    """
    try:
        import cv2
    except ImportError as error:
        raise OptionError(f"OpenCV is needed for markers: pip install 'warp-dvct[markers]' ({error})") from error
    if not hasattr(cv2, "aruco") or not hasattr(cv2.aruco, "ArucoDetector"):
        raise OptionError("this OpenCV has no ArucoDetector: pip install 'opencv-python-headless>=4.8'")
    return cv2


def marker_dictionary(cv2: Any, name: str) -> Any:
    """One of OpenCV's dictionaries.

    Raises:
        OptionError: No such name.
    """
    names = sorted(n for n in dir(cv2.aruco) if n.startswith("DICT_"))
    if name not in names:
        raise OptionError(f"there is no marker dictionary '{name}'; choose one of {', '.join(names)}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def corner_points(size: float) -> np.ndarray:
    """A marker's corners in its own axes, in the order in which they are detected, metres ``[4, 3]``."""
    half = 0.5 * size
    return np.array([[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]])


def find_markers(image: np.ndarray, lens: Intrinsics, size: float, dictionary: str = "DICT_4X4_50") -> list[Sighting]:
    """Markers of a picture with their poses, by number.

    Args:
        image: sRGB uint8 ``[h, w, 3]``.
        lens: Of the picture, with its distortion.
        size: Edge of the markers' black squares in metres.
    Raises:
        OptionError: OpenCV is missing, or there is no such dictionary.
    """
    cv2 = load_cv2()
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(marker_dictionary(cv2, dictionary), parameters)
    corners, ids, _ = detector.detectMarkers(cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY))
    bits = detector.getDictionary().markerSize + 2 * parameters.markerBorderBits
    light = (LINEAR[image] @ LUMINANCE).astype(np.float32)
    found = []
    for four, number in zip(corners, [] if ids is None else np.asarray(ids).ravel(), strict=True):
        refined = _refined(light, np.asarray(four, np.float64).reshape(4, 2), bits)
        sighting = _sighting(cv2, int(number), refined, lens, size)
        if sighting is not None:
            found.append(sighting)
    return sorted(found, key=lambda s: s.id)


def _refined(light: np.ndarray, corners: np.ndarray, bits: int) -> np.ndarray:
    """Corners ``[4, 2]`` to hundredths of a pixel: where the four edges of the black meet, in linear light.

    A pixel that an edge halves has half of the light but three quarters of the sRGB code: in codes, edges lie 0.29
    pixels inside the black. And the corner of a square is round where pixels are averaged, which draws OpenCV's corner
    inside by 0.14 pixels more. A marker 40 pixels wide so seemed 1.5 % farther away; its edges do not know of both.

    Args:
        light: Luminance, linear, ``[h, w]``.
        corners: As detected. bits: Cells along an edge, the border's too.
    """
    for _ in range(REFINEMENTS):
        lines = [_edge(light, corners[k], corners[(k + 1) % 4], bits) for k in range(4)]
        met = [np.cross(lines[k - 1], lines[k]) for k in range(4)]
        if any(abs(m[2]) < 1e-6 for m in met):
            return corners
        found = np.array([m[:2] / m[2] for m in met])
        if not (np.linalg.norm(found - corners, axis=-1) < FARTHEST).all():
            return corners
        corners = found
    return corners


def _edge(light: np.ndarray, a: np.ndarray, b: np.ndarray, bits: int) -> np.ndarray:
    """The line ``x l0 + y l1 + l2 = 0`` of the edge from about ``a`` to ``b``, clockwise around the black: through the
    centroids of the light's slope across it, which averaging over pixels does not move."""
    length = float(np.linalg.norm(b - a))
    along = (b - a) / length
    outward = np.array([along[1], -along[0]])
    reach = float(np.clip(0.5 * length / bits, 1.5, WIDEST))
    s, t = np.linspace(0.1, 0.9, max(8, int(length))), np.arange(-reach, reach + 0.125, 0.25)
    at = a + s[:, None, None] * (b - a) + t[:, None] * outward
    slope = np.maximum(np.diff(sample(light[..., None], at)[0][..., 0].astype(np.float64), axis=1), 0.0)
    total = slope.sum(1)
    weight = total * (total > 0.3 * np.median(total)) + 1e-12
    offset = (slope * 0.5 * (t[1:] + t[:-1])).sum(1) / np.maximum(total, 1e-12)
    bend, shift = 0.0, 0.0
    for _ in range(2):
        bend, shift = np.polyfit(s, offset, 1, w=np.sqrt(weight))
        off = np.abs(offset - bend * s - shift)
        weight = weight * (off <= 3.0 * np.median(off) + 1e-3) + 1e-12
    ends = [a + shift * outward, b + (bend + shift) * outward]
    return np.cross([*ends[0], 1.0], [*ends[1], 1.0])


def _sighting(cv2: Any, number: int, corners: np.ndarray, lens: Intrinsics, size: float) -> Sighting | None:
    edges = np.linalg.norm(corners - np.roll(corners, 1, 0), axis=-1)
    if edges.min() < LEAST_EDGE:
        return None
    done, turns, shifts, errors = cv2.solvePnPGeneric(
        corner_points(size), corners, lens.K, _coefficients(lens), flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    if not done:
        return None
    errors = np.asarray(errors, np.float64).ravel()
    best = int(np.argmin(errors))
    if not errors[best] < MOST_ERROR:
        return None
    ambiguous = len(errors) > 1 and float(errors.max()) < AMBIGUOUS * max(float(errors[best]), 0.05)
    return Sighting(number, corners, _matrix(cv2, turns[best], shifts[best]), float(errors[best]), ambiguous)


def _matrix(cv2: Any, turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], np.asarray(shift).ravel()
    return pose


def _coefficients(lens: Intrinsics) -> np.ndarray:
    return np.pad(np.asarray(lens.distortion, np.float64), (0, len(COEFFICIENTS) - len(lens.distortion)))


def spot_on_marker(
    capture: Capture,
    number: int,
    size: float,
    dictionary: str = "DICT_4X4_50",
    *,
    surface: np.ndarray | None = None,
) -> Spot:
    """The centre of a marker, from all frames that see it; what stands there looks to the marker's lower edge.

    It is moved onto the measured surface, which objects are to stand on.

    Args:
        surface: Points of the fused surface, world metres ``[n, 3]``; None takes depth of the frame that is nearest.
    Raises:
        OptionError: No frame with a pose sees the marker; it lists those that are seen.
    """
    found: list[tuple[int, np.ndarray, float]] = []
    others: set[int] = set()
    for index in capture:
        pose, seen = capture.color_pose(index), _seen(capture, index, size, dictionary)
        others |= {s.id for s in seen}
        found += [
            (index, pose @ s.pose, float(np.linalg.norm(s.pose[:3, 3])))
            for s in seen
            if s.id == number and pose is not None and not s.ambiguous
        ]
    if not found:
        listed = ", ".join(map(str, sorted(others))) or "none"
        raise OptionError(
            f"--marker {number} is in no frame with a pose of '{capture.path}' (markers of {dictionary} that are seen:"
            f" {listed}); check --dictionary and --marker-size"
        )
    placed, distance = np.array([p for _, p, _ in found]), np.array([d for _, _, d in found])
    weight = 1.0 / distance**2  # errors grow with the square of the distance
    center = np.median(placed[:, :3, 3], axis=0) if len(placed) > 2 else weight @ placed[:, :3, 3] / weight.sum()
    near = np.linalg.norm(placed[:, :3, 3] - center, axis=-1)
    weight = weight * (near <= max(3.0 * float(np.median(near)), 0.25 * size))
    mean = np.einsum("i,ijk->jk", weight / weight.sum(), placed)
    spot = make_spot(mean[:3, 3], mean[:3, 2], -mean[:3, 1])
    if surface is None:
        index = found[int(np.argmin(distance))][0]
        pose = known_pose(capture, index)
        local = depth_points(capture.rig.depth, capture.depth(index))
        return snapped(spot, local @ pose[:3, :3].T + pose[:3, 3], size)
    return snapped(spot, surface, size)


def _seen(capture: Capture, index: int, size: float, dictionary: str) -> list[Sighting]:
    """A frame's markers; none where it has no usable photograph."""
    try:
        image = capture.color(index)
    except DvctError:
        return []
    lens = capture.rig.color
    return [] if image is None or lens is None else find_markers(image, lens, size, dictionary)


def track_by_markers(
    capture: Capture,
    size: float,
    dictionary: str = "DICT_4X4_50",
    *,
    progress: Callable[[str, float], None] | None = None,
) -> Track:
    """Every frame's pose from the markers that it sees.

    Where the markers are need not be known: the one that most frames see is the origin, its plane level; the others are
    placed by the frames that see several. Frames and markers are then refined in turns.

    Returns:
        Poses of the depth camera in the stage's world: the first marker at its origin, z out of it as y, up.
    Raises:
        OptionError: OpenCV is missing, or no frame sees a marker.
    """
    cv2 = load_cv2()
    report = progress or (lambda name, share: None)
    sightings: list[list[Sighting]] = []
    for index in capture:
        sightings.append(_seen(capture, index, size, dictionary))
        report("markers", (index + 1) / len(capture))
    count: dict[int, int] = {}
    for seen in sightings:
        for s in seen:
            count[s.id] = count.get(s.id, 0) + (not s.ambiguous)
    if not any(count.values()):
        raise OptionError(f"no frame of '{capture.path}' sees a marker of {dictionary}; check --dictionary")
    lens = capture.rig.color
    assert lens is not None
    first = max(count, key=lambda k: (count[k], -k))
    level = np.array([[1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, -1.0, 0, 0], [0, 0, 0, 1.0]])
    markers = {first: level}
    poses = _grow(cv2, lens, size, sightings, markers)
    for _ in range(ROUNDS):
        _place_markers(sightings, poses, markers, first)
        poses = [_pose(cv2, lens, size, seen, markers) for seen in sightings]
    to_depth = capture.rig.depth_to_color
    lost = {
        i: f"{capture.name(i)}: lost: it sees no marker that other frames connect to the first"
        for i, pose in enumerate(poses)
        if pose is None
    }
    return Track(tuple(None if pose is None else pose @ to_depth for pose in poses), lost)


def _grow(
    cv2: Any, lens: Intrinsics, size: float, sightings: Sequence[list[Sighting]], markers: dict[int, np.ndarray]
) -> list[np.ndarray | None]:
    """Poses of frames that see a placed marker; these place further markers, until nothing is added."""
    while True:
        poses = [_pose(cv2, lens, size, seen, markers) for seen in sightings]
        before = len(markers)
        for seen, pose in zip(sightings, poses, strict=True):
            for s in seen:
                if pose is not None and s.id not in markers and not s.ambiguous:
                    markers[s.id] = pose @ s.pose
        if len(markers) == before:
            return poses


def _pose(
    cv2: Any, lens: Intrinsics, size: float, seen: Sequence[Sighting], markers: dict[int, np.ndarray]
) -> np.ndarray | None:
    """Colour camera to world from all corners of placed markers; None where it sees none, or they contradict."""
    known = [s for s in seen if s.id in markers]
    clear = [s for s in known if not s.ambiguous]
    if not clear and len(known) < 2:
        return None
    local = corner_points(size)
    points = np.concatenate([local @ markers[s.id][:3, :3].T + markers[s.id][:3, 3] for s in known])
    pixels = np.concatenate([s.corners for s in known])
    start = min(clear or known, key=lambda s: s.error)
    guess = start.pose @ np.linalg.inv(markers[start.id])
    done, turn, shift = cv2.solvePnP(
        points,
        pixels,
        lens.K,
        _coefficients(lens),
        cv2.Rodrigues(guess[:3, :3])[0],
        guess[:3, 3].copy(),
        True,
        cv2.SOLVEPNP_ITERATIVE,
    )
    if not done:
        return None
    seen_at = cv2.projectPoints(points, turn, shift, lens.K, _coefficients(lens))[0].reshape(-1, 2)
    if np.sqrt(((seen_at - pixels) ** 2).sum(-1).mean()) > 2.0 * MOST_ERROR:
        return None
    return np.linalg.inv(_matrix(cv2, turn, shift))


def _place_markers(
    sightings: Sequence[list[Sighting]], poses: Sequence[np.ndarray | None], markers: dict[int, np.ndarray], first: int
) -> None:
    """Each marker's mean over the frames that see it; the first one stays where it is."""
    for number in markers:
        placed = [
            (pose @ s.pose, 1.0 / np.linalg.norm(s.pose[:3, 3]) ** 2)
            for seen, pose in zip(sightings, poses, strict=True)
            for s in seen
            if s.id == number and pose is not None and not s.ambiguous
        ]
        if number == first or not placed:
            continue
        weight = np.array([w for _, w in placed]) / sum(w for _, w in placed)
        mean = np.eye(4)
        mean[:3, 3] = weight @ np.array([p[:3, 3] for p, _ in placed])
        u, _, v = np.linalg.svd(np.einsum("i,ijk->jk", weight, np.array([p[:3, :3] for p, _ in placed])))
        mean[:3, :3] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
        markers[number] = mean
