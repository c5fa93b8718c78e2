"""Measure one knob at a time anew and write the tables of accuracy.md: ``python docs/make_knob_tables.py``.

Five minutes of processor time on two cores; truths are kept in the cache. It runs what ``bench compare`` runs.
"""

from __future__ import annotations

from pathlib import Path

from warp_dvct.bench.doc_tables import replace_table
from warp_dvct.bench.sweep import SweepOptions, Trial, measure, parse_trials
from warp_dvct.usd_scenes import cache_folder

PAGE = Path(__file__).parent / "accuracy.md"
STAGES = ("room_area", "room_spot", "room_glossy")
PRESET = "the preset"
PAPER = "cones.delta=split cones.filter=isotropic cones.coverage=product cones.escape=volume"
TABLES = {
    "rays or cones": [
        "`gather=cones`: gather=cones",
        "`gather=cones volume.resolution=128`: gather=cones volume.resolution=128",
        "cones at every pixel: gather=cones gather.stride=1 gather.object_stride=1",
        "`gather=cones cones.delta=split`: gather=cones cones.delta=split",
        f"the paper's form: gather=cones {PAPER}",
    ],
    "gather": [
        "`gather.smoothing=0`: gather.smoothing=0",
        "`gather.smoothing=2`: gather.smoothing=2",
        "`gather.rays=16`, objects too: gather.rays=16 gather.object_rays=16",
        "`gather.rays=256`, objects too: gather.rays=256 gather.object_rays=256",
        "`gather.aimed=0`: gather.aimed=0",
        "`gather.aimed=0`, 32 rays: gather.aimed=0 gather.rays=32",
        "`gather.aimed=0.125`: gather.aimed=0.125",
        "`gather.aimed=1`: gather.aimed=1",
        "`gather.detail=0`: gather.detail=0",
        "strides of 2 and 1: gather.stride=2 gather.object_stride=1",
        "strides of 4 and 2: gather.stride=4 gather.object_stride=2",
        "strides of 16 and 8: gather.stride=16 gather.object_stride=8",
    ],
    "shadows": [
        "`shadows=cone`: shadows=cone",
        "4 samples, all traced: shadows.samples=4 shadows.probes=4",
        "16, all traced: shadows.samples=16 shadows.probes=16",
        "64, all traced: shadows.samples=64 shadows.probes=64",
    ],
    "volume and maps": [
        "`volume.resolution=32`: volume.resolution=32",
        "`volume.resolution=128`: volume.resolution=128",
        "`volume.resolution=128 rsm.density=1`: volume.resolution=128 rsm.density=1",
        "`volume.resolution=256 volume.coarse=128`: volume.resolution=256 volume.coarse=128",
        "`rsm.texels=128`: rsm.texels=128",
        "`rsm.texels=256`: rsm.texels=256",
        "`rsm.density=1`: rsm.density=1",
        "`rsm.density=4`: rsm.density=4",
    ],
    "edges and lobes": [
        "`antialias=0`: antialias=0",
        "`antialias=4`: antialias=4",
        "`antialias=16`: antialias=16",
        "`glossy.rays=2`: glossy.rays=2",
        "`glossy.rays=32`: glossy.rays=32",
        "`glossy=cones`: glossy=cones",
        "`glossy.roughness=0.1`, lobes in the diffuse gather: glossy.roughness=0.1",
    ],
}


def main() -> None:
    """Measure every line once on every stage."""
    # The first frame of a stage is dearer: caches are cold.
    texts = ["warm-up:", f"{PRESET}:", *(text for table in TABLES.values() for text in table)]
    trials = parse_trials(texts)
    options = SweepOptions(samples=128, cache=cache_folder() / "references")
    measured: dict[str, dict[str, Trial]] = {}
    for stage in STAGES:
        _, done = measure(stage, trials, options, lambda trial: print(trial, flush=True))
        measured[stage] = {trial.name: trial for trial in done}
    for name, lines in TABLES.items():
        rows = ["| setting | " + " | ".join(STAGES) + " |", "| --- |" + " --- |" * len(STAGES)]
        for label in (PRESET, *parse_trials(lines)):
            rows.append(f"| {label} | " + " | ".join(cell(measured[stage][label]) for stage in STAGES) + " |")
        replace_table(PAGE, name, "\n".join(rows))


def cell(trial: Trial) -> str:
    """FLIP / delta error in % / processor seconds."""
    return f"{trial.flip:.4f} / {100 * trial.delta_error:.1f} / {trial.cpu_seconds:.2f}"


if __name__ == "__main__":
    main()
