"""Emitters: sampling them, meeting them along a ray, and the background.

Finite lights are not geometry: they block nothing and the camera does not see them, but scattered rays do, along the
open segment before the surface that they hit. RECT and DISK emit on one side, SPHERE outwards. Kinds are those of
``scene.LightKind``.
"""

import warp as wp

from warp_dvct.kernels.geometry import FAR
from warp_dvct.kernels.sampling import PI, TWO_PI, concentric_disk, from_frame, uniform_cone

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

POINT = wp.constant(0)
SPHERE = wp.constant(1)
RECT = wp.constant(2)
DISK = wp.constant(3)
DISTANT = wp.constant(4)
DOME = wp.constant(5)

ADDED = wp.constant(1)


@wp.struct
class Lights:
    """All lights of a scene, in volume space; each array has ``count`` entries unless it says otherwise."""

    count: int
    kind: wp.array(dtype=int)
    role: wp.array(dtype=int)  # 0 plate, 1 added
    radiance: wp.array(dtype=wp.vec3)  # POINT: radiant intensity; DISTANT of angle 0: irradiance
    position: wp.array(dtype=wp.vec3)
    axis_x: wp.array(dtype=wp.vec3)
    axis_y: wp.array(dtype=wp.vec3)
    direction: wp.array(dtype=wp.vec3)  # in which the light travels; the plane's normal for RECT and DISK
    radius: wp.array(dtype=float)
    bound: wp.array(dtype=float)  # of a sphere around the position that holds all but DISTANT and DOME
    area: wp.array(dtype=float)  # RECT, DISK
    cap: wp.array(dtype=float)  # DISTANT: 1 - cos(angle / 2)
    cone_angle: wp.array(dtype=float)  # pi where the light is no spot
    cone_inner: wp.array(dtype=float)  # angle at which the spot's edge begins to fall
    to_world: wp.array(dtype=wp.mat33)  # DOME: from the light's space
    dome_width: wp.array(dtype=int)  # 0 for a constant dome
    dome_height: wp.array(dtype=int)
    dome_first: wp.array(dtype=int)  # first texel in dome_texels
    rows_first: wp.array(dtype=int)  # first entry in row_cdf
    columns_first: wp.array(dtype=int)  # first entry in column_cdf
    dome_texels: wp.array(dtype=wp.vec3)  # all domes, radiance included
    row_cdf: wp.array(dtype=float)  # per dome: height + 1
    column_cdf: wp.array(dtype=float)  # per dome and row: width + 1


@wp.struct
class LightSample:
    """A direction towards a light. ``value`` is radiance / density (or irradiance of a light without extent), before
    visibility: times ``brdf_cos`` it estimates the reflected radiance. ``pdf`` is 0 for a light without extent."""

    direction: wp.vec3
    distance: float
    value: wp.vec3
    pdf: float


@wp.struct
class LightHit:
    """What a ray receives from a light: zero radiance where it misses; ``pdf`` is :func:`sample_light`'s density."""

    radiance: wp.vec3
    distance: float
    pdf: float


@wp.func
def spot_factor(lights: Lights, i: int, leaving: wp.vec3) -> float:
    """Share emitted along ``leaving``: 1 inside the cone, a smoothstep in the angle at its soft edge (UsdLux)."""
    outer = lights.cone_angle[i]
    if outer >= PI:
        return 1.0
    axis = lights.direction[i]
    angle = wp.atan2(wp.length(wp.cross(axis, leaving)), wp.dot(axis, leaving))
    inner = lights.cone_inner[i]
    if angle >= outer:
        return 0.0
    if angle <= inner:
        return 1.0
    x = (angle - inner) / (outer - inner)
    return 1.0 - x * x * (3.0 - 2.0 * x)


@wp.func
def dome_angles(lights: Lights, i: int, direction: wp.vec3) -> wp.vec2:
    """Continuous lat-long coordinates in [0, 1]: image centre = +Z, a quarter in from the left = +X, top = +Y."""
    d = wp.transpose(lights.to_world[i]) * direction
    u = 0.5 - wp.atan2(d[0], d[2]) / TWO_PI
    v = wp.acos(wp.clamp(d[1], -1.0, 1.0)) / PI
    return wp.vec2(u, v)


@wp.func
def dome_value(lights: Lights, i: int, direction: wp.vec3) -> wp.vec3:
    """Radiance of one dome from a direction: bilinear, periodic around, clamped at the poles."""
    width = lights.dome_width[i]
    if width == 0:
        return lights.radiance[i]
    height = lights.dome_height[i]
    uv = dome_angles(lights, i, direction)
    x = uv[0] * float(width) - 0.5
    y = uv[1] * float(height) - 0.5
    x0 = int(wp.floor(x))
    y0 = int(wp.floor(y))
    left = (x0 + width) % width
    right = (x0 + 1) % width
    top = lights.dome_first[i] + wp.clamp(y0, 0, height - 1) * width
    bottom = lights.dome_first[i] + wp.clamp(y0 + 1, 0, height - 1) * width
    fx = x - float(x0)
    a = wp.lerp(lights.dome_texels[top + left], lights.dome_texels[top + right], fx)
    b = wp.lerp(lights.dome_texels[bottom + left], lights.dome_texels[bottom + right], fx)
    return wp.lerp(a, b, y - float(y0))


@wp.func
def find_interval(cdf: wp.array(dtype=float), first: int, count: int, x: float) -> int:
    """The cell k of ``count`` with cdf[k] <= x < cdf[k + 1]; a cell without probability is never returned."""
    low = int(0)
    high = int(count)
    while high - low > 1:
        middle = (low + high) // 2
        if cdf[first + middle] <= x:
            low = middle
        else:
            high = middle
    return low


@wp.func
def dome_cell_pdf(lights: Lights, i: int, row: int, column: int) -> float:
    """Solid-angle density of :func:`sample_dome` inside a texel's cell, over which it is constant."""
    width = lights.dome_width[i]
    height = lights.dome_height[i]
    r = lights.rows_first[i] + row
    c = lights.columns_first[i] + row * (width + 1) + column
    chance = (lights.row_cdf[r + 1] - lights.row_cdf[r]) * (lights.column_cdf[c + 1] - lights.column_cdf[c])
    # cos(a) - cos(b) = 2 sin((a + b) / 2) sin((b - a) / 2) keeps its precision at the poles.
    band = 2.0 * wp.sin((float(row) + 0.5) * PI / float(height)) * wp.sin(0.5 * PI / float(height))
    return chance * float(width) / (TWO_PI * band)


@wp.func
def dome_pdf(lights: Lights, i: int, direction: wp.vec3) -> float:
    """Solid-angle density with which :func:`sample_dome` picks a direction."""
    width = lights.dome_width[i]
    if width == 0:
        return 0.25 / PI
    uv = dome_angles(lights, i, direction)
    height = lights.dome_height[i]
    column = wp.clamp(int(uv[0] * float(width)), 0, width - 1)
    return dome_cell_pdf(lights, i, wp.clamp(int(uv[1] * float(height)), 0, height - 1), column)


@wp.func
def sample_dome(lights: Lights, i: int, xi: wp.vec2) -> LightSample:
    """A direction by the texels' mean radiance, uniform in solid angle inside a texel; uniform for a constant dome."""
    out = LightSample()
    out.distance = FAR
    width = lights.dome_width[i]
    if width == 0:
        out.direction = uniform_cone(xi, 2.0)
        out.pdf = 0.25 / PI
        out.value = lights.radiance[i] / out.pdf
        return out
    height = lights.dome_height[i]
    rows = lights.rows_first[i]
    row = find_interval(lights.row_cdf, rows, height, xi[1])
    low = lights.row_cdf[rows + row]
    fy = (xi[1] - low) / (lights.row_cdf[rows + row + 1] - low)
    columns = lights.columns_first[i] + row * (width + 1)
    column = find_interval(lights.column_cdf, columns, width, xi[0])
    low = lights.column_cdf[columns + column]
    fx = (xi[0] - low) / (lights.column_cdf[columns + column + 1] - low)
    azimuth = (0.5 - (float(column) + fx) / float(width)) * TWO_PI
    top = wp.cos(float(row) * PI / float(height))
    y = top + fy * (wp.cos(float(row + 1) * PI / float(height)) - top)
    r = wp.sqrt(wp.max(0.0, 1.0 - y * y))
    out.direction = lights.to_world[i] * wp.vec3(r * wp.sin(azimuth), y, r * wp.cos(azimuth))
    out.pdf = dome_cell_pdf(lights, i, row, column)
    out.value = dome_value(lights, i, out.direction) / out.pdf
    return out


@wp.func
def sphere_cap(lights: Lights, i: int, position: wp.vec3) -> float:
    """1 - cos of the half angle that a sphere covers; 0 from inside, where it emits nothing."""
    d = lights.position[i] - position
    sine2 = lights.radius[i] * lights.radius[i] / wp.dot(d, d)
    if sine2 >= 1.0:
        return 0.0
    return sine2 / (1.0 + wp.sqrt(1.0 - sine2))


@wp.func
def sphere_distance(lights: Lights, i: int, position: wp.vec3, direction: wp.vec3) -> float:
    """Distance to the sphere's near side; the tangent point's where rounding makes a grazing ray miss."""
    d = lights.position[i] - position
    along = wp.dot(d, direction)
    aside = wp.length_sq(d - direction * along)
    return along - wp.sqrt(wp.max(lights.radius[i] * lights.radius[i] - aside, 0.0))


@wp.func
def sample_sphere(lights: Lights, i: int, position: wp.vec3, xi: wp.vec2) -> LightSample:
    """Uniform over the cap of directions that meet the sphere."""
    out = LightSample()
    out.distance = FAR
    cap = sphere_cap(lights, i, position)
    if cap > 0.0:
        out.direction = from_frame(uniform_cone(xi, cap), wp.normalize(lights.position[i] - position))
        out.distance = sphere_distance(lights, i, position, out.direction)
        out.pdf = 1.0 / (TWO_PI * cap)
        out.value = lights.radiance[i] * (spot_factor(lights, i, -out.direction) / out.pdf)
    return out


@wp.func
def sample_planar(lights: Lights, i: int, position: wp.vec3, xi: wp.vec2) -> LightSample:
    """Uniform over the area of a RECT (a parallelogram) or DISK (an ellipse)."""
    out = LightSample()
    out.distance = FAR
    st = wp.vec2(2.0 * xi[0] - 1.0, 2.0 * xi[1] - 1.0)
    if lights.kind[i] == DISK:
        st = concentric_disk(xi)
    d = lights.position[i] + lights.axis_x[i] * st[0] + lights.axis_y[i] * st[1] - position
    distance = wp.length(d)
    cos = -wp.dot(d, lights.direction[i]) / distance
    if cos > 0.0:
        out.direction = d / distance
        out.distance = distance
        out.pdf = distance * distance / (cos * lights.area[i])
        out.value = lights.radiance[i] * (spot_factor(lights, i, -out.direction) / out.pdf)
    return out


@wp.func
def sample_light(lights: Lights, i: int, position: wp.vec3, xi: wp.vec2) -> LightSample:
    """A direction from ``position`` towards light ``i``; zero value where the light does not reach it."""
    kind = lights.kind[i]
    if kind == SPHERE:
        return sample_sphere(lights, i, position, xi)
    if kind == RECT or kind == DISK:
        return sample_planar(lights, i, position, xi)
    if kind == DOME:
        return sample_dome(lights, i, xi)
    out = LightSample()
    if kind == POINT:
        d = lights.position[i] - position
        out.distance = wp.length(d)
        out.direction = d / out.distance
        out.value = lights.radiance[i] * (spot_factor(lights, i, -out.direction) / wp.dot(d, d))
        return out
    out.distance = FAR
    out.direction = -lights.direction[i]
    out.value = lights.radiance[i]
    cap = lights.cap[i]
    if cap > 0.0:
        out.direction = from_frame(uniform_cone(xi, cap), out.direction)
        out.pdf = 1.0 / (TWO_PI * cap)
        out.value = lights.radiance[i] / out.pdf
    return out


@wp.func
def meet_planar(lights: Lights, i: int, origin: wp.vec3, direction: wp.vec3) -> LightHit:
    """Where a ray meets the emitting side of a RECT or DISK."""
    out = LightHit()
    normal = lights.direction[i]
    cos = -wp.dot(direction, normal)
    if cos <= 0.0:
        return out
    distance = wp.dot(origin - lights.position[i], normal) / cos
    if distance <= 0.0:
        return out
    p = origin + direction * distance - lights.position[i]
    ax = lights.axis_x[i]
    ay = lights.axis_y[i]
    # Coordinates in the (possibly skewed) basis of the half edges.
    n = wp.cross(ax, ay)
    n2 = wp.dot(n, n)
    s = wp.dot(wp.cross(p, ay), n) / n2
    t = wp.dot(wp.cross(ax, p), n) / n2
    inside = wp.max(wp.abs(s), wp.abs(t)) <= 1.0
    if lights.kind[i] == DISK:
        inside = s * s + t * t <= 1.0
    if inside:
        out.radiance = lights.radiance[i] * spot_factor(lights, i, -direction)
        out.distance = distance
        out.pdf = distance * distance / (cos * lights.area[i])
    return out


@wp.func
def light_along_ray(lights: Lights, i: int, origin: wp.vec3, direction: wp.vec3) -> LightHit:
    """Radiance of light ``i`` along a ray, before visibility, with the density of :func:`sample_light`."""
    out = LightHit()
    kind = lights.kind[i]
    if kind == DOME:
        out.radiance = dome_value(lights, i, direction)
        out.distance = FAR
        out.pdf = dome_pdf(lights, i, direction)
    elif kind == RECT or kind == DISK:
        out = meet_planar(lights, i, origin, direction)
    elif kind == SPHERE:
        cap = sphere_cap(lights, i, origin)
        d = lights.position[i] - origin
        aside = wp.length_sq(wp.cross(d, direction))
        if cap > 0.0 and wp.dot(d, direction) > 0.0 and aside <= lights.radius[i] * lights.radius[i]:
            out.radiance = lights.radiance[i] * spot_factor(lights, i, -direction)
            out.distance = sphere_distance(lights, i, origin, direction)
            out.pdf = 1.0 / (TWO_PI * cap)
    elif kind == DISTANT:
        cap = lights.cap[i]
        # 1 - cos(a) = |difference|^2 / 2 resolves discs as small as the sun's.
        if cap > 0.0 and 0.5 * wp.length_sq(direction + lights.direction[i]) <= cap:
            out.radiance = lights.radiance[i]
            out.distance = FAR
            out.pdf = 1.0 / (TWO_PI * cap)
    return out


@wp.func
def dome_radiance(lights: Lights, direction: wp.vec3, with_added: int) -> wp.vec3:
    """Background: the sum of the plate's domes, and of the added ones where asked for."""
    total = wp.vec3(0.0, 0.0, 0.0)
    for i in range(lights.count):
        if lights.kind[i] == DOME and (lights.role[i] != ADDED or with_added != 0):
            total += dome_value(lights, i, direction)
    return total
