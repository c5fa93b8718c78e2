"""Starting Warp without the lines that its native library writes straight to stderr."""

from __future__ import annotations

import os
import sys
import tempfile

NO_DRIVER = b"Warp CUDA warning: Could not find or load the NVIDIA CUDA driver"


def start_warp(device: str) -> None:
    """Initialise Warp; that there is no CUDA driver is said only where CUDA is asked for. Other lines pass."""
    from warp_dvct.launch import find_device

    sys.stderr.flush()
    kept = os.dup(2)
    with tempfile.TemporaryFile() as lines:
        os.dup2(lines.fileno(), 2)
        try:
            find_device("cpu")
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            lines.seek(0)
            for line in lines:
                if not line.startswith(NO_DRIVER) or device.startswith("cuda"):
                    os.write(2, line)
