"""Surfaces and their BRDF: Lambert + GGX as ``scene.Material`` defines them, textures included.

Conventions: ``wo`` points to where the light goes (the viewer), ``wi`` to where it comes from; both are unit vectors
away from the surface. ``brdf_cos*`` are the BRDF times the cosine of ``wi``, zero where either lies behind the
geometric or the shading plane.
"""

import warp as wp

from warp_dvct.kernels.geometry import OFFSET_RELATIVE, Geometry, Hit, corner_position, largest_coordinate
from warp_dvct.kernels.sampling import INV_PI, TWO_PI, cosine_hemisphere, from_frame, luminance, tangent_of

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# The smoothest surface: below it the lobe is narrower than float32 half vectors resolve.
ALPHA_FLOOR = wp.constant(1.0e-3)

# A shading normal that faces away from the viewer is bent until its cosine is this large.
FACING_FLOOR = wp.constant(1.0e-3)

# Scales Schlick's grazing reflectance: an f0 of 2 % or more reflects everything at grazing angles (scene.Material).
GRAZING_GAIN = wp.constant(50.0)

WRAP_CLAMP = wp.constant(1)
WRAP_MIRROR = wp.constant(2)
WRAP_BLACK = wp.constant(3)


@wp.struct
class Materials:
    """Per-material values, and all textures one after another; texture index -1 means none."""

    base_color: wp.array(dtype=wp.vec3)
    metallic: wp.array(dtype=float)
    roughness: wp.array(dtype=float)
    f0: wp.array(dtype=wp.vec3)  # of the dielectric, or of the specular workflow
    base_texture: wp.array(dtype=int)
    roughness_texture: wp.array(dtype=int)
    texture_first: wp.array(dtype=int)
    texture_width: wp.array(dtype=int)
    texture_height: wp.array(dtype=int)
    texture_wrap_s: wp.array(dtype=int)
    texture_wrap_t: wp.array(dtype=int)
    texels: wp.array(dtype=wp.vec3)


@wp.struct
class Surface:
    """A point on a surface, seen from one side; both normals face the viewer."""

    position: wp.vec3
    normal_g: wp.vec3
    normal: wp.vec3
    base_color: wp.vec3
    diffuse: wp.vec3  # base_color * (1 - metallic)
    f0: wp.vec3
    f90: float
    alpha: float
    reach: float  # largest absolute coordinate of the triangle: scales rounding errors
    synthetic: int
    triangle: int
    front: int  # 1 where the viewer is on the triangle's front


@wp.func
def wrap_texel(i: int, size: int, mode: int) -> int:
    """Texel index inside [0, size), or -1 for black."""
    if mode == WRAP_CLAMP:
        return wp.clamp(i, 0, size - 1)
    if mode == WRAP_BLACK:
        return wp.where(i < 0 or i >= size, -1, i)
    if mode == WRAP_MIRROR:
        period = 2 * size
        k = i - period * int(wp.floor(float(i) / float(period)))
        return wp.where(k >= size, period - 1 - k, k)
    return i - size * int(wp.floor(float(i) / float(size)))


@wp.func
def texel(mats: Materials, texture: int, x: int, y: int) -> wp.vec3:
    """One texel, wrapped."""
    width = mats.texture_width[texture]
    i = wrap_texel(x, width, mats.texture_wrap_s[texture])
    j = wrap_texel(y, mats.texture_height[texture], mats.texture_wrap_t[texture])
    if i < 0 or j < 0:
        return wp.vec3(0.0, 0.0, 0.0)
    return mats.texels[mats.texture_first[texture] + j * width + i]


@wp.func
def texture_at(mats: Materials, texture: int, uv: wp.vec2) -> wp.vec3:
    """Bilinear look-up; v points up, so row 0 of the image lies at v = 1."""
    x = uv[0] * float(mats.texture_width[texture]) - 0.5
    y = (1.0 - uv[1]) * float(mats.texture_height[texture]) - 0.5
    x0 = wp.floor(x)
    y0 = wp.floor(y)
    i = int(x0)
    j = int(y0)
    a = wp.lerp(texel(mats, texture, i, j), texel(mats, texture, i + 1, j), x - x0)
    b = wp.lerp(texel(mats, texture, i, j + 1), texel(mats, texture, i + 1, j + 1), x - x0)
    return wp.lerp(a, b, y - y0)


@wp.func
def shading_normal(geo: Geometry, hit: Hit, normal_g: wp.vec3, wo: wp.vec3) -> wp.vec3:
    """Interpolated normal on the side of ``normal_g``, bent to face ``wo``; the geometric one where there is none."""
    first = 3 * hit.triangle
    n = (
        geo.corner_normals[first] * hit.u
        + geo.corner_normals[first + 1] * hit.v
        + geo.corner_normals[first + 2] * (1.0 - hit.u - hit.v)
    )
    size = wp.length(n)
    if size < 1.0e-6:
        return normal_g
    n = n / size
    if wp.dot(n, normal_g) < 0.0:
        n = -n
    facing = wp.dot(n, wo)
    if facing < FACING_FLOOR:
        n = wp.normalize(n + wo * (FACING_FLOOR - facing))
    return n


@wp.func
def surface_at(geo: Geometry, mats: Materials, hit: Hit, origin: wp.vec3, direction: wp.vec3) -> Surface:
    """The surface that a ray from ``origin`` along ``direction`` hit; its position is interpolated from the corners."""
    p = corner_position(geo, hit.triangle, 0)
    q = corner_position(geo, hit.triangle, 1)
    r = corner_position(geo, hit.triangle, 2)
    w = 1.0 - hit.u - hit.v
    s = Surface()
    s.position = p * hit.u + q * hit.v + r * w
    s.reach = wp.max(largest_coordinate(p), wp.max(largest_coordinate(q), largest_coordinate(r)))
    s.triangle = hit.triangle
    s.synthetic = hit.synthetic
    normal = wp.normalize(wp.cross(q - p, r - p))
    s.front = wp.where(wp.dot(normal, direction) <= 0.0, 1, 0)
    s.normal_g = wp.where(s.front == 1, normal, -normal)
    s.normal = shading_normal(geo, hit, s.normal_g, -direction)

    material = geo.material[hit.triangle]
    first = 3 * hit.triangle
    base = mats.base_color[material]
    roughness = mats.roughness[material]
    base_texture = mats.base_texture[material]
    roughness_texture = mats.roughness_texture[material]
    if base_texture >= 0 or roughness_texture >= 0:
        uv = geo.corner_uvs[first] * hit.u + geo.corner_uvs[first + 1] * hit.v + geo.corner_uvs[first + 2] * w
        if base_texture >= 0:
            base = texture_at(mats, base_texture, uv)
        if roughness_texture >= 0:
            roughness = texture_at(mats, roughness_texture, uv)[0]
    color = geo.corner_colors[first] * hit.u + geo.corner_colors[first + 1] * hit.v + geo.corner_colors[first + 2] * w
    base = wp.cw_mul(base, color)
    metallic = mats.metallic[material]
    s.base_color = base
    s.diffuse = base * (1.0 - metallic)
    s.f0 = wp.lerp(mats.f0[material], base, metallic)
    s.f90 = wp.min(GRAZING_GAIN * wp.max(s.f0[0], wp.max(s.f0[1], s.f0[2])), 1.0)
    s.alpha = wp.max(roughness * roughness, ALPHA_FLOOR)
    return s


@wp.func
def spawn_point(s: Surface, direction: wp.vec3) -> wp.vec3:
    """Origin of a ray that leaves the surface along ``direction``, off the triangle by its rounding error."""
    step = OFFSET_RELATIVE * s.reach
    return s.position + s.normal_g * wp.where(wp.dot(s.normal_g, direction) >= 0.0, step, -step)


@wp.func
def fresnel(f0: wp.vec3, f90: float, cos: float) -> wp.vec3:
    """Schlick's approximation with a chosen grazing reflectance."""
    x = wp.clamp(1.0 - cos, 0.0, 1.0)
    x5 = x * x * x * x * x
    return f0 + (wp.vec3(f90, f90, f90) - f0) * x5


@wp.func
def ggx_d(n: wp.vec3, h: wp.vec3, alpha: float) -> float:
    """GGX normal distribution; the sine comes from the cross product, which does not cancel for narrow lobes."""
    c = wp.dot(n, h)
    if c <= 0.0:
        return 0.0
    sine = wp.cross(n, h)
    a2 = alpha * alpha
    d = wp.dot(sine, sine) + a2 * c * c
    return a2 * INV_PI / (d * d)


@wp.func
def ggx_root(cos: float, alpha: float) -> float:
    """Shared term of Smith's masking: sqrt(alpha^2 + (1 - alpha^2) cos^2)."""
    a2 = alpha * alpha
    return wp.sqrt(a2 + (1.0 - a2) * cos * cos)


@wp.func
def in_front(s: Surface, w: wp.vec3) -> bool:
    """Whether a direction lies above both the shading and the geometric plane."""
    return wp.dot(s.normal, w) > 0.0 and wp.dot(s.normal_g, w) > 0.0


@wp.func
def brdf_cos_diffuse(s: Surface, wo: wp.vec3, wi: wp.vec3) -> wp.vec3:
    """Lambert lobe times the cosine, less what the interface reflects on the way in and out."""
    if not in_front(s, wi) or not in_front(s, wo):
        return wp.vec3(0.0, 0.0, 0.0)
    one = wp.vec3(1.0, 1.0, 1.0)
    ci = wp.dot(s.normal, wi)
    enter = one - fresnel(s.f0, s.f90, ci)
    leave = one - fresnel(s.f0, s.f90, wp.dot(s.normal, wo))
    return wp.cw_mul(wp.cw_mul(s.diffuse, enter), leave) * (ci * INV_PI)


@wp.func
def brdf_cos_specular(s: Surface, wo: wp.vec3, wi: wp.vec3) -> wp.vec3:
    """GGX lobe times the cosine; height-correlated Smith masking (Heitz 2014, eq. 99)."""
    if s.f90 <= 0.0 or not in_front(s, wi) or not in_front(s, wo):
        return wp.vec3(0.0, 0.0, 0.0)
    ci = wp.dot(s.normal, wi)
    co = wp.dot(s.normal, wo)
    h = wp.normalize(wo + wi)
    masking = 0.5 / (ci * ggx_root(co, s.alpha) + co * ggx_root(ci, s.alpha))
    return fresnel(s.f0, s.f90, wp.dot(wo, h)) * (ggx_d(s.normal, h, s.alpha) * masking * ci)


@wp.func
def brdf_cos(s: Surface, wo: wp.vec3, wi: wp.vec3) -> wp.vec3:
    """Both lobes times the cosine."""
    return brdf_cos_diffuse(s, wo, wi) + brdf_cos_specular(s, wo, wi)


@wp.func
def specular_chance(s: Surface, wo: wp.vec3) -> float:
    """Probability of sampling the GGX lobe: its share of what the surface reflects towards ``wo``, roughly."""
    if s.f90 <= 0.0:
        return 0.0
    f = fresnel(s.f0, s.f90, wp.dot(s.normal, wo))
    specular = luminance(f)
    diffuse = luminance(wp.cw_mul(s.diffuse, wp.vec3(1.0, 1.0, 1.0) - f))
    return wp.where(diffuse > 0.0, wp.max(specular / (specular + diffuse), 0.05), 1.0)


@wp.func
def ggx_sample_half(local_wo: wp.vec3, alpha: float, xi: wp.vec2) -> wp.vec3:
    """A visible half vector about +z (Dupuy & Benyoub 2023, "Sampling Visible GGX Normals with Spherical Caps")."""
    w = wp.normalize(wp.vec3(local_wo[0] * alpha, local_wo[1] * alpha, local_wo[2]))
    phi = TWO_PI * xi[0]
    z = (1.0 - xi[1]) * (1.0 + w[2]) - w[2]
    r = wp.sqrt(wp.clamp(1.0 - z * z, 0.0, 1.0))
    h = wp.vec3(r * wp.cos(phi), r * wp.sin(phi), z) + w
    return wp.normalize(wp.vec3(h[0] * alpha, h[1] * alpha, wp.max(h[2], 0.0)))


@wp.func
def brdf_sample(s: Surface, wo: wp.vec3, xi_lobe: float, xi: wp.vec2) -> wp.vec3:
    """A direction with density :func:`brdf_pdf`; it may lie below the surface, where the BRDF is zero."""
    if xi_lobe < specular_chance(s, wo):
        t = tangent_of(s.normal)
        b = wp.cross(s.normal, t)
        h = ggx_sample_half(wp.vec3(wp.dot(wo, t), wp.dot(wo, b), wp.dot(wo, s.normal)), s.alpha, xi)
        half = t * h[0] + b * h[1] + s.normal * h[2]
        return wp.normalize(half * (2.0 * wp.dot(wo, half)) - wo)
    return from_frame(cosine_hemisphere(xi), s.normal)


@wp.func
def brdf_pdf(s: Surface, wo: wp.vec3, wi: wp.vec3) -> float:
    """Solid-angle density of :func:`brdf_sample`."""
    ci = wp.dot(s.normal, wi)
    co = wp.dot(s.normal, wo)
    if ci <= 0.0 or co <= 0.0:
        return 0.0
    chance = specular_chance(s, wo)
    pdf = (1.0 - chance) * ci * INV_PI
    if chance > 0.0:
        h = wp.normalize(wo + wi)
        pdf += chance * ggx_d(s.normal, h, s.alpha) * 0.5 / (co + ggx_root(co, s.alpha))
    return pdf


@wp.func
def hemispherical_albedo_diffuse(s: Surface) -> wp.vec3:
    """Share of uniform light from the whole hemisphere that the Lambert lobe reflects.

    Exact: the cosine-weighted mean of Schlick's (1 - cos)^5 is 1/21, so the interface passes 1 - f0 - (f90 - f0) / 21
    on the way in and again on the way out.
    """
    one = wp.vec3(1.0, 1.0, 1.0)
    passed = one - s.f0 - (wp.vec3(s.f90, s.f90, s.f90) - s.f0) * (1.0 / 21.0)
    return wp.cw_mul(s.diffuse, wp.cw_mul(passed, passed))


@wp.func
def hemispherical_albedo_specular(s: Surface) -> wp.vec3:
    """Share of uniform light from the whole hemisphere that the GGX lobe reflects.

    ``f0 A(alpha) + f90 B(alpha)``; A and B are polynomials fitted to a numerical integral of this lobe for roughness
    0 to 1, with absolute errors up to 0.0022 and 0.0010.
    """
    a = s.alpha
    from_f0 = 0.95334536 + a * (0.02103164 + a * (-2.02790049 + a * (2.2942133 - 0.83604742 * a)))
    from_f90 = 0.04852881 + a * (-0.1654349 + a * (0.21658104 - 0.09786304 * a))
    return s.f0 * from_f0 + wp.vec3(s.f90, s.f90, s.f90) * wp.max(from_f90, 0.0)


@wp.func
def hemispherical_albedo(s: Surface) -> wp.vec3:
    """Share of uniform light from the whole hemisphere that the surface reflects, both lobes."""
    return hemispherical_albedo_diffuse(s) + hemispherical_albedo_specular(s)
