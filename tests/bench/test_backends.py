"""``bench backends``: rows on disk, parity of layers, and differences inside the noise."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from warp_dvct.bench import backends as module
from warp_dvct.bench.__main__ import bench
from warp_dvct.bench.rows import append_row, plain, provenance, read_rows
from warp_dvct.errors import DeviceError, FileError, OptionError
from warp_dvct.layers import Layers


def layers(h: int = 12, w: int = 16) -> Layers:
    """A picture whose left half is real and whose right half is synthetic, without noise."""
    rng = np.random.default_rng(5)
    color = rng.uniform(0.2, 1.0, (h, w, 3)).astype(np.float32)
    cover = np.zeros((h, w), np.float32)
    cover[:, w // 2 :] = 1
    normal = np.zeros((h, w, 3), np.float32)
    normal[..., 1] = 1
    depth = np.full((h, w), np.inf, np.float32)
    depth[:, 2:] = 3.0
    names = ("comp", "plate", "shadow", "added", "delta", "albedo", "position")
    return Layers(
        rgba=np.dstack([color, cover]),
        **dict.fromkeys(names, color),
        normal=normal,
        depth=depth,
        mask_real=1 - cover,
        mask_synthetic=cover,
    )


def test_equal_layers_agree_and_infinite_depth_is_no_difference():
    found = module.parity(layers(), layers())
    assert set(found) == set(module.PARITY_LAYERS)
    assert all(value == 0 for layer in found.values() for value in layer.values())


def test_a_difference_counts_outside_of_silhouettes_alone():
    base = layers()
    edges = module.silhouettes(base)
    assert edges[:, 7:9].all()  # coverage changes there
    assert edges[:, 1:3].all()  # depth does
    assert not edges[:, 4:6].any()
    comp = base.comp.copy()
    comp[4, 8] *= 1.5
    at_edge = module.parity(base, replace(base, comp=comp))["comp"]
    assert at_edge["largest"] > 0.05
    assert (at_edge["beyond"], at_edge["largest_inside"]) == (0, 0)
    comp[4, 5] *= 1.01
    inside = module.parity(base, replace(base, comp=comp))["comp"]
    assert inside["beyond"] == pytest.approx(3 / (3 * (~edges).sum()))
    assert inside["largest_inside"] == pytest.approx(0.01 * base.comp[4, 5].max(), rel=1e-3)


def row(seconds: list[float], **changes) -> dict:
    """A row of one pass."""
    base = {"kind": "backends", "stage": "s", "method": "m", "quality": "q", "settings": {}, "width": 8, "height": 8}
    base |= {"backend": "cpu x1", "device": "cpu", "seconds": seconds, "cpu_seconds": seconds}
    return {**base, "passes": {"gather": seconds}, "cpu_passes": {"gather": seconds}, **changes}


@pytest.mark.parametrize(
    ("new", "verdict"),
    [
        ([1.0, 1.01, 0.99], "tie"),
        ([1.02, 1.02, 1.02], "tie"),  # less than 3 %
        ([1.5, 0.9, 1.3], "tie"),  # noisy
        ([1.2, 1.21, 1.19], "slower"),
        ([0.8, 0.81, 0.79], "faster"),
    ],
)
def test_a_difference_inside_the_noise_is_a_tie(new, verdict):
    found = module.compare([row([1.0, 1.0, 1.01])], [row(new)])
    assert [v["verdict"] for v in found] == [verdict, verdict]
    assert [v["pass"] for v in found] == ["frame", "gather"]


def test_only_equal_cases_are_compared():
    with pytest.raises(OptionError, match="no case in common"):
        module.compare([row([1.0, 1.0])], [row([1.0, 1.0], width=9)])


def test_rows_are_written_and_read(tmp_path):
    file = tmp_path / "new" / "rows.jsonl"
    append_row(file, {"kind": "a", "value": float("nan"), "file": file, "number": np.float32(2)})
    append_row(file, {"kind": "b", **provenance()})
    (a,) = read_rows(file, "a")
    assert a == {"kind": "a", "value": None, "file": str(file), "number": 2}
    (b,) = read_rows(file, "b")
    assert b["machine"]["cores"] >= 1
    assert b["versions"]["warp-lang"]
    assert len(read_rows(file)) == 2
    assert read_rows(tmp_path / "none.jsonl") == []


def test_a_row_goes_on_its_own_line_after_one_that_was_cut(tmp_path):
    file = tmp_path / "rows.jsonl"
    file.write_text('{"kind": "a"}')
    append_row(file, {"kind": "b"})
    assert [r["kind"] for r in read_rows(file)] == ["a", "b"]


@pytest.mark.parametrize("bad", ['{"kind": "a"', "[1]", "{}", "text"])
def test_a_broken_file_is_named_with_its_line_and_left_as_it_is(bad, tmp_path):
    file = tmp_path / "rows.jsonl"
    text = f'{{"kind": "backends"}}\n\n{bad}\n'
    file.write_text(text)
    with pytest.raises(FileError, match=rf"{file}:3 is not a row"):
        read_rows(file)
    result = CliRunner().invoke(bench, ["backends", "--width", "16", "--out", str(file)])
    assert isinstance(result.exception, FileError)
    assert file.read_text() == text


def test_plain_values():
    assert plain({"a": [np.int64(1), float("inf")], 2: (np.float64(0.5),)}) == {"a": [1, None], "2": [0.5]}
    json.dumps(plain({"a": np.float32(1)}))


def test_threads_and_devices_to_measure():
    assert [str(b) for b in module.find_backends(["cpu"], [1, 2])] == ["cpu x1", "cpu x2"]
    assert module.find_backends([], [])[0] == module.Backend("cpu", 1)
    with pytest.raises(OptionError, match="--threads is 0"):
        module.find_backends(["cpu"], [0])
    with pytest.raises(DeviceError, match="cuda:7"):
        module.find_backends(["cuda:7"], [])


@pytest.mark.cpu
def test_two_backends_of_a_tiny_room(tmp_path):
    """One and two threads give the same bytes; rows are written, shown and compared with themselves."""
    file = tmp_path / "rows.jsonl"
    small = ["--width", "32", "--set", "volume.resolution=32", "--set", "patches.count=64", "--quality", "draft"]
    arguments = ["backends", *small, "--runs", "2", "--threads", "1", "--threads", "2", "--out", str(file)]
    result = CliRunner().invoke(bench, arguments, catch_exceptions=False)
    assert result.exit_code == 0
    assert "equal to those of cpu x1 bit for bit" in result.output
    assert "no CUDA device" in result.output
    one, two = read_rows(file, "backends")
    assert (one["threads"], two["threads"]) == (1, 2)
    assert len(one["seconds"]) == len(one["cpu_passes"]["gather"]) == 2
    assert sum(median for median in map(max, one["passes"].values())) <= 1.1 * max(one["seconds"])
    assert one["bytes"] > 1e5
    assert module.agree(two)
    result = CliRunner().invoke(bench, ["backends", "--compare", str(file), str(file)], catch_exceptions=False)
    assert "tie" in result.output
    assert "faster" not in result.output


@pytest.mark.cpu
def test_each_method_on_each_backend(tmp_path):
    """Methods repeat like stages; every row says which it is of."""
    file = tmp_path / "rows.jsonl"
    small = ["--width", "16", "--runs", "2", "--threads", "1", "--quality", "draft", "--set", "vpls.count=16"]
    methods = ["--method", "path-trace", "--method", "instant-radiosity", "--set", "samples=1"]
    result = CliRunner().invoke(bench, ["backends", *small, *methods, "--out", str(file)], catch_exceptions=False)
    assert result.exit_code == 0
    assert [r["method"] for r in read_rows(file, "backends")] == ["path-trace", "instant-radiosity"]


def test_unusable_numbers(tmp_path):
    with pytest.raises(OptionError, match="--runs is 1"):
        module.measure("room_area", [module.Backend("cpu")], module.BackendOptions(runs=1))
    with pytest.raises(OptionError, match="no backend"):
        module.measure("room_area", [], module.BackendOptions())
    (tmp_path / "a.jsonl").write_text("")
    result = CliRunner().invoke(bench, ["backends", "--compare", str(tmp_path / "a.jsonl"), str(tmp_path / "a.jsonl")])
    assert isinstance(result.exception, FileError)
    result = CliRunner().invoke(bench, ["backends", "--compare", str(tmp_path / "b.jsonl"), str(tmp_path / "a.jsonl")])
    assert "b.jsonl does not exist" in str(result.exception)


@pytest.mark.parametrize("words", [["warp-dvct", "bench"], ["python", "-m", "warp_dvct.bench"]])
def test_both_ways_to_start(words):
    program = str(Path(sys.executable).parent / words[0])
    done = subprocess.run([program, *words[1:], "backends", "--help"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "--compare" in done.stdout
