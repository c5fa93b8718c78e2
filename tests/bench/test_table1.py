"""Table 1: the paper's rows beside ours."""

import json

import pytest
from click.testing import CliRunner
from pxr import Usd, UsdRender, UsdShade

from warp_dvct.bench import table1
from warp_dvct.bench.__main__ import bench
from warp_dvct.errors import OptionError
from warp_dvct.usd_scenes import path


def times(variant, passes):
    return table1.Times(variant, passes, {}, 1000.0, 500.0, 64.0)


def test_the_papers_sums_are_the_sums_of_its_rows():
    """Guards the transcription: both sums of the paper, for its glossy row, in all three scenes."""
    for scene in range(3):
        glossy = table1.PAPER["Cone-tracing, glossy"][scene]
        shared = sum(v[scene] for k, v in table1.PAPER.items() if not k.startswith(("Cone", "∑", "DVCT", "Rµ +")))
        assert shared + glossy == pytest.approx(table1.PAPER["∑ (glossy)"][scene], abs=0.02)
        without = shared - sum(table1.PAPER[k][scene] for k in ("Deferred pass", "Postprocessing"))
        assert table1.PAPER["Rµ + Rρ"][scene] == pytest.approx(table1.PAPER["Rµ"][scene] + table1.PAPER["Rρ"][scene])
        assert without + glossy == pytest.approx(table1.PAPER["DVCT cost (glossy)"][scene], abs=0.02)


def test_every_mapped_row_is_a_row_of_the_paper():
    assert set(table1.PASSES) - {table1.CONES} <= set(table1.PAPER)
    mapped = [name for passes in table1.PASSES.values() for name in passes]
    assert len(mapped) == len(set(mapped)), "a pass counted twice"


def test_passes_are_summed_and_unknown_ones_kept():
    post = table1.PASSES["Postprocessing"]
    rows, others = table1.rows_of({post[0]: 2.0, post[1]: 3.0, "reinject": 7.0})
    assert rows == {"Postprocessing": 5.0}
    assert others == {"reinject": 7.0}


def test_table_puts_each_variant_in_its_cone_row():
    cone = table1.PASSES[table1.CONES][0]
    passes = {cone: 11.0, "novel_pass": 3.25}
    text = table1.format_table([times("diffuse", passes), times("glossy", {cone: 22.5})], "title")
    lines = {line.split("  ")[0]: line for line in text.splitlines() if line}
    assert lines["Cone-tracing, diffuse"].split()[-2:] == ["11.00", "-"]
    assert lines["Cone-tracing, glossy"].split()[-2:] == ["-", "22.50"]
    assert lines["Voxelization"].split()[-5:] == ["2.29", "3.04", "4.39", "-", "-"]
    assert lines["novel_pass"].split()[-2:] == ["3.25", "-"]
    assert lines["∑ (glossy)"].split()[-2:] == ["-", "22.50"]


def test_medians_count_absent_passes_as_zero():
    stats = [{"passes": {"a": 0.001}}, {"passes": {"a": 0.003, "b": 0.5}}, {"passes": {"a": 0.002}}]
    assert table1._median_passes(stats) == {"a": pytest.approx(2.0), "b": 0.0}


@pytest.mark.parametrize("variant", table1.VARIANTS, ids=lambda v: v.name)
def test_variant_stages_compose(variant, tmp_path):
    """The specular variant has its roughness, and still a camera, a role per prim and render settings' prims."""
    stage = Usd.Stage.Open(str(table1.variant_stage(variant, tmp_path)))
    assert stage.GetDefaultPrim().GetPath() == "/World"
    assert UsdRender.Settings.GetStageRenderSettings(stage), "stage metadata does not come through a sublayer"
    assert stage.GetPrimAtPath("/World/Real").GetAttribute("primvars:dvct:reality").Get() == "real"
    for name, roughness in variant.roughness.items():
        shader = UsdShade.Shader(stage.GetPrimAtPath(f"/World/Materials/{name}/Surface"))
        assert shader.GetIdAttr().Get() == "UsdPreviewSurface", "the override must fall on an existing shader"
        assert shader.GetInput("roughness").Get() == roughness
    if not variant.roughness:
        assert stage.GetRootLayer().realPath == str(path(variant.stage))


def test_zero_runs_are_refused():
    with pytest.raises(OptionError, match="--runs is 0"):
        table1.measure(
            table1.VARIANTS[0], quality="draft", settings={}, width=8, height=8, runs=0, device="cpu", threads=1
        )


def test_command_fills_the_papers_rows(tmp_path):
    """Every row of the paper gets a time of ours from a real run, and no pass is lost."""
    file = tmp_path / "times.json"
    arguments = ["table1", "--runs", "1", "--width", "64", "--height", "36", "--json", str(file)]
    for setting in ("volume.resolution=32", "rsm.texels=64"):
        arguments += ["--set", setting]
    result = CliRunner().invoke(bench, arguments, catch_exceptions=False)
    assert result.exit_code == 0
    for variant in json.loads(file.read_text())["times"]:
        rows, others = table1.rows_of(variant["first"])
        assert set(rows) == set(table1.PASSES), "a pass was renamed: mend table1.PASSES"
        assert sum(rows.values()) + sum(others.values()) <= 1.05 * variant["first_total"]
        assert not {"voxelize", "rsm", "inject"} & set(variant["next"]), "the unchanged scene keeps its volumes"
    assert "Split-inject" in result.output
