"""Packages that only some commands need, loaded when they are."""

from __future__ import annotations

import ctypes
from importlib.util import find_spec
from typing import Any

from warp_dvct.errors import DvctError


def load_open3d(need: str, error: type[DvctError] = DvctError) -> Any:
    """The module ``open3d``.

    Args:
        need: What misses it and what to do, for the message.
        error: What to raise.
    Raises:
        DvctError: Of type ``error``: Open3D is not installed or cannot be loaded.
    """
    try:
        # Open3D's wheels expect the system's libusb; the pip package's serves as well once it is loaded.
        if find_spec("libusb_package") is not None:
            import libusb_package

            ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
        import open3d
    except (ImportError, OSError) as failure:
        raise error(f"{need} ({failure})") from failure
    return open3d
