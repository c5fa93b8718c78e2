"""Camera paths for simulated captures; poses are camera (OpenCV axes) to world, 4x4."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

HAND_SWAY = 0.06  # of the distance to what is looked at: how far a hand wanders to each side
HAND_TURN = np.radians(3.0)
HAND_PERIOD = 90.0  # frames of the slowest sway


def look_at(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """A level camera at ``eye`` that looks at ``target``."""
    forward = target - eye
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, up)
    right = right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = right, np.cross(forward, right), forward, eye
    return pose


def orbit(start: np.ndarray, distance: float, count: int, arc: float) -> list[np.ndarray]:
    """An arc about the vertical axis through the point at ``distance`` in front of ``start``.

    Args:
        start: Pose at the arc's middle.
        distance: Metres to what is looked at.
        count: Frames.
        arc: Angle from the first frame to the last [rad].
    """
    up = np.array([0.0, 1.0, 0.0])
    target = start[:3, 3] + distance * start[:3, 2]
    poses = []
    for angle in np.linspace(-0.5 * arc, 0.5 * arc, count) if count > 1 else [0.0]:
        turned = _about(up, angle) @ (start[:3, 3] - target)
        poses.append(look_at(target + turned, target, up))
    return poses


def handheld(start: np.ndarray, distance: float, count: int, seed: int) -> list[np.ndarray]:
    """A camera held by hand: smooth sways of place and of direction, each a sum of three sines that start at 0.

    Args:
        start: Pose of the first frame.
        distance: Metres to what is looked at; it scales the sways.
        count: Frames.
        seed: Decides the sines' speeds.
    """
    rng = np.random.default_rng(seed)
    speed = 2.0 * np.pi / HAND_PERIOD * rng.uniform(0.7, 3.0, (6, 3))
    size = rng.uniform(0.5, 1.0, (6, 3)) / np.array([1.0, 2.0, 4.0])
    sign = rng.choice([-1.0, 1.0], (6, 1))
    poses = []
    for frame in range(count):
        sway = (sign * size * np.sin(speed * frame)).sum(-1)
        turn = _about(np.array([1.0, 0.0, 0.0]), HAND_TURN * sway[3])
        turn = turn @ _about(np.array([0.0, 1.0, 0.0]), HAND_TURN * sway[4])
        turn = turn @ _about(np.array([0.0, 0.0, 1.0]), 0.5 * HAND_TURN * sway[5])
        step = np.eye(4)
        step[:3, :3] = turn
        step[:3, 3] = HAND_SWAY * distance * sway[:3]
        poses.append(start @ step)
    return poses


def level(pose: np.ndarray) -> np.ndarray:
    """The pose with its axes made exactly orthonormal."""
    u, _, vt = np.linalg.svd(pose[:3, :3])
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = u @ vt, pose[:3, 3]
    return out


def spread(codes: Sequence[float], count: int) -> list[float]:
    """``count`` time codes spread evenly over the first to the last of ``codes``."""
    return np.linspace(codes[0], codes[-1], count).tolist() if count > 1 else [codes[0]]


def _about(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rodrigues' rotation about a unit axis."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
