"""Insert synthetic objects into real scenes with physically convincing light.

:func:`relight` does it in one call; :class:`Relighter` keeps what does not change between frames. Names are loaded when
they are first used: importing the package starts neither Warp nor USD.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from warp_dvct.errors import DeviceError, DvctError, FileError, OptionError, StageError
    from warp_dvct.layers import Layers
    from warp_dvct.plan import Plan
    from warp_dvct.relighter import Relighter, relight
    from warp_dvct.scene import Scene

    __version__: str

__all__ = [
    "DeviceError",
    "DvctError",
    "FileError",
    "Layers",
    "OptionError",
    "Plan",
    "Relighter",
    "Scene",
    "StageError",
    "__version__",
    "relight",
]

_HOMES = {
    "errors": ("DeviceError", "DvctError", "FileError", "OptionError", "StageError"),
    "layers": ("Layers",),
    "plan": ("Plan",),
    "relighter": ("Relighter", "relight"),
    "scene": ("Scene",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("warp-dvct")
    if name not in _HOME_OF:
        raise AttributeError(f"module 'warp_dvct' has no attribute '{name}'")
    value = getattr(importlib.import_module(f"warp_dvct.{_HOME_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
