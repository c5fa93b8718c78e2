"""Frame numbers in file names."""

from __future__ import annotations

import pytest

from warp_dvct.cli.frames import decimals, frame_path, has_placeholder, lost_frame


@pytest.mark.parametrize(
    ("path", "frame", "expected"),
    [
        ("out.####.exr", 7, "out.0007.exr"),
        ("a#b/out.###.exr", 12345, "a#b/out.12345.exr"),
        ("out.####.##.exr", 1.5, "out.0001.50.exr"),
        ("out_##.exr", -3, "out_-03.exr"),
        ("still.exr", 7, "still.exr"),
    ],
)
def test_number_goes_where_the_hashes_are(path, frame, expected):
    assert frame_path(path, frame) == expected


def test_placeholder_is_looked_for_in_the_name_only():
    assert has_placeholder("a/b.#.exr")
    assert not has_placeholder("a#/b.exr")


def test_a_frame_with_decimals_needs_room_for_them():
    assert decimals("a.####.##.exr") == 2
    assert lost_frame("a.####.exr", [1, 2, 2.5]) == 2.5
    assert lost_frame("a.####.##.exr", [1, 2.25]) is None
    assert lost_frame("a.####.#.exr", [1, 2.25]) == 2.25
