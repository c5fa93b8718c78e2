"""Small stages in memory: a camera, a light and a real cube far away, to which tests add what they are about."""

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, UsdLux, UsdShade

from warp_dvct.usd.read import read_stage


class Builder:
    """A stage in metres with y up; ``read`` reads it with what a scene needs besides the prims under test."""

    def __init__(self, stage=None, complete=True):
        self.stage = stage or Usd.Stage.CreateInMemory()
        UsdGeom.SetStageMetersPerUnit(self.stage, 1.0)
        UsdGeom.SetStageUpAxis(self.stage, "Y")
        self.stage.SetDefaultPrim(UsdGeom.Xform.Define(self.stage, "/World").GetPrim())
        if complete:
            UsdGeom.Camera.Define(self.stage, "/World/Camera")
            UsdLux.DistantLight.Define(self.stage, "/World/Light")
            room = UsdGeom.Cube.Define(self.stage, "/World/Room")
            self.tag(room, "real")

    @staticmethod
    def tag(prim, value, name="dvct:reality"):
        UsdGeom.PrimvarsAPI(prim).CreatePrimvar(name, Sdf.ValueTypeNames.Token).Set(value)

    def mesh(self, points, faces, path="/World/Mesh", scheme="none"):
        mesh = UsdGeom.Mesh.Define(self.stage, path)
        mesh.CreatePointsAttr([tuple(map(float, p)) for p in points])
        mesh.CreateFaceVertexCountsAttr([len(face) for face in faces])
        mesh.CreateFaceVertexIndicesAttr([i for face in faces for i in face])
        mesh.CreateSubdivisionSchemeAttr(scheme)
        return mesh

    def quad(self, path="/World/Mesh"):
        return self.mesh([(0, 0, 0), (2, 0, 0), (2, 1, 0), (0, 1, 0)], [[0, 1, 2, 3]], path)

    def material(self, path="/World/Looks/Mat", bind=None, **values):
        """A UsdPreviewSurface with constant inputs; returns its shader."""
        material = UsdShade.Material.Define(self.stage, path)
        shader = UsdShade.Shader.Define(self.stage, path + "/Surface")
        shader.CreateIdAttr("UsdPreviewSurface")
        kinds = {tuple: Sdf.ValueTypeNames.Color3f, int: Sdf.ValueTypeNames.Int, float: Sdf.ValueTypeNames.Float}
        for name, value in values.items():
            shader.CreateInput(name, kinds[type(value)]).Set(value)
        material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
        if bind is not None:
            UsdShade.MaterialBindingAPI.Apply(bind.GetPrim()).Bind(material)
        return shader

    def read(self, **options):
        options.setdefault("allow_empty_roles", True)
        return read_stage(self.stage, **options)

    def one(self, path="/World/Mesh", **options):
        """The mesh of that path."""
        (found,) = [m for m in self.read(**options).meshes if m.path == path]
        return found


def areas(mesh):
    """Area of each triangle of a mesh."""
    p = mesh.points[mesh.triangles]
    return 0.5 * np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)


def volume(mesh):
    """Signed volume: positive where the triangles of a closed mesh run counter-clockwise from outside."""
    p = mesh.points[mesh.triangles]
    return np.einsum("tk,tk->", p[:, 0], np.cross(p[:, 1], p[:, 2])) / 6.0


def face_normals(mesh):
    """Unit normals of the triangles."""
    p = mesh.points[mesh.triangles]
    n = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    return n / np.linalg.norm(n, axis=1, keepdims=True)


@pytest.fixture
def build():
    return Builder()


@pytest.fixture
def measure():
    """The functions ``areas``, ``volume`` and ``face_normals``."""

    class Measure:
        pass

    Measure.areas, Measure.volume, Measure.face_normals = (
        staticmethod(areas),
        staticmethod(volume),
        staticmethod(face_normals),
    )
    return Measure
