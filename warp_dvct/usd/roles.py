"""Which prims are real, which synthetic, and whether a light is in the plate already."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from warp_dvct.errors import StageError
from warp_dvct.scene import LightRole, Role
from warp_dvct.usd.context import Context
from warp_dvct.usd.stage import name_of

if TYPE_CHECKING:
    from pxr import Sdf, Usd

IGNORE = "ignore"
ALIASES = ("primvars:isMatteObject", "primvars:karma:object:holdoutmode", "primvars:arnold:matte")
HOW_TO_TAG = (
    'author primvars:dvct:reality = "{role}" on a prim (its children inherit it), or pass --{role} PRIM_PATH;'
    " the matte collection of a UsdRenderPass and a collection dvct:real on the default prim also mark real prims"
)

DEPTH_FILE = "dvct:depth:file"  # of a depth camera: its stage is a capture
FROM_CAPTURE = (
    "the stage is a capture: give it as --real-from too, which takes the real scene from its depth images, or make a"
    " mesh of them by `warp-dvct reconstruct`"
)


@dataclass(frozen=True)
class Tags:
    """What was authored on a prim or inherited from the prims above it; None where nothing was."""

    reality: str | None = None
    holdout: bool | None = None
    light_role: str | None = None

    def below(self, prim: Usd.Prim, ctx: Context) -> Tags:
        """The tags that hold on ``prim``, a child of the prim with these tags."""
        reality = _token(prim, "primvars:dvct:reality", ("real", "synthetic", IGNORE), ctx)
        light = _token(prim, "primvars:dvct:lightRole", ("plate", "added"), ctx)
        holdout = _holdout(prim, ctx)
        if reality is None and light is None and holdout is None:
            return self
        return Tags(
            self.reality if reality is None else reality,
            self.holdout if holdout is None else holdout,
            self.light_role if light is None else light,
        )


def _token(prim: Usd.Prim, name: str, allowed: Sequence[str], ctx: Context) -> str | None:
    attribute = prim.GetAttribute(name)
    value = attribute.Get(ctx.time) if attribute else None
    if value is None:
        return None
    if isinstance(value, str) and value in allowed:
        return str(value)
    raise StageError(f"{prim.GetPath()}: {name} is {value!r}; it must be one of {', '.join(allowed)}")


def _holdout(prim: Usd.Prim, ctx: Context) -> bool | None:
    """The switch of Houdini, Karma or Arnold; Karma writes an int, 0 for off, or its name."""
    for name in ALIASES:
        attribute = prim.GetAttribute(name)
        value = attribute.Get(ctx.time) if attribute else None
        if value is not None:
            return _is_on(value)
    return None


def _is_on(value: Any) -> bool:
    if isinstance(value, str):
        return value.lower() not in ("", "0", "off", "none", "false")
    try:
        return any(bool(v) for v in value)
    except TypeError:
        return bool(value)


class Roles:
    """Decides roles: command line, then primvars:dvct:reality, a render pass's matte collection, the collection
    dvct:real of the default prim, the switches of other renderers, and synthetic where nothing is said.

    Args:
        ctx: The reading.
        real, synthetic: Prim paths from the command line; each holds for what is below it, the deeper path wins.
        render_pass: UsdRenderPass whose matte collection counts; None for the only one that authors it.
    Raises:
        StageError: A path does not exist, is given with both roles, or the pass is not to be found.
    """

    def __init__(
        self, ctx: Context, real: Sequence[str] = (), synthetic: Sequence[str] = (), render_pass: str | None = None
    ) -> None:
        self._forced: dict[Sdf.Path, Role] = {}
        self._force(ctx, real, Role.REAL)
        self._force(ctx, synthetic, Role.SYNTHETIC)
        self._matte = _matte_query(ctx, render_pass)
        self._collection = _real_query(ctx)

    def _force(self, ctx: Context, paths: Sequence[str], role: Role) -> None:
        from pxr import Sdf

        flag = role.name.lower()
        for text in paths:
            if not Sdf.Path.IsValidPathString(text) or not Sdf.Path(text).IsAbsolutePath():
                raise StageError(f"--{flag} {text!r} is not an absolute prim path such as /World/Room")
            path = Sdf.Path(text)
            if not ctx.stage.GetPrimAtPath(path):
                raise StageError(f"--{flag} {text}: there is no such prim in {name_of(ctx.stage)}")
            if self._forced.get(path, role) != role:
                raise StageError(f"{text} is given with --real and with --synthetic; keep one")
            self._forced[path] = role

    def of(self, paths: Sequence[Sdf.Path], tags: Tags) -> Role | None:
        """The role of geometry, or None for "ignore".

        Args:
            paths: The prim's path, then the paths of the point instancers that it is an instance of, inner first.
            tags: The prim's.
        """
        for path in paths:
            for prefix in reversed(path.GetPrefixes()):
                if prefix in self._forced:
                    return self._forced[prefix]
        if tags.reality is not None:
            return {"real": Role.REAL, "synthetic": Role.SYNTHETIC, IGNORE: None}[tags.reality]
        if _includes(self._matte, paths) or _includes(self._collection, paths) or tags.holdout:
            return Role.REAL
        return Role.SYNTHETIC


def light_role(tags: Tags) -> LightRole:
    """A light is in the plate already unless it is tagged as added."""
    return LightRole.ADDED if tags.light_role == "added" else LightRole.PLATE


def _includes(query: Any, paths: Iterable[Sdf.Path]) -> bool:
    return query is not None and any(query.IsPathIncluded(path) for path in paths)


def _matte_query(ctx: Context, render_pass: str | None) -> Any:
    from pxr import Usd, UsdRender

    if render_pass is not None:
        prim = ctx.stage.GetPrimAtPath(render_pass)
        if not prim or not prim.IsA(UsdRender.Pass):
            raise StageError(f"{render_pass} is not a RenderPass in {name_of(ctx.stage)}")
        return Usd.CollectionAPI(prim, "matte").ComputeMembershipQuery()
    passes = [p for p in ctx.stage.Traverse() if p.IsA(UsdRender.Pass) and _has_members(p, "matte")]
    if not passes:
        return None
    for other in passes[1:]:
        ctx.notices.add(other.GetPath(), f"a second RenderPass with a matte collection; {passes[0].GetPath()} is used")
    return Usd.CollectionAPI(passes[0], "matte").ComputeMembershipQuery()


def _has_members(prim: Usd.Prim, name: str) -> bool:
    from pxr import Usd

    collection = Usd.CollectionAPI(prim, name)
    expression = collection.GetMembershipExpressionAttr()
    return bool(
        collection.GetIncludesRel().HasAuthoredTargets()
        or collection.GetIncludeRootAttr().Get()
        or (expression and expression.HasAuthoredValue())
    )


def _real_query(ctx: Context) -> Any:
    from pxr import Usd

    prim = ctx.stage.GetDefaultPrim()
    if not prim or not prim.HasAPI(Usd.CollectionAPI, "dvct:real"):
        return None
    return Usd.CollectionAPI(prim, "dvct:real").ComputeMembershipQuery()


def require_roles(stage: Usd.Stage, defined: set[Role]) -> None:
    """Refuse a stage that defines nothing real or nothing synthetic.

    Raises:
        StageError: It says how to tag.
    """
    for role in (Role.REAL, Role.SYNTHETIC):
        if role not in defined:
            word = role.name.lower()
            live = role == Role.REAL and any(p.GetAttribute(DEPTH_FILE) for p in stage.Traverse())
            how = FROM_CAPTURE if live else HOW_TO_TAG.format(role=word)
            raise StageError(f"{name_of(stage)}: no geometry is {word}; {how}")
