"""Opening stages, their world frame, and frame ranges."""

from __future__ import annotations

import os
import re
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_dvct.errors import OptionError, StageError
from warp_dvct.usd.context import Notices

if TYPE_CHECKING:
    from pxr import Usd

NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)"
FRAME_ROUNDING = 1e-6  # strides ahead of the last frame that still count as reaching it
MAX_FRAMES = 1_000_000


def open_stage(source: str | Path | Usd.Stage) -> Usd.Stage:
    """Open a stage with its payloads, or pass one through.

    Raises:
        StageError: The file is missing, or is not USD that can be read.
    """
    from pxr import Tf, Usd

    if isinstance(source, Usd.Stage):
        return source
    name = os.fspath(source)
    if "://" not in name and not os.path.exists(name):
        raise StageError(f"stage '{name}' does not exist; check the path")
    if os.path.isdir(name):
        raise StageError(f"stage '{name}' is a folder; give the .usd, .usda, .usdc or .usdz file in it")
    with quiet_diagnostics():
        try:
            return Usd.Stage.Open(name)
        except Tf.ErrorException as error:
            raise StageError(f"stage '{name}' cannot be read: {_reason(error)}; is it a USD file?") from error


@contextmanager
def quiet_diagnostics():
    """Keep USD's own warnings off stderr; what matters of them is reported as notices."""
    from pxr import UsdUtils

    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        yield
    finally:
        delegate.TakeUncoalescedDiagnostics()
        del delegate


def _reason(error: Any) -> str:
    """The first quoted message of a Tf error, without source lines."""
    parts = str(error).split("'")
    return parts[3] if len(parts) > 3 else str(error).strip()


def name_of(stage: Usd.Stage) -> str:
    """The stage's file, for messages."""
    layer = stage.GetRootLayer()
    return layer.realPath or layer.identifier


def note_composition_errors(stage: Usd.Stage, notices: Notices) -> None:
    """List references, payloads, sublayers and MaterialX files that could not be composed, at the prim they are on."""
    for error in stage.GetCompositionErrors():
        path = getattr(error, "rootSite", None)
        notices.add(path.path if path is not None else "/", f"not composed: {error}")


def world_frame(stage: Usd.Stage) -> tuple[float, np.ndarray]:
    """Metres per unit, and the 4x4 for row vectors from stage space to metres with y up.

    A z-up stage is turned by -90 degrees about x: (x, y, z) becomes (x, z, -y).

    Raises:
        StageError: ``metersPerUnit`` is not positive, or ``upAxis`` neither Y nor Z.
    """
    from pxr import UsdGeom

    metres = float(UsdGeom.GetStageMetersPerUnit(stage))
    if not (metres > 0.0 and np.isfinite(metres)):
        raise StageError(f"{name_of(stage)}: metersPerUnit is {metres}; it must be positive")
    up = UsdGeom.GetStageUpAxis(stage)
    if up not in (UsdGeom.Tokens.y, UsdGeom.Tokens.z):
        raise StageError(f"{name_of(stage)}: upAxis is {up}; it must be Y or Z")
    frame = np.eye(4)
    if up == UsdGeom.Tokens.z:
        frame[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    frame[:3, :3] *= metres
    return metres, frame


def frame_range(source: str | Path | Usd.Stage) -> tuple[float, float, float] | None:
    """First and last time code and frames per second of a stage, or None where it authors no range.

    Only the root layer stack is read: payloads stay unloaded.
    """
    stage = _open_unloaded(source) if isinstance(source, (str, os.PathLike)) else source
    if not stage.HasAuthoredTimeCodeRange():
        return None
    return stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetFramesPerSecond()


def _open_unloaded(source: str | os.PathLike) -> Usd.Stage:
    from pxr import Sdf, Tf, Usd

    name = os.fspath(source)
    if "://" not in name and not os.path.exists(name):
        raise StageError(f"stage '{name}' does not exist; check the path")
    with quiet_diagnostics():
        try:
            layer = Sdf.Layer.FindOrOpen(name)
            if layer is None:
                raise StageError(f"stage '{name}' cannot be read; is it a USD file?")
            return Usd.Stage.OpenMasked(layer, Usd.StagePopulationMask(), load=Usd.Stage.LoadNone)
        except Tf.ErrorException as error:
            raise StageError(f"stage '{name}' cannot be read: {_reason(error)}; is it a USD file?") from error


def stage_frames(spec: str) -> list[float]:
    """Time codes of a frame specification, as usdrecord's ``--frames``: ``"1:10x2,20"`` is 1, 3, 5, 7, 9, 20.

    Parsed here: UsdUtils.TimeCodeRange crashes on some malformed specifications.

    Raises:
        OptionError: A part is neither ``FRAME``, ``FIRST:LAST`` nor ``FIRST:LASTxSTRIDE``, or the stride leads away
            from the last frame.
    """
    frames: dict[float, None] = {}
    for part in spec.split(","):
        match = re.fullmatch(rf"({NUMBER})(?::({NUMBER})(?:x({NUMBER}))?)?", part.strip())
        if match is None:
            raise OptionError(
                f"--frames {spec!r}: {part.strip()!r} is not understood; write 5, 1:10 or 1:10x2, separated by commas"
            )
        first = float(match[1])
        last = float(match[2]) if match[2] else first
        stride = float(match[3]) if match[3] else (1.0 if last >= first else -1.0)
        if stride == 0.0 or (last - first) * stride < 0.0:
            raise OptionError(f"--frames {spec!r}: a stride of {stride:g} never leads from {first:g} to {last:g}")
        count = int((last - first) / stride + FRAME_ROUNDING) + 1
        if count > MAX_FRAMES:
            raise OptionError(f"--frames {spec!r}: {count} frames; give at most {MAX_FRAMES} at a time")
        frames.update(dict.fromkeys(first + k * stride for k in range(count)))
    return list(frames)
