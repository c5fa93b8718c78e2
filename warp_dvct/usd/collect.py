"""Walk a stage once: what is to be drawn, where it stands, in which role."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_dvct.errors import StageError
from warp_dvct.scene import LightRole, Role
from warp_dvct.usd.context import Context, matrix
from warp_dvct.usd.roles import Roles, Tags, light_role

if TYPE_CHECKING:
    from pxr import Sdf, Usd

MAX_NESTING = 8  # point instancers inside each other; deeper is a loop


@dataclass(frozen=True)
class Placed:
    """A prim and the places in which it is drawn.

    Attributes:
        prim: Mesh, points, gprim or light; a proxy inside native instances.
        matrices: ``[n, 4, 4]`` float64 for row vectors, from the prim's space to the world in metres.
        path: Shown to the user.
        role: Of geometry.
        light_role: Of a light.
    """

    prim: Usd.Prim
    matrices: np.ndarray
    path: str
    role: Role = Role.SYNTHETIC
    light_role: LightRole = LightRole.PLATE


@dataclass
class Collection:
    """What a walk found; ``defined`` and ``lights_defined`` count invisible prims too."""

    geometry: list[Placed] = field(default_factory=list)
    lights: list[Placed] = field(default_factory=list)
    defined: set[Role] = field(default_factory=set)
    lights_defined: int = 0


@dataclass(frozen=True)
class _State:
    """What a prim hands down to its children."""

    matrices: np.ndarray
    visible: bool
    purpose: Any
    tags: Tags
    instancers: tuple[Sdf.Path, ...] = ()
    label: str = ""  # how paths below a prototype's root are shown
    root: Sdf.Path | None = None


class Collector:
    """Walks prims that are active, defined, loaded and not abstract, through native and point instances.

    Args:
        ctx: The reading.
        roles: Decides real and synthetic.
        purposes: UsdGeom purposes that are drawn.
    """

    def __init__(self, ctx: Context, roles: Roles, purposes: tuple[str, ...]) -> None:
        from pxr import Usd

        self._ctx = ctx
        self._roles = roles
        self._purposes = purposes
        self._predicate = Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)
        # Prototypes of a point instancer are often overs or classes, so that they are not drawn by themselves.
        self._inside_prototype = Usd.TraverseInstanceProxies(Usd.PrimIsActive & Usd.PrimIsLoaded)
        self.found = Collection()

    def collect(self) -> Collection:
        """Walk the whole stage.

        Raises:
            StageError: A tag or a point instancer is wrong.
        """
        state = _State(self._ctx.to_world[None], True, None, Tags())
        for prim in self._ctx.stage.GetPseudoRoot().GetFilteredChildren(self._predicate):
            self._walk(prim, state, self._predicate)
        return self.found

    def _walk(self, top: Usd.Prim, state: _State, predicate: Any, placed: bool = False) -> None:
        """Visit ``top`` and all below it; ``placed`` says that its own transform is in ``state`` already."""
        from pxr import UsdGeom, UsdShade

        stack = [(top, state, placed)]
        while stack:
            prim, above, done = stack.pop()
            if prim.IsA(UsdShade.Material):
                continue
            here = self._enter(prim, above, done)
            if prim.IsA(UsdGeom.PointInstancer):
                self._expand(UsdGeom.PointInstancer(prim), here)
                continue
            self._visit(prim, here)
            stack += [(child, here, False) for child in reversed(prim.GetFilteredChildren(predicate))]

    def _enter(self, prim: Usd.Prim, above: _State, placed: bool) -> _State:
        """The state at ``prim``: transform, visibility, purpose and tags."""
        from pxr import UsdGeom

        time = self._ctx.time
        changes: dict[str, Any] = {}
        if not placed and prim.IsA(UsdGeom.Xformable):
            xformable = UsdGeom.Xformable(prim)
            local = matrix(xformable.GetLocalTransformation(time))
            if not np.isfinite(local).all():
                raise StageError(f"{prim.GetPath()}: its transform has NaN or infinite values; repair its xformOps")
            self._note_missing_ops(xformable)
            if xformable.GetResetXformStack():
                changes["matrices"] = (local @ self._ctx.to_world)[None]
            elif not np.array_equal(local, np.eye(4)):
                changes["matrices"] = local @ above.matrices
        if prim.IsA(UsdGeom.Imageable):
            imageable = UsdGeom.Imageable(prim)
            if imageable.GetVisibilityAttr().Get(time) == UsdGeom.Tokens.invisible:
                changes["visible"] = False
            parent = above.purpose
            changes["purpose"] = (
                imageable.ComputePurposeInfo() if parent is None else imageable.ComputePurposeInfo(parent)
            )
        tags = above.tags.below(prim, self._ctx)
        if tags is not above.tags:
            changes["tags"] = tags
        return replace(above, **changes) if changes else above

    def _note_missing_ops(self, xformable: Any) -> None:
        """List operations that the prim orders and does not have: USD leaves them out without a word."""
        prim = xformable.GetPrim()
        for name in xformable.GetXformOpOrderAttr().Get(self._ctx.time) or ():
            attribute = name.removeprefix("!invert!")
            if not attribute.startswith("!") and not prim.HasAttribute(attribute):
                self._ctx.notices.add(prim.GetPath(), f"xformOpOrder names {attribute}, which is not there; left out")

    def _visit(self, prim: Usd.Prim, state: _State) -> None:
        from pxr import UsdGeom, UsdLux

        drawn = state.purpose is None or str(state.purpose.purpose) in self._purposes
        if not drawn:
            return
        path = self._shown(prim.GetPath(), state)
        is_mesh = prim.IsA(UsdGeom.Gprim)
        if prim.HasAPI(UsdLux.LightAPI):
            if is_mesh:
                self._ctx.notices.add(path, "a mesh light: its emission is not modelled, its surface is drawn")
            elif not prim.IsA(UsdLux.LightFilter):
                self._add_light(prim, path, state)
        if is_mesh:
            self._add_geometry(prim, path, state)
        elif prim.IsA(UsdGeom.Boundable) and not prim.IsA(UsdLux.BoundableLightBase) and _is_surface(prim):
            self._ctx.notices.add(path, f"a {prim.GetTypeName()} is not supported and not drawn")

    @staticmethod
    def _shown(path: Sdf.Path, state: _State) -> str:
        """A path as the user is told it: below an instancer rather than below its prototype."""
        return str(path) if state.root is None else state.label + str(path)[len(str(state.root)) :]

    def _add_light(self, prim: Usd.Prim, path: str, state: _State) -> None:
        if state.tags.reality == "ignore":
            return
        self.found.lights_defined += 1
        if state.visible:
            self.found.lights.append(Placed(prim, state.matrices, path, light_role=light_role(state.tags)))

    def _add_geometry(self, prim: Usd.Prim, path: str, state: _State) -> None:
        role = self._roles.of((prim.GetPath(), *state.instancers), state.tags)
        if role is None:
            return
        if str(prim.GetTypeName()) not in DRAWN:
            self._ctx.notices.add(path, f"a {prim.GetTypeName()} is not supported and not drawn")
            return
        self.found.defined.add(role)
        if not state.visible:
            return
        note_skinning(prim, path, self._ctx)
        solid = np.abs(np.linalg.det(state.matrices[:, :3, :3])) > 0.0
        if not solid.all():
            self._ctx.notices.add(path, "scaled to zero along an axis; not drawn")
        if solid.any():
            self.found.geometry.append(Placed(prim, state.matrices[solid], path, role))

    def _expand(self, instancer: Any, state: _State) -> None:
        """Walk each prototype once, with the transforms of all its instances."""
        from pxr import UsdGeom

        path, time = instancer.GetPath(), self._ctx.time
        if len(state.instancers) >= MAX_NESTING:
            raise StageError(
                f"{path}: point instancers are nested more than {MAX_NESTING} deep; is it its own prototype?"
            )
        targets = instancer.GetPrototypesRel().GetForwardedTargets()
        index = np.array(instancer.GetProtoIndicesAttr().Get(time) or (), dtype=np.int64)
        if len(index) and (index.min() < 0 or index.max() >= len(targets)):
            raise StageError(f"{path}: protoIndices go up to {index.max()}, but it has {len(targets)} prototypes")
        xforms = np.array(
            instancer.ComputeInstanceTransformsAtTime(
                time, time, UsdGeom.PointInstancer.IncludeProtoXform, UsdGeom.PointInstancer.IgnoreMask
            ),
            dtype=np.float64,
        ).reshape(-1, 4, 4)
        if len(xforms) != len(index):
            raise StageError(
                f"{path}: {len(index)} protoIndices, but positions, orientations or scales differ in number"
            )
        if not np.isfinite(xforms).all():
            raise StageError(f"{path}: NaN or infinite values in its positions, orientations or scales")
        mask = np.array(instancer.ComputeMaskAtTime(time), dtype=bool)
        shown = mask if len(mask) else np.ones(len(index), bool)
        color = UsdGeom.PrimvarsAPI(instancer).GetPrimvar("displayColor")
        if color.HasAuthoredValue() and color.GetInterpolation() != UsdGeom.Tokens.constant:
            self._ctx.notices.add(path, "displayColor per instance is not supported; the prototypes' own is used")
        for k, target in enumerate(targets):
            prim = self._ctx.stage.GetPrimAtPath(target)
            if not prim:
                raise StageError(f"{path}: its prototype {target} does not exist")
            chosen = xforms[shown & (index == k)]
            below = replace(
                state,
                matrices=(chosen[None] @ state.matrices[:, None]).reshape(-1, 4, 4),
                visible=state.visible and len(chosen) > 0,
                instancers=(path, *state.instancers),
                label=f"{self._shown(path, state)}/{prim.GetName()}",
                root=target,
            )
            if len(below.matrices) == 0:
                below = replace(below, matrices=state.matrices[:1])  # invisible: only its role is of interest
            self._walk(prim, below, self._inside_prototype, placed=True)


DRAWN = ("Mesh", "Points", "Cube", "Sphere", "Cylinder", "Cylinder_1", "Cone", "Capsule", "Capsule_1", "Plane")


def _is_surface(prim: Usd.Prim) -> bool:
    """Whether a boundable prim would be seen in a renderer (a camera, a skeleton or a portal would not)."""
    return str(prim.GetTypeName()) in ("Volume", "TetMesh", "ParticleField", "ParticleField3DGaussianSplat")


def note_skinning(prim: Usd.Prim, path: str, ctx: Context) -> None:
    """List a mesh that a skeleton or blend shapes would deform."""
    from pxr import UsdSkel

    if not prim.HasAPI(UsdSkel.BindingAPI):
        return
    binding = UsdSkel.BindingAPI(prim)
    if binding.GetInheritedSkeleton() or binding.GetBlendShapeTargetsRel().HasAuthoredTargets():
        ctx.notices.add(path, "UsdSkel deformation is not applied; drawn in its rest pose")
