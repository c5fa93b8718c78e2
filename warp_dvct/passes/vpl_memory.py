"""Whether what instant radiosity keeps fits into memory, asked before any of it is made."""

from __future__ import annotations

from pathlib import Path

from warp_dvct.errors import DeviceError
from warp_dvct.launch import Launcher
from warp_dvct.settings import Settings

FILL_LEVELS = 2
INDEX_LIMIT = 2**31  # Warp indexes with 32 bits
VPL_BYTES = 52
CLOUD_BYTES = 48  # of a point; there are a real and a synthetic cloud
RSM_BYTES = 128  # of a texel: the maps before and after, their importance and its levels


def map_texels(size: int) -> int:
    """Texels of an imperfect shadow map with the coarser levels that pull-push uses."""
    return sum((size >> level) ** 2 for level in range(pyramid_levels(size)))


def pyramid_levels(size: int) -> int:
    """Levels of a map, the finest included; fewer where its size does not halve."""
    return min(FILL_LEVELS, max(0, (size & -size).bit_length() - 1)) + 1


def surface_vpls(settings: Settings) -> int:
    """VPLs of all bounces: those that have shadow maps."""
    return settings.vpls_count + (settings.bounces - 1) * settings.vpls_further if settings.bounces else 0


def vpl_count(settings: Settings, *, dome: bool) -> int:
    """VPLs of all bounces and, with a dome, on the sky."""
    return surface_vpls(settings) + (settings.vpls_sky if dome else 0)


def check_memory(launcher: Launcher, settings: Settings, *, lights: int, dome: bool) -> None:
    """Refuse settings whose maps, points and VPLs do not fit.

    Raises:
        DeviceError: It names the settings and what would fit.
    """
    free = free_bytes(launcher)
    count = vpl_count(settings, dome=dome)
    points = settings.ism_points * settings.ism_blocks
    bytes_of = {"maps of the lights": 0, "points": 0, "virtual point lights": count * VPL_BYTES}
    if settings.bounces:
        bytes_of["maps of the lights"] = lights * settings.vpls_map**2 * RSM_BYTES
    if settings.visibility == "ism" or settings.bounces > 1:
        bytes_of["points"] = 2 * points * CLOUD_BYTES
    if bytes_of["maps of the lights"] > free:
        fits = int((free / (lights * RSM_BYTES)) ** 0.5)
        raise DeviceError(_message(f"maps of {lights} light(s) at vpls.map={settings.vpls_map}", bytes_of, free, fits))
    if bytes_of["points"] > free or points >= INDEX_LIMIT:
        fits = min(free // (2 * CLOUD_BYTES), INDEX_LIMIT - 1) // settings.ism_points
        what = f"ism.blocks={settings.ism_blocks} sets of ism.points={settings.ism_points}"
        if fits == 0:
            raise DeviceError(_message(what, bytes_of, free, fits) + "; lower ism.points too")
        raise DeviceError(_message(what, bytes_of, free, fits))
    if settings.visibility == "ism":
        check_isms(launcher, surface_vpls(settings), settings.ism_size)
    needed = sum(bytes_of.values())
    if needed > free:
        raise DeviceError(
            f"{count} VPLs (vpls.count, vpls.further x bounces, vpls.sky), their points and maps need"
            f" {needed / 2**20:.0f} MiB and {free / 2**20:.0f} MiB are free: lower the largest,"
            f" {max(bytes_of, key=lambda name: bytes_of[name])}"
        )


def _message(what: str, bytes_of: dict[str, int], free: int, fits: int) -> str:
    needed = max(bytes_of["maps of the lights"], bytes_of["points"])
    return f"{what} need {needed / 2**20:.0f} MiB and {free / 2**20:.0f} MiB are free; {fits} would fit"


def check_isms(launcher: Launcher, count: int, size: int) -> None:
    """Refuse imperfect shadow maps of ``count`` VPLs that do not fit.

    Raises:
        DeviceError: It names the settings and what would fit.
    """
    each = 2 * 4 * map_texels(size)
    free = free_bytes(launcher)
    needed = count * each
    if needed > free or 2 * count * map_texels(size) >= INDEX_LIMIT:
        fits = min(free // each, INDEX_LIMIT // 2 // map_texels(size))
        raise DeviceError(
            f"imperfect shadow maps of {count} VPLs at ism.size={size} need {needed / 2**20:.0f} MiB and"
            f" {free / 2**20:.0f} MiB are free; {fits} VPLs would fit: lower vpls.count, vpls.further,"
            " bounces or ism.size, or take visibility=ray, which needs no maps"
        )


def free_bytes(launcher: Launcher) -> int:
    """Memory that the device has left."""
    if launcher.device.is_cuda:
        return int(launcher.device.free_memory)
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    return 2**63 - 1  # not known: the allocation will say
