"""The kernels against their float64 twins, on small inputs."""

from __future__ import annotations

import pytest

from warp_dvct.bench.doc_tables import read_table, replace_table
from warp_dvct.bench.twins import Deviation, format_deviations, measure_all
from warp_dvct.bench.twins.deviation import compare
from warp_dvct.cli.warmup import kernel_modules
from warp_dvct.errors import FileError
from warp_dvct.kernels import composite

HALVES = ("composite",)  # outputs are rounded to half precision: 2^-11
LARGEST = 3e-6
# A bilinear share is the fraction of a picture coordinate, which loses five bits where the picture is 40 pixels wide.
SHARES = {"history": 1e-5}


@pytest.fixture(scope="module")
def rows(launcher) -> list[Deviation]:
    return measure_all(launcher)


def test_every_deviation_is_a_few_roundings(rows):
    for row in rows:
        assert row.largest <= (6e-4 if row.family in HALVES else SHARES.get(row.family, LARGEST)), row


def test_decisions_are_the_same_but_for_a_few_rays_past_edges(rows):
    for row in rows:
        assert row.otherwise <= 0.005, row
        assert row.elements > 0


def test_every_family_of_the_picture_has_a_twin(rows):
    families = {row.family for row in rows}
    assert families >= {
        *("gbuffer", "rsm", "shading", "path_tracing", "voxelization", "injection", "pyramid", "gather", "specular"),
        *("bounces", "reconstruction", "warping", "vpl_shading", "vpls", "ism", "resolve", "composite", "tonemap"),
        *("difference", "history", "vpl_bounces", "lens", "light_fit", "lobe_smoothing"),
    }
    assert "_gather_rays_glossy" in {row.kernel for row in rows}
    assert families <= {name.rpartition(".")[2] for name in kernel_modules()}


def test_a_wrong_number_shows():
    """A deviation is relative to the largest value; beyond 1e-3 it counts as another decision."""
    kernel = composite._composite_pixels
    near = compare(kernel, "x", [1.0, 2.0, 4.0], [1.0, 2.0 + 4e-4, 4.0])
    assert near.largest == pytest.approx(1e-4)
    assert near.otherwise == 0.0
    far = compare(kernel, "x", [1.0, 2.0, 4.0], [1.0, 3.0, 4.0])
    assert (far.largest, far.otherwise) == (0.0, pytest.approx(1 / 3))
    with pytest.raises(ValueError, match="shapes"):
        compare(kernel, "x", [1.0], [1.0, 2.0])


def test_the_table_goes_between_its_comments(tmp_path, rows):
    page = tmp_path / "page.md"
    page.write_text("# A\n\n<!-- deviations -->\nold\n<!-- end of deviations -->\n\nrest\n")
    table = format_deviations(rows[:2])
    replace_table(page, "deviations", table)
    assert read_table(page, "deviations") == table
    assert page.read_text().startswith("# A\n")
    assert page.read_text().endswith("\n\nrest\n")
    with pytest.raises(FileError, match="no table 'other'"):
        read_table(page, "other")
    with pytest.raises(FileError, match="cannot be read"):
        read_table(tmp_path / "absent.md", "deviations")
