"""Light of a captured place from its shading alone: a dome of low order and one dominant direction.

What a photograph shows of a matt surface is albedo times irradiance, and neither is known. Surfaces of one colour are
taken to have one albedo; then shading tells the light up to a factor per channel, which two conventions fix: light
that arrives directly is white on average, as photographs are balanced, and the lightest surfaces reflect as much as
white paint.

The irradiance comes from the renderer's own kernels, and its Jacobian from Warp's tape (``kernels.light_fit``). Where
it is wrong: lamps that are near, more than one sun, surfaces whose texture follows the shading.

Ramamoorthi and Hanrahan 2001, "A Signal-Processing Framework for Inverse Rendering".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_dvct.capture.albedo import CLIPPED, thinned, unit
from warp_dvct.capture.fusion import FusedMesh
from warp_dvct.capture.irradiance import Lighting, Receivers, real_scene
from warp_dvct.capture.light_solver import (
    HIGH,
    LOW,
    MOST_BOUNCED,
    SAME,
    Solver,
    color_clusters,
    fibonacci_sphere,
    harmonics_of,
)
from warp_dvct.device_scene import DeviceScene, upload_lights
from warp_dvct.errors import OptionError
from warp_dvct.kernels import light_fit as kernels
from warp_dvct.launch import Launcher
from warp_dvct.probe import LUMINANCE, Peak, ProbeLights, directions, horizontal_irradiance
from warp_dvct.scene import Light, LightKind

POINTS = 4000  # surface points that the fit looks at
RAYS = 128  # per point into the dome
TRIED = 1024  # directions among which the dominant one is looked for
LOWEST = 0.1  # sine of the least elevation at which it is looked for: lamps and the sun are above
SEARCHES, ROUNDS = 6, 6  # of light and albedo in turns, with the direction looked for, then refined
# Logarithm of chromaticity between colours that have albedos of their own, and weight of lightness beside it: finer as
# the light becomes known.
GROUPINGS = ((0.6, 0.0), (0.4, 0.0), (SAME, 0.0), (SAME, 0.5))
TURNS = 2  # of the fit and the light that bounces
DARKEST = 0.004  # linear; darker pixels are the sensor's noise
LEAST = 100  # surface points
ILL_CONDITIONED = 100.0  # condition number beyond which errors of 1 % in the shading undo a part of the light
FILLS = np.linspace(0.0, 2.0, 41)  # brightness of what was not seen over that of what was, that is tried
DOME_HEIGHT = 32  # texels of the dome's image; harmonics of degree 2 need no more
SUN_ANGLE = np.radians(2.0)  # of the dominant light's disc: a guess, shading alone does not tell
LEAST_OPEN = 0.02  # mean share of open directions below which no dome can light the surface


@dataclass(frozen=True)
class LightFit:
    """Estimated light of a place, in the photographs' units.

    Attributes:
        harmonics: Radiance of the dome, real spherical harmonics of degree 0 to 2, RGB, ``[9, 3]``.
        toward: Unit direction to the dominant light. irradiance: On a plane that faces it, RGB.
        singular_values: Of the Jacobian of the shading by 9 harmonics, strength and direction of the dominant light,
            each column scaled to unit length; descending, ``[12]``, or ``[10]`` where no light is dominant.
        condition: First over last of them.
        spread: Standard deviation of the direction [rad], from the residual; pi where no light is dominant.
        residual: Root mean square of what the fit leaves, relative to the shading.
        open: Mean share of directions that are not blocked by the surface itself.
        points: Number of surface points used.
    """

    harmonics: np.ndarray
    toward: np.ndarray
    irradiance: np.ndarray
    singular_values: np.ndarray
    condition: float
    spread: float
    residual: float
    open: float
    points: int

    def describe(self) -> tuple[str, ...]:
        """What a user should know of it."""
        return _noted(self)

    def probe(self) -> ProbeLights:
        """The dome as an image, and the dominant light as its peak."""
        rows, columns = np.mgrid[0:DOME_HEIGHT, 0 : 2 * DOME_HEIGHT] + 0.5
        toward = directions(DOME_HEIGHT, 2 * DOME_HEIGHT, rows, columns)
        dome = np.maximum(harmonics_of(toward) @ self.harmonics, 0.0).astype(np.float32)
        peaks = ()
        if self.irradiance.any():
            radiance = self.irradiance / (np.pi * np.sin(0.5 * SUN_ANGLE) ** 2)
            peaks = (Peak(self.toward, float(SUN_ANGLE), radiance, self.irradiance),)
        up = horizontal_irradiance(dome) + self.irradiance * max(float(self.toward[1]), 0.0)
        return ProbeLights(dome, peaks, (up, up))

    def lights(self) -> tuple[Light, ...]:
        """The dome and the dominant light."""
        probe = self.probe()
        suns = [
            Light(
                LightKind.DISTANT,
                (float(p.radiance[0]), float(p.radiance[1]), float(p.radiance[2])),
                direction=(-float(p.toward[0]), -float(p.toward[1]), -float(p.toward[2])),
                angle=p.angle,
                path="/Lights/Peak1",
            )
            for p in probe.peaks
        ]
        return (Light(LightKind.DOME, (1.0, 1.0, 1.0), texture=probe.dome, path="/Lights/Dome"), *suns)


def _noted(fit: LightFit) -> tuple[str, ...]:
    """What a user should know of an estimate."""
    share = float((fit.irradiance @ LUMINANCE) / max(fit.irradiance @ LUMINANCE + _dome_level(fit), 1e-12))
    x, y, z = fit.toward
    source = "no light dominates"
    if fit.irradiance.any():
        angle = np.degrees(fit.spread)
        source = f"{share:.0%} comes from ({x:.2f} {y:.2f} {z:.2f}), known to about {angle:.1f} degrees"
    verdict = ": ill-conditioned, parts of the light are guesses" if fit.condition > ILL_CONDITIONED else ""
    values = " ".join(f"{v:.2g}" for v in fit.singular_values)
    return (
        f"light estimated at {fit.points} points: {source}; the shading is explained to {fit.residual:.0%}",
        f"condition number {fit.condition:.0f}, singular values {values}{verdict}",
    )


def _dome_level(fit: LightFit) -> float:
    """Mean irradiance of the dome on planes that face all ways, luminance."""
    return float(np.pi * 0.28209479 * (fit.harmonics[0] @ LUMINANCE))


def fit_light(launcher: Launcher, mesh: FusedMesh, *, voxel: float, seed: int = 0) -> LightFit:
    """Estimate the light of a scanned place from its vertex colours.

    Args:
        mesh: With colours, in a world with y up.
        voxel: Its resolution in metres.
    Raises:
        OptionError: No colours, too few usable points, or a surface so closed that no outside light enters.
    """
    at, seen, index = _samples(mesh, voxel, seed, clipped=True)
    model = ShadingModel(launcher, mesh, at, seed)
    if model.open < LEAST_OPEN:
        raise OptionError(
            f"only {model.open:.1%} of the directions above the surface are open: no light from outside reaches it, so"
            " none can be estimated; give the lamps inside by --probe LIGHTS.usda"
        )
    solver = Solver(seen, model.dome, model.light, clipped=np.any(seen >= CLIPPED, axis=-1), seed=seed)
    tried = fibonacci_sphere(TRIED)
    tried = tried[tried[:, 1] > LOWEST]
    columns = model.try_directions(tried)
    for _ in range(SEARCHES):
        solver.start_from(tried, columns)
        solver.step(turn=False)
    for apart, lightness in GROUPINGS:
        solver.regroup(apart, lightness)
        for _ in range(ROUNDS):
            solver.step()
    for _ in range(TURNS):
        solver.bounced = _bounced(launcher, mesh, at, index, solver, model)
        for _ in range(ROUNDS):
            solver.step()
    return _result(solver, model)


def fit_fill(
    launcher: Launcher, mesh: FusedMesh, lights: tuple[Light, ...], *, voxel: float, seed: int = 0
) -> np.ndarray:
    """Radiance of what a scan has not seen, where the lamps are known: RGB ``[3]``, 0 or more.

    A room is never scanned whole, and the missing walls reflect light as well. They are taken to look as the scanned
    ones on average, by a factor: the one with which surfaces of one colour come out at the most even albedo.

    Raises:
        OptionError: No colours, or too few usable points.
    """
    at, seen, index = _samples(mesh, voxel, seed)
    assert mesh.colors is not None
    model = ShadingModel(launcher, mesh, at, seed)
    if model.open < LEAST_OPEN:
        return np.zeros(3)
    mean = mesh.colors.astype(np.float64).mean(0)
    cluster = color_clusters(seen, seed, SAME)
    white = np.full((len(mesh.points), 3), 0.5)
    known = Lighting(launcher, mesh, white, lights).direct(at).astype(np.float64)
    unseen = np.maximum(model.dome[:, :1] / 0.28209479, 0.0) * mean  # of a dome as bright as the scan
    bounced, factor = np.zeros_like(seen), 0.5
    for _ in range(TURNS + 1):
        total = known + bounced + factor * unseen
        albedo = _cluster_albedo(np.pi * seen / np.maximum(total, 1e-9), cluster)
        fill = Light(LightKind.DOME, _rgb(factor * mean))
        both = Lighting(launcher, mesh, _spread_albedo(mesh, index, cluster, albedo), (*lights, fill)).gathered(at)
        bounced = np.maximum(both - factor * unseen, 0.0)
        uneven = [_unevenness(seen, known + bounced + f * unseen, cluster) for f in FILLS]
        factor = float(FILLS[int(np.argmin(uneven))])
    return factor * mean


def _cluster_albedo(quotient: np.ndarray, cluster: np.ndarray) -> np.ndarray:
    """Each sample's cluster's median, ``[n, 3]``."""
    albedo = np.empty_like(quotient)
    for k in np.unique(cluster):
        albedo[cluster == k] = np.median(quotient[cluster == k], axis=0)
    return np.clip(albedo, LOW, HIGH)


def _unevenness(seen: np.ndarray, total: np.ndarray, cluster: np.ndarray) -> float:
    """Mean absolute deviation, in logarithms, of the quotients of one colour from their median."""
    log = np.log((seen @ LUMINANCE) / np.maximum(total @ LUMINANCE, 1e-9))
    return float(sum(np.abs(log[cluster == k] - np.median(log[cluster == k])).sum() for k in np.unique(cluster)))


def _samples(
    mesh: FusedMesh, voxel: float, seed: int, *, clipped: bool = False
) -> tuple[Receivers, np.ndarray, np.ndarray]:
    """Surface points that are not black, the radiance that was seen there, and their vertices. Clipped ones are left
    out, or they are taken as they are."""
    if mesh.colors is None:
        raise OptionError("the capture has no photographs, so its light cannot be estimated; give --probe LIGHTS.usda")
    usable = mesh.colors.max(-1) > DARKEST
    if not clipped:
        usable &= (mesh.colors < CLIPPED).all(-1)
    index = np.flatnonzero(usable)
    if len(index) < LEAST:
        raise OptionError(
            f"only {len(index)} vertices are neither clipped nor black in the photographs; give --probe LIGHTS.usda"
        )
    index = index[thinned(mesh.points[index], 3.0 * voxel)]
    if len(index) > POINTS:
        index = np.sort(np.random.default_rng(seed).choice(index, POINTS, replace=False))
    at = Receivers(mesh.points[index].astype(np.float64), unit(mesh.normals[index]), 0.5 * voxel)
    return at, np.maximum(mesh.colors[index].astype(np.float64), 0.25 * DARKEST), index


class ShadingModel:
    """Irradiance at surface points as a function of a dome's harmonics and one distant light, with its Jacobian.

    Attributes:
        dome: Irradiance by each harmonic, ``[n, 9]``.
        open: Mean share of open directions.
    """

    def __init__(self, launcher: Launcher, mesh: FusedMesh, at: Receivers, seed: int) -> None:
        self._launcher, self._seed, self.count = launcher, seed, len(at.points)
        low, high = mesh.points.min(0).astype(np.float64), mesh.points.max(0).astype(np.float64)
        scale = 1.0 / float((high - low).max())
        scene = real_scene(mesh, np.ones((len(mesh.points), 3)), ())
        self._device = DeviceScene.upload(launcher, scene, low, scale)
        self._position = launcher.array(((at.points + at.lift * at.normals - low) * scale), wp.vec3)
        self._normal = launcher.array(at.normals, wp.vec3)
        sun = Light(LightKind.DISTANT, (1.0, 1.0, 1.0))
        self._lights = upload_lights(launcher, (sun,) * self.count, np.zeros(3), 1.0)
        self._last: tuple[np.ndarray, tuple[np.ndarray, np.ndarray]] | None = None
        harmonics: Any = self._harmonics(differentiate=True)
        _, _, seen = self._differentiate(harmonics, np.array([0.0, 1.0, 0.0]), RAYS, 0)
        # Each of the three equal channels was seeded with 1.
        self.dome = harmonics.grad.numpy().reshape(self.count, 9, 3).mean(-1).astype(np.float64)
        self.open = float(seen.mean())

    def light(self, toward: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Irradiance of a distant light of unit irradiance, ``[n]``, and its derivative by the direction toward it,
        ``[n, 3]``."""
        if self._last is None or not np.array_equal(self._last[0], toward):
            value, gradient, _ = self._differentiate(self._harmonics(), toward, 0, 1)
            self._last = (toward.copy(), (value, gradient))
        return self._last[1]

    def try_directions(self, toward: np.ndarray) -> np.ndarray:
        """The same for many directions ``[m, 3]``, without derivatives: ``[n, m]``."""
        launcher, total = self._launcher, self.count * len(toward)
        out = launcher.empty(total, wp.float32)
        launcher.launch(
            kernels._try_directions,
            total,
            [self._device.geometry, self._position, self._normal, launcher.array(toward, wp.vec3)],
            [out],
        )
        return out.numpy().reshape(self.count, len(toward)).astype(np.float64)

    def _harmonics(self, *, differentiate: bool = False) -> Any:
        return wp.zeros(9 * self.count, dtype=wp.vec3, device=self._launcher.device, requires_grad=differentiate)

    def _differentiate(
        self, harmonics: Any, toward: np.ndarray, rays: int, samples: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The light's irradiance and its derivative, and the open share; the dome's derivative is in ``harmonics``."""
        launcher, count, device = self._launcher, self.count, self._launcher.device
        lights = self._lights
        direction: Any = wp.full(count, wp.vec3(*(-toward).tolist()), wp.vec3, device=device, requires_grad=True)
        lights.direction = direction
        kinds = (wp.vec3, wp.vec3, wp.float32)
        outputs = [wp.zeros(count, dtype=kind, device=device, requires_grad=True) for kind in kinds]
        inputs = [self._device.geometry, lights, self._position, self._normal, harmonics, rays, samples, self._seed]
        seeds = {output: wp.full(count, wp.vec3(1.0, 1.0, 1.0), wp.vec3, device=device) for output in outputs[:2]}
        launcher.differentiate(kernels._light_points, count, inputs, outputs, seeds)
        value = outputs[1].numpy().mean(-1).astype(np.float64)
        gradient = -direction.grad.numpy().astype(np.float64) / 3.0  # three equal channels were seeded
        return value, gradient, outputs[2].numpy()


def _rgb(values: np.ndarray) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])


def _spread_albedo(mesh: FusedMesh, index: np.ndarray, cluster: np.ndarray, albedo: np.ndarray) -> np.ndarray:
    """Albedo of every vertex, ``[v, 3]``: that of the cluster with the nearest chromaticity in the photographs."""
    assert mesh.colors is not None
    log = np.log(np.maximum(mesh.colors.astype(np.float64), 1e-3))
    tint = log - log.mean(-1, keepdims=True)
    numbers = np.unique(cluster)
    centers = np.stack([tint[index[cluster == k]].mean(0) for k in numbers])
    values = np.stack([albedo[cluster == k][0] for k in numbers])
    nearest = np.zeros(len(tint), np.int64)
    best = np.full(len(tint), np.inf)
    for k, center in enumerate(centers):
        distance = ((tint - center) ** 2).sum(-1)
        nearest, best = np.where(distance < best, k, nearest), np.minimum(best, distance)
    return values[nearest]


def _bounced(
    launcher: Launcher, mesh: FusedMesh, at: Receivers, index: np.ndarray, solver: Solver, model: ShadingModel
) -> np.ndarray:
    """Share of the irradiance that bounced off the surface under the light as it is estimated now, ``[n, 3]``."""
    fit = _result(solver, model)
    gathered = Lighting(
        launcher, mesh, _spread_albedo(mesh, index, solver.cluster, solver.x.albedo), fit.lights()
    ).gathered(at)
    direct = np.maximum(model.dome @ solver.x.harmonics, 0.0)
    bounced = np.maximum(gathered - direct, 0.0)
    direct = direct + model.light(solver.x.toward)[0][:, None] * solver.x.irradiance
    return np.clip(bounced / np.maximum(bounced + direct, 1e-9), 0.0, MOST_BOUNCED)


def _result(solver: Solver, model: ShadingModel) -> LightFit:
    jacobian = solver.jacobian()
    if not solver.x.irradiance.any():
        jacobian = jacobian[:, :-2]  # no dominant light, so none that could turn
    values = np.linalg.svd(jacobian / np.linalg.norm(jacobian, axis=0), compute_uv=False)
    residual = solver.residual()
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * residual**2
    return LightFit(
        harmonics=solver.x.harmonics,
        toward=solver.x.toward,
        irradiance=solver.x.irradiance,
        singular_values=values,
        condition=float(values[0] / max(values[-1], 1e-12)),
        spread=float(np.sqrt(max(covariance[-2, -2] + covariance[-1, -1], 0.0))) if len(values) > 10 else np.pi,
        residual=residual,
        open=model.open,
        points=model.count,
    )
