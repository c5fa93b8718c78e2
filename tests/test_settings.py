"""Knobs: names, suggestions, types, ranges and presets."""

from __future__ import annotations

import math
from dataclasses import fields

import pytest

from warp_dvct import Relighter, usd_scenes
from warp_dvct.errors import OptionError
from warp_dvct.settings import NAMES, PRESETS, QUALITIES, Settings, describe_settings, make_settings


def test_defaults_are_balanced():
    assert make_settings() == make_settings("balanced")
    assert {f.name for f in fields(Settings)} == set(NAMES.values())
    assert set(PRESETS) == set(QUALITIES)


def test_bounces_go_by_the_method_where_each_takes_maps_of_its_own():
    """Links between patches make further bounces free; further VPLs need shadow maps."""
    assert {make_settings(q).bounces for q in QUALITIES} == {12}
    assert [make_settings(q, method="instant-radiosity").bounces for q in QUALITIES] == [4, 6, 12]
    assert make_settings("draft", {"bounces": 1}, "instant-radiosity").bounces == 1
    assert Relighter(usd_scenes.path("room_area"), method="instant-radiosity", width=16).settings.bounces == 6


def test_presets_differ_and_every_default_is_in_its_own_range():
    made = [make_settings(q) for q in QUALITIES]
    assert len(set(made)) == len(QUALITIES)
    assert 1 <= make_settings("draft").bounces <= make_settings("high").bounces
    assert make_settings("balanced").bounces > 1, "a photograph holds all bounces"
    for quality in QUALITIES:
        settings = make_settings(quality)
        again = make_settings(quality, {name: getattr(settings, field) for name, field in NAMES.items()})
        assert again == settings


@pytest.mark.parametrize(
    ("typo", "meant"),
    [
        ("gahter.rays", "gather.rays"),
        ("volume_resolution", "volume.resolution"),
        ("cones.counts", "cones.count"),
        ("bounce", "bounces"),
        ("shadows.sample", "shadows.samples"),
    ],
)
def test_unknown_names_suggest_the_nearest(typo, meant):
    with pytest.raises(OptionError, match=rf"there is no setting '{typo}'; did you mean '{meant}'\?"):
        make_settings(overrides={typo: 1})


def test_nothing_near_lists_all():
    with pytest.raises(OptionError, match=r"'xqzw' \(all: .*volume\.resolution.*\)"):
        make_settings(overrides={"xqzw": 1})


def test_unknown_quality_lists_them():
    with pytest.raises(OptionError, match="'best'; choose one of draft, balanced, high"):
        make_settings("best")


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("bounces", "3", 3),
        ("bounces", 3.0, 3),
        ("cones.step", "0.5", 0.5),
        ("cones.step", 1, 1.0),
        ("gather", "cones", "cones"),
        ("volume.resolution", 1024, 1024),
        ("gather.object_rays", "16", 16),
    ],
)
def test_values_are_converted(name, value, expected):
    got = getattr(make_settings(overrides={name: value}), NAMES[name])
    assert got == expected
    assert type(got) is type(expected)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("bounces", "many", "bounces='many' is not a whole number"),
        ("bounces", "2.5", "bounces='2.5' is not a whole number"),
        ("bounces", 2.5, "bounces=2.5 is not a whole number"),
        ("bounces", None, "bounces=None is not a whole number"),
        ("bounces", math.inf, "bounces=inf is not a whole number"),
        ("bounces", math.nan, "bounces=nan is not a whole number"),
        ("bounces", -1, "bounces=-1 is outside 0 … 64"),
        ("cones.count", 3, "cones.count=3 is outside 4 … 36"),
        ("cones.count", "37", "cones.count=37 is outside 4 … 36"),
        ("volume.resolution", 1025, "outside 1 … 1024"),
        ("cones.step", "wide", "cones.step='wide' is not a number"),
        ("cones.step", math.nan, "cones.step=nan is outside"),
        ("cones.step", math.inf, "cones.step=inf is outside"),
        ("gather", "guess", "gather='guess'; choose one of rays, cones"),
        ("cones.filter", "", "choose one of directional, isotropic"),
    ],
)
def test_what_does_not_fit_is_named(name, value, message):
    with pytest.raises(OptionError) as caught:
        make_settings(overrides={name: value})
    assert message in str(caught.value)


def test_overrides_win_over_the_preset():
    settings = make_settings("draft", {"bounces": 5})
    assert settings.bounces == 5
    assert settings.volume_resolution == PRESETS["draft"]["volume.resolution"]


def test_every_knob_is_described():
    lines = describe_settings().splitlines()
    assert len(lines) == len(NAMES)
    for line, name in zip(lines, NAMES, strict=True):
        assert line.startswith(f"{name}=")
        assert len(line.split("): ")[1]) > 10
