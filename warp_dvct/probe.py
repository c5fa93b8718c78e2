"""Light of a captured place: an image of all directions becomes a dome and, for its peaks, distant lights.

Images are NumPy arrays, linear Rec.709, row 0 on top. Lat-long images are laid out as UsdLux says: the centre looks
along +Z, a quarter in from the left along +X, the top row along +Y.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warp_dvct.errors import OptionError

LAYOUTS = ("latlong", "mirrorball", "angular", "fisheye")
LOOKS = ("up", "forward")
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
SUBSAMPLES = 3  # an edge, of a lat-long texel that is taken from another layout
PEAK_FALL = 0.2  # of a peak's brightest texel: what is dimmer does not belong to it
PEAK_OVER = 4.0  # times the image's median: what is dimmer is no peak
LARGEST_PEAK = 0.35  # sr; a larger bright region stays in the dome
TWO_TO_ONE = 0.01  # relative error of a lat-long image's aspect


@dataclass(frozen=True)
class Lens:
    """Calibration of an equidistant fish-eye: a direction at angle t from the axis falls at ``radius * t / (fov / 2)``.

    Attributes:
        fov: Full angle of the image circle [rad].
        radius: Of the image circle [pixels].
        center: x and y [pixels] from the top left corner; None for the image's middle.
        look: ``up``: the axis is +Y and the image's top -Z, as a camera on its back sees the sky; ``forward``: the
            axis is -Z and the image's top +Y.
    """

    fov: float
    radius: float
    center: tuple[float, float] | None = None
    look: str = "up"


@dataclass(frozen=True)
class Peak:
    """A small bright region as a distant light.

    Attributes:
        toward: Unit direction to the light.
        angle: Full angle of its disc [rad].
        radiance: Of the disc, linear RGB.
        irradiance: On a plane that faces it [W m^-2].
    """

    toward: np.ndarray
    angle: float
    radiance: np.ndarray
    irradiance: np.ndarray


@dataclass(frozen=True)
class ProbeLights:
    """The lights of a place: a dome's lat-long image without its peaks, and the peaks.

    ``horizontal`` is the irradiance on a plane that faces up, of the image as given and of dome and peaks together.
    """

    dome: np.ndarray
    peaks: tuple[Peak, ...]
    horizontal: tuple[np.ndarray, np.ndarray]


def directions(height: int, width: int, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Unit directions of places in a lat-long image of that size, in texels from its top left corner."""
    theta = rows / height * np.pi
    phi = (0.5 - columns / width) * 2.0 * np.pi
    sine = np.sin(theta)
    return np.stack([sine * np.sin(phi), np.cos(theta) * np.ones_like(phi), sine * np.cos(phi)], -1)


def solid_angles(height: int, width: int) -> np.ndarray:
    """Solid angle [sr] of a texel of each row."""
    edges = np.cos(np.linspace(0.0, np.pi, height + 1))
    return (edges[:-1] - edges[1:]) * (2.0 * np.pi / width)


def horizontal_irradiance(latlong: np.ndarray) -> np.ndarray:
    """Irradiance [W m^-2] that a lat-long image gives a plane that faces up, RGB."""
    height, width = latlong.shape[:2]
    edges = np.clip(np.cos(np.linspace(0.0, np.pi, height + 1)), 0.0, None)
    weight = 0.5 * (edges[:-1] ** 2 - edges[1:] ** 2) * (2.0 * np.pi / width)
    return (latlong.astype(np.float64) * weight[:, None, None]).sum((0, 1))


def to_latlong(image: np.ndarray, layout: str, *, height: int | None = None, lens: Lens | None = None) -> np.ndarray:
    """Resample an image of all (or some) directions to lat-long; what it does not show is black.

    Args:
        layout: ``latlong``; ``mirrorball`` or ``angular``, filling the image as UsdLux lays them out; ``fisheye``.
        height: Of the result; by default the image's shorter side. A lat-long image is never resampled.
        lens: Calibration, for ``fisheye`` alone.
    Raises:
        OptionError: A lat-long image that is not 2:1, a fish-eye one without calibration, or unusable values.
    """
    rows, columns = image.shape[:2]
    if layout not in LAYOUTS:
        raise OptionError(f"layout is '{layout}'; choose one of {', '.join(LAYOUTS)}")
    if not np.isfinite(image).all() or (image < 0).any():
        raise OptionError("the image has NaN, infinite or negative values; repair it")
    if layout == "latlong":
        if abs(columns / rows - 2.0) > 2.0 * TWO_TO_ONE:
            raise OptionError(
                f"a lat-long image is twice as wide as high; this one is {columns} x {rows}. Crop or pad it, or name"
                f" another --layout ({', '.join(LAYOUTS[1:])})"
            )
        return np.asarray(image, np.float32)
    if layout == "fisheye":
        _check_lens(lens)
    size = height or min(rows, columns)
    total = np.zeros((size, 2 * size, 3))
    for i in range(SUBSAMPLES):
        for j in range(SUBSAMPLES):
            y, x = np.mgrid[0:size, 0 : 2 * size]
            d = directions(size, 2 * size, y + (i + 0.5) / SUBSAMPLES, x + (j + 0.5) / SUBSAMPLES)
            u, v, seen = _place(d, layout, rows, columns, lens)
            total += _bilinear(image, u, v) * seen[..., None]
    return (total / SUBSAMPLES**2).astype(np.float32)


def _check_lens(lens: Lens | None) -> None:
    if lens is None:
        raise OptionError(
            "a fish-eye image needs its calibration: give --fov DEGREES and --radius PIXELS of its circle"
        )
    if not 0.0 < lens.fov <= 2.0 * np.pi:
        raise OptionError(f"--fov is {np.degrees(lens.fov):g}; a fish-eye's is above 0 and at most 360 degrees")
    if not lens.radius > 0.0:
        raise OptionError(f"--radius is {lens.radius:g}; the image circle's radius in pixels is above 0")
    if lens.look not in LOOKS:
        raise OptionError(f"--look is '{lens.look}'; choose one of {', '.join(LOOKS)}")


def _place(
    d: np.ndarray, layout: str, rows: int, columns: int, lens: Lens | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixel coordinates of directions, and whether the image shows them."""
    x, y, z = d[..., 0], d[..., 1], d[..., 2]
    if layout == "fisheye":
        assert lens is not None
        right, top, axis = (-x, -z, y) if lens.look == "up" else (x, y, -z)
        angle = np.arccos(np.clip(axis, -1.0, 1.0))
        flat = np.maximum(np.hypot(right, top), 1e-12)
        radius = lens.radius * angle / (0.5 * lens.fov)
        center = lens.center or (0.5 * columns, 0.5 * rows)
        return center[0] + radius * right / flat, center[1] - radius * top / flat, angle <= 0.5 * lens.fov
    angle = np.arccos(np.clip(z, -1.0, 1.0))
    radius = np.sin(0.5 * angle) if layout == "mirrorball" else angle / np.pi
    flat = np.maximum(np.hypot(x, y), 1e-12)
    u, v = 0.5 + 0.5 * radius * x / flat, 0.5 - 0.5 * radius * y / flat
    return u * columns, v * rows, np.ones(x.shape, bool)


def _bilinear(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Sample at pixel coordinates (pixel centres at half numbers), clamped at the border."""
    rows, columns = image.shape[:2]
    x, y = np.clip(x - 0.5, 0, columns - 1), np.clip(y - 0.5, 0, rows - 1)
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    right, bottom = np.minimum(left + 1, columns - 1), np.minimum(top + 1, rows - 1)
    fx, fy = (x - left)[..., None], (y - top)[..., None]
    upper = image[top, left] * (1 - fx) + image[top, right] * fx
    lower = image[bottom, left] * (1 - fx) + image[bottom, right] * fx
    return upper * (1 - fy) + lower * fy


def extract_lights(latlong: np.ndarray, *, most: int = 4, least: float = 0.05) -> ProbeLights:
    """Take the peaks out of a lat-long image: each becomes a distant light, the dome keeps what is around it.

    A peak is a connected region of less than 0.35 sr that is brighter than a fifth of its brightest texel and four
    times the image's median. Its light above the level around it goes into the distant light, whose direction and
    irradiance are those of the region's vector irradiance: planes that see all of it receive what they received.

    Args:
        most: Peaks at most.
        least: Share of the image's whole light below which a peak is left in the dome.
    """
    dome = np.array(latlong, np.float64)
    before = horizontal_irradiance(dome)
    height, width = dome.shape[:2]
    texel = np.broadcast_to(solid_angles(height, width)[:, None], (height, width))
    y, x = np.mgrid[0:height, 0:width]
    toward = directions(height, width, y + 0.5, x + 0.5)
    whole = float(((dome @ LUMINANCE) * texel).sum())
    peaks = []
    barred = np.zeros((height, width), bool)
    while len(peaks) < most and whole > 0.0:
        brightness = np.where(barred, 0.0, dome @ LUMINANCE)
        floor = PEAK_OVER * float(np.median(dome @ LUMINANCE))
        seed = np.unravel_index(int(np.argmax(brightness)), brightness.shape)
        if brightness[seed] <= floor:
            break
        region = _connected(brightness > max(PEAK_FALL * brightness[seed], floor), seed)
        barred |= region
        size = float(texel[region].sum())
        ring = _grown(region, 2) & ~region
        around = np.median(dome[ring], axis=0) if ring.any() else np.zeros(3)
        excess = np.maximum(dome[region] - around, 0.0) * texel[region][:, None]
        if size > LARGEST_PEAK or float((excess @ LUMINANCE).sum()) < least * whole:
            if float(((dome @ LUMINANCE) * texel)[region].sum()) < 0.1 * least * whole:
                break  # what is left is dimmer still
            continue
        peaks.append(_peak(excess, toward[region], size))
        dome[region] -= excess / texel[region][:, None]
    after = horizontal_irradiance(dome) + sum((p.irradiance * max(p.toward[1], 0.0) for p in peaks), np.zeros(3))
    return ProbeLights(dome.astype(np.float32), tuple(peaks), (before, after))


def _peak(light: np.ndarray, toward: np.ndarray, size: float) -> Peak:
    """The distant light with the vector irradiance of ``light`` [W m^-2] that comes from directions ``toward``."""
    vectors = (light[:, :, None] * toward[:, None, :]).sum(0)  # per channel
    mean = LUMINANCE @ vectors
    direction = mean / np.linalg.norm(mean)
    irradiance = np.maximum(vectors @ direction, 0.0)
    half = float(np.arccos(1.0 - min(size, 2.0 * np.pi) / (2.0 * np.pi)))
    return Peak(direction, 2.0 * half, irradiance / (np.pi * np.sin(half) ** 2), irradiance)


def _connected(mask: np.ndarray, seed: tuple) -> np.ndarray:
    """The part of ``mask`` that hangs together with ``seed``, around the back too."""
    region = np.zeros_like(mask)
    region[seed] = True
    while True:
        grown = _grown(region, 1) & mask
        if (grown == region).all():
            return region
        region = grown


def _grown(region: np.ndarray, steps: int) -> np.ndarray:
    """Grown by its eight neighbours; columns wrap around."""
    for _ in range(steps):
        wide = region | np.roll(region, 1, 1) | np.roll(region, -1, 1)
        tall = wide.copy()
        tall[1:] |= wide[:-1]
        tall[:-1] |= wide[1:]
        region = tall
    return region


def lights_usda(lights: ProbeLights, texture: str, source: str) -> str:
    """A USD layer with a DomeLight of ``texture`` (a path relative to the layer) and the peaks as DistantLights."""
    parts = [
        '    def DomeLight "Dome"\n    {\n        float inputs:intensity = 1\n'
        f"        asset inputs:texture:file = @./{texture}@\n"
        '        token inputs:texture:format = "latlong"\n    }'
    ]
    for i, peak in enumerate(lights.peaks):
        level = float(peak.radiance.max())
        color = ", ".join(f"{c / level:.9g}" for c in peak.radiance)
        x, y, z = (float(c) for c in peak.toward)
        pitch, turn = np.degrees(np.arcsin(np.clip(-y, -1.0, 1.0))), np.degrees(np.arctan2(x, z))
        parts.append(
            f'    def DistantLight "Peak{i + 1}"\n    {{\n'
            f"        float inputs:angle = {np.degrees(peak.angle):.9g}\n"
            f"        color3f inputs:color = ({color})\n"
            f"        float inputs:intensity = {level:.9g}\n"
            f"        float xformOp:rotateX = {pitch:.9g}\n        float xformOp:rotateY = {turn:.9g}\n"
            '        uniform token[] xformOpOrder = ["xformOp:rotateY", "xformOp:rotateX"]\n    }'
        )
    name = source.replace("\\", "/").replace('"', "'")
    return (
        f'#usda 1.0\n(\n    defaultPrim = "Lights"\n    doc = "Light of {name}"\n    metersPerUnit = 1\n'
        '    upAxis = "Y"\n)\n\ndef Xform "Lights"\n{\n' + "\n\n".join(parts) + "\n}\n"
    )
