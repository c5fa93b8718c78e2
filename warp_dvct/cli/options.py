"""Options that more than one command has, named and behaving as usdrecord's where it has them."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from warp_dvct.budget import Choice
    from warp_dvct.relighter import Relighter

METHODS = ("delta-cones", "instant-radiosity", "path-trace")
QUALITIES = ("draft", "balanced", "high")
COMPLEXITIES = ("low", "medium", "high", "veryhigh")
PURPOSES = ("default", "render", "proxy", "guide")


def _split_settings(_context: click.Context, _option: click.Parameter, pairs: tuple[str, ...]) -> dict[str, str]:
    settings = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not (key.strip() and equals and value.strip()):
            raise click.BadParameter(f"'{pair}' is not KEY=VALUE")
        settings[key.strip()] = value.strip()
    return settings


def _split_purposes(_context: click.Context, _option: click.Parameter, text: str) -> tuple[str, ...]:
    """usdrecord's form: names separated by commas or spaces; 'default' is always among them."""
    names = text.replace(",", " ").split()
    for name in names:
        if name not in PURPOSES:
            raise click.BadParameter(f"'{name}' is not a purpose; choose from {', '.join(PURPOSES)}")
    return tuple(dict.fromkeys(["default", *names]))


_STAGE_OPTIONS = (
    click.option(
        "--method",
        type=click.Choice(METHODS),
        default="delta-cones",
        show_default=True,
        help="delta-cones is the fast one; instant-radiosity takes virtual lights; path-trace is the unbiased truth.",
    ),
    click.option(
        "--quality", type=click.Choice(QUALITIES), default="balanced", show_default=True, help="Preset of the settings."
    ),
    click.option(
        "--set",
        "settings",
        metavar="KEY=VALUE",
        multiple=True,
        callback=_split_settings,
        help="Change one setting of the preset, as bounces=2. May be repeated.",
    ),
    click.option(
        "--budget",
        type=float,
        metavar="SECONDS",
        help="Choose the settings so that a frame from scratch takes about as long, instead of --quality.",
    ),
    click.option(
        "--max-error",
        type=float,
        metavar="FLIP",
        help="Choose the cheapest settings whose predicted mean LDR-FLIP is no larger, instead of --quality.",
    ),
    click.option(
        "--camera", "-cam", metavar="PATH", help="Camera by its prim path or name. Needed where there are several."
    ),
    click.option(
        "--imageWidth",
        "-w",
        "width",
        type=click.IntRange(min=1),
        metavar="PIXELS",
        help="Width of the picture; the height follows the camera. Default: the plate's, or the stage's render"
        " settings', or 960.",
    ),
    click.option(
        "--device", default="cpu", show_default=True, metavar="DEVICE", help="Where kernels run: cpu, cuda or cuda:N."
    ),
    click.option("--threads", type=click.IntRange(min=1), metavar="N", help="CPU threads. Default: all cores."),
    click.option("--real", metavar="PATH", multiple=True, help="This prim and all under it is real. May be repeated."),
    click.option(
        "--synthetic", metavar="PATH", multiple=True, help="This prim and all under it is synthetic. May be repeated."
    ),
    click.option(
        "--purposes",
        default="default,render",
        show_default=True,
        metavar="NAMES",
        callback=_split_purposes,
        help="Purposes of geometry to draw, of default, render, proxy and guide; default is always drawn.",
    ),
    click.option(
        "--complexity",
        "-c",
        type=click.Choice(COMPLEXITIES),
        default="high",
        show_default=True,
        help="How finely subdivision surfaces are drawn; low draws their control meshes.",
    ),
    click.option("--strict", is_flag=True, help="What the stage has and this tool does not model is an error."),
)


def keep_budget(
    relighter: Relighter, budget: float | None, max_error: float | None, *, has_plate: bool
) -> Choice | None:
    """Choose settings where a budget or an error was asked for.

    Raises:
        UsageError: ``--quality`` is given as well. OptionError: What was asked for cannot be had.
    """
    if budget is None and max_error is None:
        return None
    source = click.get_current_context().get_parameter_source("quality")
    if source == click.core.ParameterSource.COMMANDLINE:
        raise click.UsageError("--budget and --max-error choose what --quality would; give one of them")
    return relighter.keep_budget(budget, max_error=max_error, has_plate=has_plate)


def stage_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """The options that say how a stage is understood and rendered."""
    for option in reversed(_STAGE_OPTIONS):
        function = option(function)
    return function
