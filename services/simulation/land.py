"""Land cover of a simulated world: roads, fields, woods, villages and trees, cell by cell.

A warped lattice of roads divides the land into blocks, and repeated splitting divides a block into
rectangles. A hash of the position determines everything about a block or a rectangle. Each cell can
therefore be computed separately, and the land repeats with the lattice.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from amers.services.simulation.grid import bilinear
from amers.services.types import Array, FloatImage

NO_ROOF = np.float32(-np.inf)
"""Roof height of open ground."""

BLOCK_M = 260.0
ROAD_HALF_WIDTH_M = 3.2
TREE_LATTICE_M = 6.5

ORCHARD_ROW_M = 7.0
"""Distance of the trees of an orchard, on a square lattice."""

ESTATE_LOT_M = 24.0
"""Side of the lots of a housing estate, which all have the same house."""

FIELDS, WOOD, VILLAGE, WORKS, ORCHARD, ESTATE = 0, 1, 2, 3, 4, 5
"""Kinds of blocks."""

WATER = 65535
"""Parcel of water: its albedo changes with the date, and nothing grows on it."""

_WOODED, _BUILT_UP = 0.9, -1.1
"""Values of the regions beyond which blocks are mostly wood, and mostly built up."""
_LOT_M = np.array([95.0, 400.0, 27.0, 75.0, 400.0, ESTATE_LOT_M])
_TREES = np.array([0.012, 0.85, 0.22, 0.03, 0.0, 0.0])
_TEXTURE = np.array([0.09, 0.22, 0.16, 0.10, 0.05, 0.05])


class LandNoise(NamedTuple):
    """The noise that makes a land irregular.

    Attributes:
        warp: (2, w, w) displacement of the lattice of roads, columns and rows, cells.
        texture: (t, t) noise of unit standard deviation, repeated; the side of the world is a multiple
            of t.
        blotches: (b, b) coarse noise of unit standard deviation, stretched over the world.
        regions: (k, k) the same of blocks: high where they are mostly wood, low where mostly built up.
    """

    warp: FloatImage
    texture: FloatImage
    blotches: FloatImage
    regions: FloatImage


class LandCover(NamedTuple):
    """The cover of a land, cell by cell.

    Attributes:
        albedo: (n, n) reflectance.
        roof_m: (n, n) heights of roofs, `NO_ROOF` on open ground.
        parcel: (n, n) number of the field, 0 where there is none.
    """

    albedo: FloatImage
    roof_m: FloatImage
    parcel: npt.NDArray[np.uint16]


def cover_land(
    terrain_m: FloatImage, noise: LandNoise, posting_m: float, seed: int, patterned_share: float
) -> LandCover:
    """The land cover of a world.

    Args:
        terrain_m: (n, n) heights.
        noise: irregularities of the land.
        posting_m: size of a cell.
        seed: start of the hashes.
        patterned_share: share of the blocks that are orchards or housing estates, whose details repeat.
    """
    shape = terrain_m.shape
    cover = LandCover(
        albedo=np.empty(shape, dtype=np.float32),
        roof_m=np.full(shape, NO_ROOF, dtype=np.float32),
        parcel=np.zeros(shape, dtype=np.uint16),
    )
    _cover(terrain_m, noise, posting_m, (np.uint64(seed), patterned_share), cover)
    return cover


@njit(inline="always")
def _mix(seed: np.uint64, value: int) -> np.uint64:
    """The next hash of a chain. Source: Steele et al. (2014), SplitMix64."""
    h = seed + np.uint64(0x9E3779B97F4A7C15) * (np.uint64(value) + np.uint64(1))
    h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return h ^ (h >> np.uint64(31))


@njit(inline="always")
def _part(h: np.uint64, k: int) -> float:
    """The k-th (0 to 3) number between 0 and 1 in a hash."""
    return float((h >> np.uint64(16 * k)) & np.uint64(0xFFFF)) / 65535.0


@njit(cache=True)
def _lattice(warp: FloatImage, x: float, y: float, n: int) -> tuple[float, float]:
    """Position on the lattice of roads of a grid position, both in cells."""
    scale = warp.shape[1] / n
    return (
        x + bilinear(warp[0], x * scale, y * scale),
        y + bilinear(warp[1], x * scale, y * scale),
    )


@njit(cache=True)
def _ground_below(terrain: FloatImage, warp: FloatImage, u: float, v: float) -> float:
    """Height of the terrain at a position on the lattice of roads, metres."""
    n = len(terrain)
    x, y = u, v
    for _ in range(6):
        du, dv = _lattice(warp, x, y, n)
        x += u - du
        y += v - dv
    return bilinear(terrain, x, y)


@njit(cache=True)
def _highest_below(terrain: FloatImage, warp: FloatImage, u: float, v: float, walls: Array) -> float:
    """Highest terrain below a building, with walls in cells from the corner (u, v) of its block."""
    top = -np.inf
    for i in range(3):
        for j in range(3):
            p = walls[0] + 0.5 * i * (walls[1] - walls[0])
            q = walls[2] + 0.5 * j * (walls[3] - walls[2])
            top = max(top, _ground_below(terrain, warp, u + p, v + q))
    return top


@njit(cache=True)
def _lot(h: np.uint64, kind: int, position: tuple[float, float], side: float, box: Array) -> np.uint64:
    """Write into `box` the lot of a block at a position; returns its hash, one for a whole estate."""
    p, q = position
    if kind != ESTATE:
        return _split(h, position, side, _LOT_M[kind], box)
    box[0] = math.floor(p / ESTATE_LOT_M) * ESTATE_LOT_M
    box[2] = math.floor(q / ESTATE_LOT_M) * ESTATE_LOT_M
    box[1], box[3] = box[0] + ESTATE_LOT_M, box[2] + ESTATE_LOT_M
    if box[1] > side or box[3] > side:
        box[1] = box[0]
    return h


@njit(cache=True)
def _split(
    h: np.uint64, position: tuple[float, float], side: float, limit: float, box: Array
) -> np.uint64:
    """Write into `box` (p0, p1, q0, q1) the rectangle of a block at a position; returns its hash."""
    p, q = position
    box[0], box[1], box[2], box[3] = 0.0, side, 0.0, side
    for _ in range(12):
        width, height = box[1] - box[0], box[3] - box[2]
        if max(width, height) < limit * (0.75 + 0.6 * _part(h, 0)):
            break
        at = 0.36 + 0.28 * _part(h, 1)
        axis = 0 if width > height else 2
        cut = box[axis] + at * (box[axis + 1] - box[axis])
        if (p if axis == 0 else q) < cut:
            box[axis + 1] = cut
            h = _mix(h, 1)
        else:
            box[axis] = cut
            h = _mix(h, 2)
    return h


@njit(cache=True)
def _kind(h: np.uint64, patterned_share: float, region: float) -> int:
    """The kind of a block in a region."""
    draw = _part(_mix(h, 11), 0)
    if draw < patterned_share:
        return ORCHARD if draw < 0.5 * patterned_share else ESTATE
    draw = _part(h, 3)
    if region > _WOODED:
        return WOOD if draw < 0.85 else FIELDS
    if region < _BUILT_UP:
        return FIELDS if draw < 0.10 else VILLAGE if draw < 0.85 else WORKS
    if draw < 0.50:
        return FIELDS
    if draw < 0.64:
        return WOOD
    return VILLAGE if draw < 0.92 else WORKS


@njit(cache=True)
def _tree(h: np.uint64, p: float, q: float, chance: float, side: float) -> float:
    """Factor of the albedo by the crown or the shadow of a tree; 1 without a tree."""
    i = int(np.floor(p / TREE_LATTICE_M))
    j = int(np.floor(q / TREE_LATTICE_M))
    factor = 1.0
    for di in range(-1, 2):
        for dj in range(-1, 2):
            t = _mix(_mix(h, i + di + 100), j + dj + 100)
            if _part(t, 0) > chance:
                continue
            a = (i + di + 0.15 + 0.7 * _part(t, 1)) * TREE_LATTICE_M
            b = (j + dj + 0.15 + 0.7 * _part(t, 2)) * TREE_LATTICE_M
            radius = 1.3 + 2.4 * _part(t, 3)
            if min(a, side - a) < 6.0 or min(b, side - b) < 6.0:
                continue
            dp, dq = (p - a) / radius, (q - b) / radius
            if dp * dp + dq * dq < 1.0:
                return 0.42 + 0.22 * (dp + dq) + 0.25 * _part(t, 3)
            dp, dq = dp + 0.75, dq + 0.75
            if dp * dp + dq * dq < 1.0:
                factor = 0.45
    return factor


@njit(cache=True)
def _orchard_tree(p: float, q: float) -> float:
    """Factor of the albedo by the crowns and shadows of the trees of an orchard, which are all alike."""
    dp = p / ORCHARD_ROW_M - math.floor(p / ORCHARD_ROW_M) - 0.5
    dq = q / ORCHARD_ROW_M - math.floor(q / ORCHARD_ROW_M) - 0.5
    if dp * dp + dq * dq < 0.08:
        return 0.45
    dp, dq = dp + 0.2, dq + 0.2
    return 0.6 if dp * dp + dq * dq < 0.08 else 1.0


@njit(cache=True)
def _ground_albedo(h: np.uint64, kind: int, box: Array, p: float, q: float) -> float:
    """Albedo of open ground: crops in rows with a track or a hedge around, soil, gardens, yards."""
    edge = min(min(p - box[0], box[1] - p), min(q - box[2], box[3] - q))
    if kind == WOOD:
        return 0.13
    if kind == ORCHARD:
        return 0.22 * _orchard_tree(p, q)
    if kind != FIELDS:
        return 0.08 if edge < 0.7 else 0.12 + 0.16 * _part(h, 1)
    if edge < 1.3:
        return 0.30 if _part(h, 0) < 0.4 else 0.10
    tone = 0.11 + 0.23 * _part(h, 2) ** 1.3
    rows = 0.10 * _part(h, 1)
    across = p if box[1] - box[0] < box[3] - box[2] else q
    period = 3.5 + 5.0 * _part(h, 3)
    return float(tone * (1.0 + rows * np.sin(2.0 * np.pi * across / period)))


@njit(cache=True)
def _building(h: np.uint64, kind: int, box: Array, walls: Array) -> float:
    """Write into `walls` the building of a lot (p0, p1, q0, q1); returns its height, 0 for none."""
    if kind in (WOOD, FIELDS, ORCHARD) or box[1] <= box[0]:
        return 0.0
    if kind != ESTATE and _part(h, 2) < 0.16:
        return 0.0
    b = _mix(h, 7)
    for axis in range(2):
        size = box[2 * axis + 1] - box[2 * axis]
        share = 0.38 + 0.27 * _part(b, axis)
        if kind == WORKS:
            share += 0.18
        start = box[2 * axis] + (1.0 - share) * size * (0.3 + 0.4 * _part(b, axis + 2))
        walls[2 * axis] = start
        walls[2 * axis + 1] = start + share * size
    if kind == WORKS:
        return 6.0 + 6.0 * _part(h, 3)
    return 4.0 + 5.0 * _part(h, 3) + (9.0 if _part(h, 0) < 0.12 else 0.0)


@njit(cache=True)
def _roof_albedo(h: np.uint64, kind: int, walls: Array, p: float, q: float) -> float:
    """Albedo of a roof: tiles in two tones on both sides of a ridge, or flat with bands and a rim."""
    width, depth = walls[1] - walls[0], walls[3] - walls[2]
    edge = min(min(p - walls[0], walls[1] - p), min(q - walls[2], walls[3] - q))
    tone = 0.17 + 0.22 * _part(h, 1)
    if kind == WORKS:
        tone = 0.26 + 0.32 * _part(h, 1)
        along = (p if width > depth else q) / 6.0
        band = 0.86 if along - np.floor(along) < 0.16 else 1.0
        return tone * (0.65 if edge < 0.8 else band)
    if width > depth:
        side = 1.0 if q > walls[2] + depth * 0.5 else 0.0
    else:
        side = 1.0 if p > walls[0] + width * 0.5 else 0.0
    if kind == ESTATE:
        return tone * (0.78 + 0.5 * side)
    chimney = edge > 1.5 and _part(_mix(h, int(p / 1.6) * 64 + int(q / 1.6)), 0) < 0.05
    return (0.55 if chimney else 1.0) * tone * (0.78 + 0.5 * side)


@njit(cache=True)
def _cover(
    terrain: FloatImage,
    noise: LandNoise,
    posting: float,
    seed_and_patterned_share: tuple[np.uint64, float],
    cover: LandCover,
) -> None:
    """Fill the land cover of all cells."""
    warp, texture, blotches, regions = noise
    seed, patterned_share = seed_and_patterned_share
    albedo, roof, parcel = cover
    n = len(terrain)
    blocks = max(2, int(np.round(n * posting / BLOCK_M)))
    cells = n / blocks
    side = cells * posting
    tile = len(texture)
    coarse = len(blotches) / n
    box = np.empty(4)
    walls = np.empty(4)
    last_house = np.uint64(0)
    last_roof = 0.0
    for r in range(n):
        for c in range(n):
            u, v = _lattice(warp, float(c), float(r), n)
            bu, bv = int(np.floor(u / cells)), int(np.floor(v / cells))
            p, q = (u - bu * cells) * posting, (v - bv * cells) * posting
            block = _mix(_mix(seed, bu % blocks), bv % blocks)
            region = regions[bv % blocks * len(regions) // blocks, bu % blocks * len(regions) // blocks]
            kind = _kind(block, patterned_share, region)
            grain = texture[r % tile, c % tile]
            blotch = 1.0 + 0.12 * bilinear(blotches, c * coarse, r * coarse)
            edge = min(min(p, side - p), min(q, side - q))
            if edge < ROAD_HALF_WIDTH_M:
                mark = 1.5 if edge < 0.25 else 1.0
                albedo[r, c] = 0.20 * mark * (1.0 + 0.05 * grain)
                continue
            if edge < ROAD_HALF_WIDTH_M + 1.5:
                albedo[r, c] = 0.15 * blotch * (1.0 + 0.15 * grain)
                continue
            h = _lot(block, kind, (p, q), side, box)
            height = _building(h, kind, box, walls)
            if height > 0.0 and walls[0] <= p <= walls[1] and walls[2] <= q <= walls[3]:
                house = _mix(_mix(h, int(walls[0])), int(walls[2]))
                if house != last_house:
                    origin_u, origin_v = bu * cells, bv * cells
                    last_house = house
                    last_roof = height + _highest_below(
                        terrain, warp, origin_u, origin_v, walls / posting
                    )
                roof[r, c] = last_roof
                albedo[r, c] = _roof_albedo(h, kind, walls, p, q) * (1.0 + 0.05 * grain)
                continue
            ground = _ground_albedo(h, kind, box, p, q)
            if kind == FIELDS:
                parcel[r, c] = 1 + int(h % np.uint64(65535))
            tree = _tree(block, p, q, _TREES[kind], side)
            value = ground * tree * blotch * (1.0 + _TEXTURE[kind] * grain)
            albedo[r, c] = min(max(value, 0.02), 0.8)
