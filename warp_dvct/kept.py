"""What a moving shot keeps between frames: results that depend on the static, real part of the scene alone, and, while
the objects stay as well, on all surfaces but no light.

Every pass that uses it does its real part by the same code whether the result is kept or not, and what is kept is not
written to but for the camera's view, out of which the next frame takes the objects again (``passes.gbuffer.View``): a
frame of a shot equals the same frame rendered from scratch bit for bit.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from warp_dvct.scene import Scene

Value = TypeVar("Value")


class Kept:
    """Named results, each valid for one key; a new key replaces the old result.

    Attributes:
        real: Key of the real scene, of all materials and of volume space; every result depends on it.
        objects: Key of the synthetic surfaces, for results that depend on these.
        lights: Key of each light of the frame, or none of any: a dome's texture takes long to hash, so who knows the
            keys gives them.
        reused: Per name that the frame asked for, whether the last request was served from what was kept.
    """

    def __init__(self) -> None:
        self.real = ""
        self.objects = ""
        self.lights: tuple[str, ...] = ()
        self.reused: dict[str, bool] = {}
        self._entries: dict[str, tuple[Any, Any]] = {}

    def begin_frame(self) -> None:
        """Forget what the last frame asked for, not what was kept."""
        self.reused = {}

    def light_key(self, scene: Scene, light: int) -> str:
        """Key of a light of the frame's scene."""
        return self.lights[light] if self.lights else content_key(scene.lights[light])

    def set_scene(self, real: str, objects: str) -> None:
        """Say which real scene and objects follow; another real scene than before frees all that was kept."""
        if real != self.real:
            self._entries.clear()
        self.real, self.objects = real, objects

    def get(self, name: str, key: Any, make: Callable[[], Value]) -> Value:
        """The result ``name`` for ``key``: the kept one, or that of ``make``, which is then kept."""
        value = self.last(name, key)
        if value is None:
            value = make()
            self.put(name, key, value)
        return value

    def last(self, name: str, key: Any) -> Any:
        """What :meth:`put` kept for ``key``, or None, for which anything else under that name is freed."""
        entry = self._entries.get(name)
        self.reused[name] = entry is not None and entry[0] == key
        if entry is not None and entry[0] == key:
            return entry[1]
        self._entries.pop(name, None)
        return None

    def put(self, name: str, key: Any, value: Any) -> None:
        """Keep ``value`` instead of what was kept under ``name``."""
        self._entries[name] = (key, value)


def content_key(*values: Any) -> str:
    """Hash of plain data: arrays, dataclasses, tuples, numbers, strings and None."""
    digest = hashlib.blake2b(digest_size=16)

    def feed(value: Any) -> None:
        if isinstance(value, np.ndarray):
            digest.update(f"{value.shape}{value.dtype.str}".encode())
            digest.update(np.ascontiguousarray(value).data)
        elif hasattr(value, "__dataclass_fields__"):
            for name in value.__dataclass_fields__:
                feed(getattr(value, name))
        elif isinstance(value, tuple):
            digest.update(str(len(value)).encode())
            for item in value:
                feed(item)
        else:
            digest.update(repr(value).encode() + b"\0")

    feed(values)
    return digest.hexdigest()
