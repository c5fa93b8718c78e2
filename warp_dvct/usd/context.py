"""What every part of the reader shares: the stage, the time, the list of what was not modelled."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_dvct.scene import Notice

if TYPE_CHECKING:
    from pxr import Usd


class Notices:
    """Collects notices, each message once per prim path, in the order in which they were met."""

    def __init__(self) -> None:
        self._seen: dict[tuple[str, str], Notice] = {}

    def add(self, path: Any, message: str) -> None:
        """Note that ``message`` holds for the prim at ``path``; it becomes one line."""
        key = (str(path), " ".join(message.split()))
        self._seen.setdefault(key, Notice(*key))

    def all(self) -> tuple[Notice, ...]:
        """Everything noted so far."""
        return tuple(self._seen.values())


@dataclass(frozen=True)
class Context:
    """One reading of a stage.

    Attributes:
        stage: The composed stage.
        time: Time code at which attributes are read.
        metres: Metres per scene unit.
        to_world: 4x4 float64 for row vectors, from stage space to world space (metres, y up).
        notices: Collector.
        levels: How often subdivision surfaces are refined; 0 draws their control meshes.
    """

    stage: Usd.Stage
    time: Usd.TimeCode
    metres: float
    to_world: np.ndarray
    notices: Notices = field(default_factory=Notices)
    levels: int = 2


def matrix(value: Any) -> np.ndarray:
    """A Gf.Matrix4d as float64 ``[4, 4]``; USD multiplies row vectors from the left."""
    return np.array(value, dtype=np.float64)


def transform_points(points: np.ndarray, m: np.ndarray) -> np.ndarray:
    """Row vectors ``[n, 3]`` through an affine ``[4, 4]``."""
    return points @ m[:3, :3] + m[3, :3]


def shared_path(prim: Usd.Prim) -> str:
    """The path under which all native instances share a prim; its own path where it is in no instance."""
    return str(prim.GetPrimInPrototype().GetPath() if prim.IsInstanceProxy() else prim.GetPath())
