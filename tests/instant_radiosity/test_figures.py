"""The artefacts that the paper's two maps and VPL3 remove (Knecht et al. 2012, figures 4, 5, 6, 14 to 16)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from warp_dvct import usd_scenes
from warp_dvct.bench.references import ReferenceStore
from warp_dvct.metrics import flip_ldr, smooth_delta
from warp_dvct.relighter import Relighter
from warp_dvct.scene import LightRole
from warp_dvct.usd.read import read_stage

WIDTH, HEIGHT = 128, 72


def truth_of(launcher, folder, scene, bounces, samples=32):
    store = ReferenceStore(
        scene, WIDTH, HEIGHT, samples=samples, seed=1, cache=folder, launcher=launcher, quiet=True
    )  # fmt: skip
    return store.get(bounces)


def composite(scene, plate, bounces, **settings):
    values = {"bounces": bounces, **{k.replace("__", "."): v for k, v in settings.items()}}
    return Relighter(scene, method="instant-radiosity", width=WIDTH, height=HEIGHT, settings=values).render(plate)


def error_in(region, layers, truth):
    return float(np.abs(layers.delta - smooth_delta(truth.delta, truth.coverage))[region].mean())


@pytest.mark.parametrize("visibility", ["ray", "ism"])
def test_double_shadow(launcher, tmp_path, visibility):
    """Where a real box shades the floor already, the ball above it takes nothing off once more."""
    scene = read_stage(usd_scenes.path("double_shadow"))
    direct, truth = (truth_of(launcher, tmp_path, scene, bounces) for bounces in (0, 1))
    old = composite(scene, truth.before, 1, visibility=visibility, shadow_maps="single")
    new = composite(scene, truth.before, 1, visibility=visibility)
    # Shaded by the box: no direct light, before or after, though the old method takes some off.
    shaded = (direct.before.max(-1) < 1e-3) & (truth.coverage == 0) & (old.delta.min(-1) < -0.1)
    assert shaded.sum() > 30
    assert error_in(shaded, new, truth) < 0.25 * error_in(shaded, old, truth)


@pytest.mark.parametrize("visibility", ["ray", "ism"])
def test_colour_bleeding(launcher, tmp_path, visibility):
    """The tint of the block that the box now shades is in the plate; VPL3 takes it off."""
    scene = read_stage(usd_scenes.path("colour_bleeding"))
    direct, truth = (truth_of(launcher, tmp_path, scene, bounces) for bounces in (0, 1))
    old = composite(scene, truth.before, 1, visibility=visibility, shadow_maps="single")
    new = composite(scene, truth.before, 1, visibility=visibility)
    delta = smooth_delta(truth.delta, truth.coverage)
    tinted = (np.abs(direct.delta).max(-1) < 1e-3) & (truth.coverage == 0) & (delta[..., 2] < -0.03)
    assert tinted.sum() > 500
    assert error_in(tinted, new, truth) < 0.25 * error_in(tinted, old, truth)


def test_a_synthetic_lamp_lights_real_objects(launcher, tmp_path):
    """Figures 11 to 13: an added light and its bounces, on real and synthetic surfaces."""
    scene = read_stage(usd_scenes.path("room_spot"))
    lights = tuple(replace(light, role=LightRole.ADDED) for light in scene.lights)
    scene = replace(scene, lights=lights)
    plate = np.full((HEIGHT, WIDTH, 3), 0.02, np.float32)
    for bounces in (1, 2, 3):
        truth = truth_of(launcher, tmp_path, scene, bounces)
        assert (truth.before == 0).all()
        layers = composite(scene, plate, bounces)
        free = truth.coverage == 0
        assert layers.delta[free].mean() == pytest.approx(truth.delta[free].mean(), rel=0.1)
        assert (layers.delta[free] >= -1e-3).all()


@pytest.mark.parametrize("stage", ["room_spot", "ground_dome"])
def test_composite_is_near_the_truth(launcher, tmp_path, stage):
    scene = read_stage(usd_scenes.path(stage))
    truth = truth_of(launcher, tmp_path, scene, 1)
    pasted = flip_ldr(truth.comp, composite(scene, truth.before, 0, vpls__sky=1).comp)[0]
    found = flip_ldr(truth.comp, composite(scene, truth.before, 1).comp)[0]
    assert found < 0.06
    assert found < 0.75 * pasted
