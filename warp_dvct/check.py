"""``--check``: after each kernel, is every number it wrote finite and within the range that its name promises?

Off, it costs one comparison a launch. On, it costs about as much as the rendering, and changes no result: fresh arrays
are filled with :data:`UNWRITTEN`, a huge finite number, so that what a kernel reads and nobody wrote overflows and is
found too.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_dvct.errors import CheckError

UNWRITTEN = np.float32(3.0e38)  # finite; anything computed from it soon is not
INF = float("inf")
ALBEDO_FIT = 3.5e-3  # kernels/materials.py fits the share of light that a surface reflects, with errors up to 0.0032
SLACK = 1.0e-3  # by which rounding may carry a unit vector or a share out of its range

# Ranges by the name of an output array (or of a field of an output struct), for all kernels or for one; others have to
# be finite.
RANGES: dict[str, tuple[float, float]] = {
    "depth": (0.0, INF),  # infinite where nothing is seen
    "mask_real": (0.0, 1.0 + SLACK),
    "shadow": (0.0, 1.0),
    "added": (0.0, 65504.0),
    "albedo": (0.0, 1.0 + ALBEDO_FIT),
    "base_color": (0.0, INF),
    "normal": (-1.0 - SLACK, 1.0 + SLACK),
    "normal_g": (-1.0 - SLACK, 1.0 + SLACK),
    "view": (-1.0 - SLACK, 1.0 + SLACK),
    "direction": (-1.0 - SLACK, 1.0 + SLACK),
    "area": (0.0, 3.0e38),
    "flux": (0.0, 3.0e38),
    "field": (0.0, 3.0e38),
    "irradiance": (0.0, 3.0e38),
    "_resolve.before": (0.0, 3.0e38),
    "_resolve_pixels.before": (0.0, 3.0e38),
    "radiance_before": (0.0, 3.0e38),
    "invalid": (0.0, 0.0),  # what the composite would mend: a NaN in the plate, if nothing before it was wrong
    "reach": (0.0, 3.0e38),
    "nearness": (0.0, 3.0e38),
    "probability": (0.0, 3.0e38),
}

PICTURES = ("composite", "difference", "path_tracing")  # kernel files whose elements are a picture's pixels


class Checker:
    """Checks what kernels wrote. ``Launcher.checker`` holds one where ``--check`` asks for it.

    Attributes:
        width, height: Of the picture, to name pixels; 0 where there is none yet.
        checked: Float values looked at so far.
    """

    def __init__(self) -> None:
        self.width = self.height = 0
        self.checked = 0

    def after(
        self, scope: str, kernel: wp.Kernel, count: int, inputs: Sequence[Any], outputs: Sequence[Any], device: Any
    ) -> None:
        """Look at what a launch of ``count`` elements wrote.

        Raises:
            CheckError: A value is NaN, infinite or out of its range; the message names the pass, kernel, array and
                element (and the pixel, where elements are pixels), and lists the inputs at that element.
        """
        wp.synchronize_device(device)
        names = [argument.label for argument in kernel.adj.args[1:]]
        # Kernels without outputs fill a struct that they are given (the VPL buffer, shadow maps).
        written = _arrays(names[len(inputs) :], outputs) if outputs else _arrays(names, inputs)
        for name, array in written:
            low, high = _range(kernel.key, name)
            values = _values(name, array)
            if values is None:
                continue
            self.checked += values.size
            bad = _bad(values, low, high)
            if bad is None:
                continue
            element, wrong = bad
            given = list(_arrays(names, inputs))
            thread, point = _owner(given, count, len(values), element)
            pixel = self._pixel(kernel, [*given, *_arrays(names[len(inputs) :], outputs)], point)
            there = "; ".join(_inputs(names, inputs, count, len(values), (element, thread, point)))
            raise CheckError(
                f"pass '{scope}', kernel {kernel.key}: {name}[{element}]{pixel} is {_text(values[element])},"
                f" which {wrong}; its inputs there: {there or 'none'}"
            )

    def _pixel(self, kernel: wp.Kernel, arrays: Sequence[tuple[str, Any]], point: int) -> str:
        """Where shading points know their pixel, or a kernel's elements are pixels: which."""
        for name, array in arrays:
            if name in ("points.pixel", "points_out.pixel") and 0 <= point < len(array):
                column, row = array.numpy()[point].tolist()
                return f" (pixel {column}, {row})"
        if kernel.module.name.rpartition(".")[2] not in PICTURES or not 0 <= point < self.width * self.height:
            return ""
        return f" (pixel {point % self.width}, {point // self.width})"


@dataclass(frozen=True)
class _Member:
    """One member of an array of structs, as far as an array of its own would have to answer."""

    array: wp.array
    name: str

    @property
    def dtype(self) -> Any:
        return self.array.dtype.vars[self.name].type

    @property
    def size(self) -> int:
        return self.array.size

    def __len__(self) -> int:
        return len(self.array)

    def numpy(self) -> np.ndarray:
        structs: Any = self.array.numpy()
        return structs[self.name]


def poison(array: wp.array) -> wp.array:
    """Fill a fresh float array with :data:`UNWRITTEN`, and one of structs with zeros."""
    if hasattr(array.dtype, "vars"):
        array.zero_()
    elif _scalar(array) in (wp.float32, wp.float64) and array.size:
        width = wp.types.type_size(array.dtype)
        array.fill_(float(UNWRITTEN) if width == 1 else array.dtype(*[float(UNWRITTEN)] * width))
    return array


def _arrays(names: Sequence[str], values: Sequence[Any]) -> Iterator[tuple[str, Any]]:
    """Arrays among a launch's arguments and in their structs, those of structs member by member, each with its name."""
    for name, value in zip(names, values, strict=False):
        if isinstance(value, wp.array):
            yield from _members(name, value)
        elif hasattr(value, "_cls"):
            for member in value._cls.vars:
                inner = getattr(value, member)
                if isinstance(inner, wp.array):
                    yield from _members(f"{name}.{member}", inner)


def _members(name: str, array: wp.array) -> Iterator[tuple[str, Any]]:
    if hasattr(array.dtype, "vars"):
        yield from ((f"{name}.{member}", _Member(array, member)) for member in array.dtype.vars)
    else:
        yield name, array


def _scalar(array: Any) -> Any:
    return getattr(array.dtype, "_wp_scalar_type_", array.dtype)


def _values(name: str, array: Any) -> np.ndarray | None:
    """A host view (a copy on CUDA) of an array that has a rule, its components as columns; None for others."""
    if not array.size or (_scalar(array) not in (wp.float32, wp.float64) and _key(name) not in RANGES):
        return None
    values = array.numpy()
    return values.reshape(len(values), -1)


def _key(name: str) -> str:
    return name.rpartition(".")[2].removesuffix("_out")


def _range(kernel: str, name: str) -> tuple[float, float]:
    return RANGES.get(f"{kernel}.{_key(name)}") or RANGES.get(_key(name)) or (-3.0e38, 3.0e38)


def _bad(values: np.ndarray, low: float, high: float) -> tuple[int, str] | None:
    """The first element that breaks a rule, and which."""
    # Two reductions decide in the usual case; NaN makes both comparisons false.
    if float(values.min()) >= low and float(values.max()) <= high:
        return None
    good = ((values >= low) & (values <= high)) | (values == UNWRITTEN)
    rows = np.flatnonzero(~good.all(-1))
    if not len(rows):
        return None
    row = values[rows[0]]
    if np.isnan(row).any():
        return int(rows[0]), "is NaN"
    if np.isinf(row).any() and not np.isinf([low, high]).any():
        return int(rows[0]), "is infinite"
    return int(rows[0]), f"is outside of {low:g} … {high:g}"


def _owner(given: Sequence[tuple[str, Any]], count: int, length: int, element: int) -> tuple[int, int]:
    """The thread that wrote an element, and the shading point that it works on (or the element itself)."""
    thread = element // max(1, length // count) if length > count else element
    for name, array in given:
        if name == "index_in" and thread < len(array):
            return thread, int(array.numpy()[thread])
    return thread, element


def _inputs(
    names: Sequence[str], values: Sequence[Any], count: int, length: int, where: tuple[int, int, int]
) -> Iterator[str]:
    """Scalars, and the entries of arrays that belong to the element, its thread, or the point its thread works on."""
    element, thread, point = where
    for name, value in zip(names, values, strict=False):
        if isinstance(value, (bool, int, float)):
            yield f"{name} = {value:g}"
    for name, array in _arrays(names[: len(values)], values):
        at = point if name.startswith("points.") else element if len(array) == length else thread
        if 0 <= at < len(array) and (name.startswith("points.") or len(array) in (length, count)):
            yield f"{name}[{at}] = {_text(np.atleast_1d(array.numpy()[at]).ravel())}"


def _text(row: np.ndarray) -> str:
    inner = ", ".join(f"{v:g}" for v in row.tolist())
    return inner if len(row) == 1 else f"({inner})"
