"""The sparse volume: a pyramid of brick maps whose voxels hold six directional faces.

A level of ``n`` voxels an edge is a table of bricks of 8^3 cells; a cell holds the index of a *record* or -1, so memory
follows occupied voxels. A record has six faces, one per outward axis direction (+x, -x, +y, -y, +z, -z). A face holds
two solutions, before (real surfaces) and after (all surfaces), each as (radiosity * alpha, alpha), where alpha is the
front-facing area projected onto the face over the face's area, clamped to 1. All records' faces of one direction lie
together: most surfaces show on one, and those of neighbours then share what a cache fetches.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BRICK = wp.constant(8)
BRICK_CELLS = wp.constant(512)
BEFORE = wp.constant(0)
AFTER = wp.constant(1)


@wp.struct
class Volume:
    low: wp.vec3  # corner of the box, in volume space
    voxel: wp.float32  # edge of a level-0 voxel
    n: wp.int32  # level-0 voxels an edge
    levels: wp.int32
    records: wp.int32  # of all levels
    table_start: wp.array(dtype=wp.int32)  # [levels], where a level's brick table begins
    tables: wp.array(dtype=wp.int32)  # brick index or -1
    cells: wp.array(dtype=wp.int32)  # [bricks * 512], record index or -1
    field: wp.array(dtype=wp.vec4)  # [6 * records * 2], ``field_slot`` + solution


@wp.func
def level_extent(n: int, level: int) -> int:
    """Voxels an edge at a level; odd sizes round up."""
    return ((n - 1) >> level) + 1


@wp.func
def brick_extent(n: int, level: int) -> int:
    return (level_extent(n, level) + BRICK - 1) / BRICK


@wp.func
def cell_key(x: int, y: int, z: int, bricks: int) -> int:
    """Sort key of a voxel: its brick's linear index, then its cell in the brick. Fits 30 bits up to 1024^3."""
    brick = ((z / BRICK) * bricks + y / BRICK) * bricks + x / BRICK
    return brick * BRICK_CELLS + ((z & 7) * BRICK + (y & 7)) * BRICK + (x & 7)


@wp.func
def key_cell(key: int, bricks: int) -> wp.vec3i:
    """Inverse of ``cell_key``."""
    brick = key / BRICK_CELLS
    cell = key & 511
    bx = brick % bricks
    by = (brick / bricks) % bricks
    bz = brick / (bricks * bricks)
    return wp.vec3i(bx * BRICK + (cell & 7), by * BRICK + ((cell >> 3) & 7), bz * BRICK + (cell >> 6))


@wp.func
def find_record(volume: Volume, level: int, x: int, y: int, z: int) -> int:
    """Record of a voxel, or -1 where it is empty or outside of the box."""
    extent = level_extent(volume.n, level)
    if x < 0 or y < 0 or z < 0 or x >= extent or y >= extent or z >= extent:
        return -1
    bricks = (extent + BRICK - 1) / BRICK
    brick = volume.tables[volume.table_start[level] + ((z / BRICK) * bricks + y / BRICK) * bricks + x / BRICK]
    if brick < 0:
        return -1
    return volume.cells[brick * BRICK_CELLS + ((z & 7) * BRICK + (y & 7)) * BRICK + (x & 7)]


@wp.func
def face_of(axis: int, direction: float) -> int:
    """Face whose outward normal is along ``axis`` with the sign of ``direction``."""
    return wp.where(direction >= 0.0, 2 * axis, 2 * axis + 1)


@wp.func
def field_slot(volume: Volume, record: int, face: int) -> int:
    """Where the two solutions of a record's face are in the field."""
    return 2 * (face * volume.records + record)


@wp.func
def face_weight(normal: wp.vec3, face: int) -> float:
    """How much a surface of that normal shows on a face: max(0, n . e)."""
    along = normal[face / 2]
    return wp.max(0.0, wp.where((face & 1) == 0, along, -along))


@wp.struct
class Between:
    """Where a point is between the middles of eight voxels: the lowest of them, and the way from it to the next along
    each axis, 0 to 1."""

    voxel: wp.vec3i
    way: wp.vec3


@wp.func
def between_voxels(volume: Volume, level: int, position: wp.vec3) -> Between:
    local = (position - volume.low) / (volume.voxel * float(1 << level)) - wp.vec3(0.5, 0.5, 0.5)
    at = Between()
    at.voxel = wp.vec3i(int(wp.floor(local[0])), int(wp.floor(local[1])), int(wp.floor(local[2])))
    at.way = local - wp.vec3(float(at.voxel[0]), float(at.voxel[1]), float(at.voxel[2]))
    return at


@wp.func
def corner_step(corner: int) -> wp.vec3i:
    """From the lowest of eight voxels to number ``corner``."""
    return wp.vec3i(corner & 1, (corner >> 1) & 1, corner >> 2)


@wp.func
def corner_weight(at: Between, step: wp.vec3i) -> float:
    """Trilinear weight of the voxel that is ``step`` from the lowest."""
    return (
        wp.where(step[0] == 1, at.way[0], 1.0 - at.way[0])
        * wp.where(step[1] == 1, at.way[1], 1.0 - at.way[1])
        * wp.where(step[2] == 1, at.way[2], 1.0 - at.way[2])
    )
