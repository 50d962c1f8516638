"""Lines of sight in a simulated world: their first intersection with the surface, and its light."""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from amers.services.simulation.grid import bilinear
from amers.services.simulation.land import NO_ROOF
from amers.services.types import Array, BoolArray, FloatImage

GROUND, ROOF, WALL_EAST_WEST, WALL_NORTH_SOUTH = 0, 1, 2, 3
"""Kinds of surface; a wall has the name of the directions that it may face."""

WALL_ALBEDO = 0.22
_GROUND_TOLERANCE_M = 1e-5
_GROUND_STEPS = 60


class Ray(NamedTuple):
    """A line of sight, at height h in column `x0 + h by_h_x` and row `y0 + h by_h_y` of the grid."""

    x0: float
    y0: float
    by_h_x: float
    by_h_y: float


class RayNodes(NamedTuple):
    """Lines of sight of some image lines at every `spacing`-th sample, at two heights.

    Attributes:
        low, high: (3, lines, nodes, 2) columns and rows at both heights; the first axis is a quarter
            line before, at and after the line.
        low_m, high_m: the heights.
    """

    low: Array
    high: Array
    low_m: float
    high_m: float


class LitSurface(NamedTuple):
    """The arrays of a world and its light, for the kernel.

    Attributes:
        terrain, roof: heights of the world.
        light: light of its cells, averaged over pixels.
        near: whether buildings may be met, for each square of 16 x 16 cells.
        walls: (4,) light of walls that face west, east, north, south.
    """

    terrain: FloatImage
    roof: FloatImage
    light: FloatImage
    near: BoolArray
    walls: Array


@njit(cache=True)
def intersect_ground(terrain: FloatImage, ray: Ray, h: float) -> float:
    """Height of the intersection of a line of sight with the terrain, searched from height h.

    The fixed-point iteration converges while the slope of the ground times the tangent of the incidence
    is below one; the intersection is then unique.
    """
    x0, y0, by_h_x, by_h_y = ray
    for _ in range(_GROUND_STEPS):
        height = bilinear(terrain, x0 + h * by_h_x, y0 + h * by_h_y)
        change = height - h
        h = height
        if abs(change) < _GROUND_TOLERANCE_M:
            break
    return h


@njit(cache=True)
def intersect_building(roof: FloatImage, ray: Ray, ground: float, top: float) -> tuple[int, float]:
    """First intersection of a line of sight between the height `top` and the ground.

    Source: Amanatides and Woo (1987), traversal of the cells of a grid along a line.

    Returns:
        Kind of the surface, and height of the intersection.
    """
    x0, y0, by_h_x, by_h_y = ray
    if not top > ground:
        return GROUND, ground
    rows, columns = roof.shape
    x, y = x0 + top * by_h_x + 0.5, y0 + top * by_h_y + 0.5
    column, row = math.floor(x), math.floor(y)
    move_x, move_y = (-1 if by_h_x > 0.0 else 1), (-1 if by_h_y > 0.0 else 1)
    per_x = 1.0 / abs(by_h_x) if by_h_x != 0.0 else np.inf
    per_y = 1.0 / abs(by_h_y) if by_h_y != 0.0 else np.inf
    next_x = ((x - column) if move_x < 0 else (column + 1 - x)) * per_x if by_h_x != 0.0 else np.inf
    next_y = ((y - row) if move_y < 0 else (row + 1 - y)) * per_y if by_h_y != 0.0 else np.inf
    depth, deepest = 0.0, top - ground
    face = ROOF
    while True:
        leave = min(min(next_x, next_y), deepest)
        height = roof[row % rows, column % columns]
        if height > NO_ROOF:
            if top - depth <= height and face != ROOF:
                return face, top - depth
            if top - leave <= height:
                return ROOF, float(height)
        if leave >= deepest:
            return GROUND, ground
        depth = leave
        if next_x < next_y:
            column += move_x
            next_x += per_x
            face = WALL_EAST_WEST
        else:
            row += move_y
            next_y += per_y
            face = WALL_NORTH_SOUTH


@njit(cache=True)
def _cubic_weights(f: float) -> tuple[float, float, float, float]:
    """Catmull-Rom weights of the four nodes around a fraction. Source: Keys (1981), a = -1/2."""
    return (
        f * (-0.5 + f * (1.0 - 0.5 * f)),
        1.0 + f * f * (-2.5 + 1.5 * f),
        f * (0.5 + f * (2.0 - 1.5 * f)),
        f * f * (-0.5 + 0.5 * f),
    )


@njit(cache=True)
def _open_ground_light(light: FloatImage, x: float, y: float) -> float:
    """Bicubic light of open ground far from buildings."""
    rows, columns = light.shape
    x0, y0 = math.floor(x), math.floor(y)
    wx = _cubic_weights(x - x0)
    wy = _cubic_weights(y - y0)
    x0 = (x0 - 1) % columns
    y0 = (y0 - 1) % rows
    total = 0.0
    if x0 + 3 < columns and y0 + 3 < rows:
        for j in range(4):
            total += wy[j] * (
                wx[0] * light[y0 + j, x0]
                + wx[1] * light[y0 + j, x0 + 1]
                + wx[2] * light[y0 + j, x0 + 2]
                + wx[3] * light[y0 + j, x0 + 3]
            )
    else:
        for j in range(4):
            for i in range(4):
                total += wy[j] * wx[i] * light[(y0 + j) % rows, (x0 + i) % columns]
    return total


@njit(cache=True)
def _light_beside_buildings(
    light: FloatImage, roof: FloatImage, x: float, y: float, on_roof: bool
) -> float:
    """Light of a roof, or of the ground beside one, bilinear over the cells of the same kind."""
    rows, columns = light.shape
    x0, y0 = math.floor(x), math.floor(y)
    fx, fy = x - x0, y - y0
    total = 0.0
    weight = 0.0
    for j in range(2):
        for i in range(2):
            r, c = (y0 + j) % rows, (x0 + i) % columns
            if (roof[r, c] > NO_ROOF) == on_roof:
                w = (fx if i else 1.0 - fx) * (fy if j else 1.0 - fy) + 1e-9
                total += w * light[r, c]
                weight += w
    return total / weight if weight > 0.0 else light[y0 % rows, x0 % columns]


@njit(cache=True)
def intersect_surface(
    terrain: FloatImage, roof: FloatImage, low: Array, high: Array, heights_m: tuple[float, float]
) -> tuple[Array, npt.NDArray[np.int64]]:
    """Heights (n,) of the first intersections of lines of sight with the surface, and its kinds (n,).

    Args:
        terrain, roof: heights of the world.
        low, high: (n, 2) column and row of each line at two heights; NaN gives a height of NaN.
        heights_m: the two heights; nothing of the world is above the second.
    """
    h_low, h_high = heights_m
    height = np.empty(len(low))
    kind = np.empty(len(low), dtype=np.int64)
    for i in range(len(low)):
        gx = (high[i, 0] - low[i, 0]) / (h_high - h_low)
        gy = (high[i, 1] - low[i, 1]) / (h_high - h_low)
        ray = Ray(low[i, 0] - h_low * gx, low[i, 1] - h_low * gy, gx, gy)
        ground = intersect_ground(terrain, ray, h_low)
        kind[i], height[i] = intersect_building(roof, ray, ground, h_high)
    return height, kind


@njit(cache=True)
def _ray_between(low: Array, high: Array, at: float, h_low: float, per_h: float) -> Ray:
    """The line of sight at a fraction of the nodes (n, 2) of a line, low and high; `per_h` per metre."""
    node = int(at)
    f = at - node
    xl = low[node, 0] + f * (low[node + 1, 0] - low[node, 0])
    yl = low[node, 1] + f * (low[node + 1, 1] - low[node, 1])
    gx = (high[node, 0] + f * (high[node + 1, 0] - high[node, 0]) - xl) * per_h
    gy = (high[node, 1] + f * (high[node + 1, 1] - high[node, 1]) - yl) * per_h
    return Ray(xl - h_low * gx, yl - h_low * gy, gx, gy)


@njit(cache=True)
def render_lines(
    surface: LitSurface, nodes: RayNodes, spacing: int, clearance: float, out: FloatImage
) -> None:
    """Fill the pixels of some lines with the light on their lines of sight: one, or four near buildings.

    Args:
        surface: the world and its light.
        nodes: lines of sight at every `spacing`-th sample, from sample -0.5 on.
        spacing: samples between nodes.
        clearance: greatest height above the terrain at which a building may be met, metres.
        out: (lines, samples) pixels.
    """
    terrain, roof, light, near, walls = surface
    nodes_low, nodes_high, h_low, h_high = nodes
    lines, samples = out.shape
    rows, columns = terrain.shape
    per_h = 1.0 / (h_high - h_low)
    for r in range(lines):
        h = 0.5 * (h_low + h_high)
        for s in range(samples):
            total = 0.0
            rays = 1
            k = 0
            while k < rays:
                version, at = 1, s + 0.5
                if rays == 4:
                    version, at = 2 * (k // 2), s + 0.25 + 0.5 * (k % 2)
                ray = _ray_between(
                    nodes_low[version, r], nodes_high[version, r], at / spacing, h_low, per_h
                )
                x0, y0, gx, gy = ray
                h = intersect_ground(terrain, ray, h)
                x, y = x0 + h * gx, y0 + h * gy
                block_x = (math.floor(x) % columns) // 16
                block_y = (math.floor(y) % rows) // 16
                if not near[block_y, block_x]:
                    total += _open_ground_light(light, x, y)
                    k += 1
                    if rays == 4:
                        continue
                    break
                if rays == 1:
                    rays = 4
                    total = 0.0
                    continue
                kind, height = intersect_building(roof, ray, h, h + clearance)
                if kind <= ROOF:
                    column, row = x0 + height * gx, y0 + height * gy
                    total += _light_beside_buildings(light, roof, column, row, kind == ROOF)
                elif kind == WALL_EAST_WEST:
                    total += walls[1] if gx > 0.0 else walls[0]
                else:
                    total += walls[3] if gy > 0.0 else walls[2]
                k += 1
            out[r, s] = total / rays
