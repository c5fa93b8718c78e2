"""Detail that is not gathered on a photograph: only where nothing changes, and the picture stays."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from warp_dvct.kernels import changed_detail
from warp_dvct.relighter import Relighter
from warp_dvct.usd_scenes import path as bundled

COLUMNS, ROWS = 7, 5


@pytest.mark.parametrize("fine", [(14, 10), (13, 9)])
def test_a_block_is_unmarked_where_nothing_around_it_changed(launcher, fine):
    rng = np.random.default_rng(3)
    before = rng.uniform(0.5, 1.0, (ROWS, COLUMNS, 3)).astype(np.float32)
    after = before + 0.02 * np.where(rng.random((ROWS, COLUMNS, 1)) < 0.1, 1, 0.01).astype(np.float32)
    columns, rows = fine
    inside = rng.uniform(0.5, 1.0, (rows, columns, 3)).astype(np.float32)
    inside[rng.random((rows, columns)) < 0.2] = 0.0
    marked = (rng.random((rows, columns)) < 0.7).astype(np.int32)
    mark = launcher.array(marked.ravel(), wp.int32)
    arrays = [launcher.array(a.reshape(-1, 3), wp.vec3) for a in (before, after, inside)]
    least = 0.015
    launcher.launch(changed_detail._unmark_unchanged, rows * columns, [COLUMNS, ROWS, columns, *arrays, least], [mark])
    change = np.pad(np.abs(after - before).max(-1), 1)
    around = np.max([change[y : y + ROWS, x : x + COLUMNS] for y in range(3) for x in range(3)], 0)
    around = np.repeat(np.repeat(around, 2, 0), 2, 1)[:rows, :columns]
    expected = marked * (around >= least * inside.max(-1))
    assert 0 < expected.sum() < marked.sum()
    np.testing.assert_array_equal(mark.numpy().reshape(rows, columns), expected)


def test_on_a_plate_the_picture_stays_and_without_one_it_is_the_same():
    stage = bundled("room_area")
    plain = Relighter(stage, width=160, settings={"gather.change": 0.0, "gather.stride": 8})
    fewer = Relighter(stage, width=160, settings={"gather.change": 0.1, "gather.stride": 8})
    rendered = plain.render()
    np.testing.assert_array_equal(fewer.render().comp, rendered.comp)
    full, sparse = (r.render(rendered.plate).comp for r in (plain, fewer))
    assert not np.array_equal(full, sparse)
    assert np.abs(full - sparse).mean() < 2e-4
    assert np.abs(full - sparse).max() < 0.05
