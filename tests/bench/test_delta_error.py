"""Eq. 9: the dual march has no error of its own, the paper's single occupancy has."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from warp_dvct.bench.__main__ import bench
from warp_dvct.bench.delta_error import FORMS, delta_error, format_rows
from warp_dvct.errors import OptionError
from warp_dvct.scene import Role
from warp_dvct.usd.read import read_stage
from warp_dvct.usd_scenes import path

FAST = {"volume.resolution": 64, "volume.coarse": 48, "rsm.texels": 256}


@pytest.fixture(scope="module")
def scene():
    return read_stage(path("room_area"))


@pytest.fixture(scope="module")
def rows(launcher, scene):
    return {row.form: row for row in delta_error(launcher, scene, width=48, settings=FAST)}


def test_dual_form_has_no_error(rows):
    """Cρ and Cµ come from volumes of their own, so that this is no identity: both scenes in one march are exact."""
    assert rows["dual"].mean < 1e-5
    assert rows["dual"].worst < 2e-3, "a march may stop at 99.9 % coverage"


@pytest.mark.parametrize("form", ["split", "paper"])
def test_a_single_occupancy_has(rows, form):
    """It cannot hold the indirect light that the objects block: an error of the order of the delta itself."""
    assert rows[form].mean > 1000 * rows["dual"].mean
    assert rows[form].rms > 0.01
    assert rows[form].rms > 0.5 * abs(rows[form].delta / rows[form].before)


def test_the_delta_is_closer_to_exact_rays_with_both_occupancies(rows):
    for form in ("split", "paper"):
        assert rows["dual"].against_rays < rows[form].against_rays
    assert rows["dual"].against_rays < 0.15
    assert rows["dual"].delta < 0


def test_table_has_a_line_per_form(rows):
    text = format_rows("room", list(rows.values()))
    assert [line.split()[0] for line in text.splitlines()[2:]] == list(FORMS)


def test_nothing_synthetic_is_refused(launcher, scene):
    with pytest.raises(OptionError, match="nothing synthetic"):
        delta_error(launcher, replace(scene, meshes=tuple(m for m in scene.meshes if m.role == Role.REAL)))


def test_command_prints_and_writes(tmp_path):
    file = tmp_path / "eq9.json"
    pairs = [x for k, v in FAST.items() for x in ("--set", f"{k}={v}")]
    result = CliRunner().invoke(bench, ["eq9", "--width", "24", "--json", str(file), *pairs], catch_exceptions=False)
    assert result.exit_code == 0
    assert "dual" in result.output
    assert "split" in result.output
    stages = json.loads(file.read_text())["stages"]
    assert list(stages) == ["room_area"]
    assert [row["form"] for row in stages["room_area"]] == list(FORMS)
    assert np.isfinite([v for row in stages["room_area"] for k, v in row.items() if k != "form"]).all()
