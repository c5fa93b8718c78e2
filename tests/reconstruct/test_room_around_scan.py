"""What stands for the parts of a room that no frame has seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from warp_dvct.bench.reconstruct import compare_pictures, lights_layer
from warp_dvct.capture.albedo import estimate_albedo
from warp_dvct.capture.enclosure import Enclosure, find_enclosure
from warp_dvct.capture.fusion import FusedMesh, FusionOptions
from warp_dvct.capture.irradiance import Lighting, Receivers
from warp_dvct.capture.reconstruct import ReconstructOptions, reconstruct
from warp_dvct.capture.source import CaptureFrames
from warp_dvct.errors import OptionError
from warp_dvct.scene import Light, LightKind, Role
from warp_dvct.usd.read import read_stage
from warp_dvct.usd_scenes import path as bundled

LOW, HIGH = np.array([-2.0, 0.0, -1.5]), np.array([1.0, 2.4, 2.5])
LAMP = Light(LightKind.SPHERE, (6.0, 5.0, 4.0), position=(-0.5, 1.8, 0.3), radius=0.1)
EYES = np.array([[0.0, 1.2, 1.9], [0.2, 1.3, 2.1]])
VOXEL = 0.05
ALBEDO = np.array([0.6, 0.5, 0.4])


def room(sides: dict[int, tuple[float, float]], *, turn: float = 0.0, color=ALBEDO) -> FusedMesh:
    """Sides of a box as a grid of vertices; 0 … 5 for -x, +x, -y, +y, -z, +z, each cut off at two shares."""
    points, normals, triangles, count = [], [], [], 0
    for side, shares in sides.items():
        axis, upper = side // 2, side % 2
        u, v = (axis + 1) % 3, (axis + 2) % 3
        far = HIGH.copy()
        far[u], far[v] = (LOW[k] + share * (HIGH[k] - LOW[k]) for k, share in zip((u, v), shares, strict=True))
        across, along = (np.arange(LOW[k], far[k] + 1e-6, VOXEL) for k in (u, v))
        grid = np.zeros((len(across), len(along), 3))
        grid[..., axis] = HIGH[axis] if upper else LOW[axis]
        grid[..., u], grid[..., v] = across[:, None], along[None]
        number = count + np.arange(grid[..., 0].size).reshape(grid.shape[:2])
        a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
        ring = (a, d, c, b) if upper else (a, b, c, d)
        quads = np.stack(ring, -1).reshape(-1, 4)
        triangles += [quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]
        points.append(grid.reshape(-1, 3))
        normals.append(np.tile((1.0 - 2.0 * upper) * np.eye(3)[axis], (len(points[-1]), 1)))
        count += len(points[-1])
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    where = np.concatenate(points)
    colors = np.broadcast_to(np.asarray(color, np.float32), where.shape)
    return FusedMesh(
        (where @ rotation.T).astype(np.float32),
        (np.concatenate(normals) @ rotation.T).astype(np.float32),
        colors,
        np.concatenate(triangles).astype(np.int32),
        {},
        1,
        1,
        0,
    )


PART = {0: (1.0, 0.6), 2: (0.6, 1.0), 4: (1.0, 1.0)}  # the left wall and the floor as far as the camera saw, the back
WHOLE = {side: (1.0, 1.0) for side in range(6)}


def found(mesh: FusedMesh, **options) -> Enclosure:
    enclosure = find_enclosure(mesh, EYES, (LAMP,), voxel=VOXEL, **options)
    assert enclosure is not None
    return enclosure


def test_walls_go_on_in_their_plane_and_colour():
    mesh = room(PART)
    colors = np.array(mesh.colors)
    colors[mesh.normals[:, 0] > 0.9] = [0.7, 0.1, 0.1]
    enclosure = found(replace(mesh, colors=colors))
    assert enclosure.seen == (True, False, True, False, True, False)
    left = enclosure.side == 0
    np.testing.assert_allclose(enclosure.points[left, 0], LOW[0], atol=2.1 * VOXEL)
    # Nothing where the scan is, something from its end to the camera's side, less half a tile.
    assert enclosure.points[left, 2].min() > LOW[2] + 0.6 * (HIGH[2] - LOW[2]) - 0.5
    assert enclosure.points[left, 2].max() > EYES[:, 2].max() + 0.25
    assert not (enclosure.side == 4).any() or enclosure.points[enclosure.side == 4, 0].min() > HIGH[0] - 0.5
    albedo = enclosure.albedo(colors)
    np.testing.assert_allclose(albedo[left], np.tile([0.7, 0.1, 0.1], (left.sum(), 1)), atol=1e-6)
    mean = albedo[enclosure.side == 5][0]
    assert (np.array([0.6, 0.1, 0.1]) < mean).all()
    assert (mean < [0.7, 0.5, 0.4]).all()


def test_tiles_face_inward_and_close_the_box():
    enclosure = found(room(PART))
    a, b, c = (enclosure.points[enclosure.triangles[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    assert ((cross * enclosure.normals[enclosure.triangles[:, 0]]).sum(-1) > 0).all()
    middle = np.array([-0.5, 1.2, 0.5])
    assert (((middle - a) * cross).sum(-1) > 0).all()
    x, y, z = enclosure.size
    area = 0.5 * np.linalg.norm(cross, axis=-1).sum() + sum(
        (HIGH[k] - LOW[k]) * (HIGH[j] - LOW[j]) * share for k, j, share in ((1, 2, 0.6), (2, 0, 0.6), (0, 1, 1.0))
    )
    assert area == pytest.approx(2.0 * (x * y + y * z + z * x), rel=0.05)


def test_the_box_turns_with_the_walls_and_not_with_what_stands_askew():
    askew = room({4: (0.3, 0.5)}, turn=np.radians(25.0))
    mesh = room(PART)
    both = FusedMesh(
        np.concatenate([mesh.points, askew.points * 0.5]),
        np.concatenate([mesh.normals, askew.normals]),
        None,
        np.concatenate([mesh.triangles, askew.triangles + len(mesh.points)]),
        {},
        1,
        1,
        0,
    )
    normals = found(both).normals
    assert np.abs(normals).max(-1).min() > np.cos(np.radians(1.0))
    turned = found(room(PART, turn=0.3)).normals
    angle = np.arctan2(turned[:, 2], turned[:, 0])[np.abs(turned[:, 1]) < 0.5] % (0.5 * np.pi)
    np.testing.assert_allclose(angle, 0.5 * np.pi - 0.3, atol=np.radians(0.5))


def test_what_is_no_room_has_none():
    sun = Light(LightKind.DISTANT, (3.0, 3.0, 3.0), direction=(0.0, -1.0, 0.0), path="/Lights/Sun")
    assert find_enclosure(room({2: (1.0, 1.0)}), EYES, (LAMP,), voxel=VOXEL) is None
    assert find_enclosure(room({2: (1.0, 1.0), 4: (1.0, 1.0)}), EYES, (LAMP,), voxel=VOXEL) is None
    assert find_enclosure(room(PART), EYES, (LAMP, sun), voxel=VOXEL) is None
    assert find_enclosure(room({2: (1.0, 1.0)}), EYES, (LAMP,), voxel=VOXEL, asked=True) is not None
    with pytest.raises(OptionError, match=r"/Lights/Sun does not get into a closed room"):
        find_enclosure(room(PART), EYES, (LAMP, sun), voxel=VOXEL, asked=True)
    with pytest.raises(OptionError, match=r"unseen is 'box'; choose one of auto, room, dome, none"):
        ReconstructOptions(unseen="box")


def test_light_bounces_as_in_the_whole_room_and_albedo_is_found(launcher):
    """The truth is the room with all of its walls; three of its sides were scanned, one of them whole."""
    part, whole = room(PART), room(WHOLE)
    everywhere = np.tile(ALBEDO, (len(whole.points), 1))
    at = Receivers(part.points[::7].astype(np.float64), part.normals[::7].astype(np.float64), 0.5 * VOXEL)
    truth = Lighting(launcher, whole, everywhere, (LAMP,))
    expected = truth.gathered(at)
    enclosure = found(part)
    ours = Lighting(launcher, *enclosure.around(part, np.tile(ALBEDO, (len(part.points), 1))), (LAMP,)).gathered(at)
    open_ = Lighting(launcher, part, np.tile(ALBEDO, (len(part.points), 1)), (LAMP,)).gathered(at)
    assert open_.mean() < 0.5 * expected.mean()
    assert ours.mean() == pytest.approx(expected.mean(), rel=0.1)
    all_ = Receivers(part.points.astype(np.float64), part.normals.astype(np.float64), 0.5 * VOXEL)
    light = truth.direct(all_) + truth.gathered(all_)
    seen = replace(part, colors=(ALBEDO * light / np.pi).astype(np.float32))
    albedo = estimate_albedo(launcher, seen, (LAMP,), voxel=VOXEL, enclosure=enclosure).values
    np.testing.assert_allclose(np.median(albedo, axis=0), ALBEDO, rtol=0.05)


def test_pictures_are_near_to_those_of_the_true_room(room_capture, tmp_path):
    """The mean difference is at most 0.06 FLIP, and smaller than with even light in place of the unseen."""
    stage = bundled("room_area")
    probe = lights_layer(stage, tmp_path / "lights.usda")
    truth, flip = read_stage(stage), {}
    for unseen in ("auto", "dome"):
        scene = tmp_path / f"{unseen}.usda"
        options = ReconstructOptions(FusionOptions(voxel=0.03), probe=str(probe), unseen=unseen)
        made = reconstruct(room_capture, CaptureFrames(room_capture), scene, options)
        assert any(("a room of" if unseen == "auto" else "radiance") in note for note in made.notes)
        flip[unseen] = compare_pictures(room_capture, scene, truth, pictures=2, quality="draft")
    read = read_stage(tmp_path / "auto.usda", allow_empty_roles=True)
    assert {m.path: m.role for m in read.meshes} == {"/Capture/mesh": Role.REAL, "/Capture/unseen": Role.REAL}
    assert not any(light.kind == LightKind.DOME for light in read.lights)
    assert max(flip["auto"]) < 0.06
    assert np.mean(flip["auto"]) < 0.8 * np.mean(flip["dome"])
