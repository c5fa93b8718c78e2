"""Putting a rendered picture through a lens: the picture is resampled, never the photograph."""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class Filtered:
    """Quantities that are means over a pixel."""

    before: wp.array(dtype=wp.vec3)
    delta: wp.array(dtype=wp.vec3)
    synthetic: wp.array(dtype=wp.vec4)
    mask_real: wp.array(dtype=wp.float32)


@wp.struct
class Surfaces:
    """Quantities of the surface at a pixel's centre, which are not mixed."""

    albedo: wp.array(dtype=wp.vec3)
    normal: wp.array(dtype=wp.vec3)
    position: wp.array(dtype=wp.vec3)
    depth: wp.array(dtype=wp.float32)


@wp.kernel
def _resample(
    first: int,
    filtered: Filtered,
    surfaces: Surfaces,
    place_in: wp.array(dtype=wp.vec2),
    width: int,
    height: int,
    with_before: int,
    far: float,
    filtered_out: Filtered,
    surfaces_out: Surfaces,
):
    """Bilinear means and nearest surfaces at ``place`` (in pixels of the source, the first one's centre is (0, 0));
    a negative place shows nothing."""
    i = first + wp.tid()
    place = place_in[i]
    before = wp.vec3(0.0, 0.0, 0.0)
    delta = wp.vec3(0.0, 0.0, 0.0)
    synthetic = wp.vec4(0.0, 0.0, 0.0, 0.0)
    mask = float(0.0)
    albedo = wp.vec3(0.0, 0.0, 0.0)
    normal = wp.vec3(0.0, 0.0, 0.0)
    position = wp.vec3(0.0, 0.0, 0.0)
    depth = float(far)
    if place[0] >= 0.0:
        x = wp.min(int(place[0]), width - 1)
        y = wp.min(int(place[1]), height - 1)
        for k in range(4):
            dx = k % 2
            dy = k / 2
            wx = wp.where(dx == 0, 1.0 - (place[0] - float(x)), place[0] - float(x))
            wy = wp.where(dy == 0, 1.0 - (place[1] - float(y)), place[1] - float(y))
            j = wp.min(y + dy, height - 1) * width + wp.min(x + dx, width - 1)
            w = wx * wy
            delta += w * filtered.delta[j]
            synthetic += w * filtered.synthetic[j]
            mask += w * filtered.mask_real[j]
            if with_before != 0:
                before += w * filtered.before[j]
        n = wp.min(int(place[1] + 0.5), height - 1) * width + wp.min(int(place[0] + 0.5), width - 1)
        albedo = surfaces.albedo[n]
        normal = surfaces.normal[n]
        position = surfaces.position[n]
        depth = surfaces.depth[n]
    filtered_out.delta[i] = delta
    filtered_out.synthetic[i] = synthetic
    filtered_out.mask_real[i] = mask
    if with_before != 0:
        filtered_out.before[i] = before
    surfaces_out.albedo[i] = albedo
    surfaces_out.normal[i] = normal
    surfaces_out.position[i] = position
    surfaces_out.depth[i] = depth
