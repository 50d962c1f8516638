"""Geometries across 180 degrees, cut so that they lie on a map (RFC 7946, 3.1.9)."""

import numpy as np
import shapely

WORLD = shapely.box(-180.0, -90.0, 180.0, 90.0)
TURNS_DEG = (-360.0, 0.0, 360.0)


def on_the_map(shape: shapely.Geometry) -> shapely.Geometry:
    """The parts of a geometry between -180 and 180 degrees.

    Args:
        shape: with continuous longitudes, -540 to 540 degrees.
    """
    if not (np.abs(shapely.get_coordinates(shape)[:, 0]) > 180.0).any():
        return shape
    pieces: list[shapely.Geometry] = []
    for part in shapely.get_parts(shape):
        for turn in TURNS_DEG:
            turned = shapely.transform(part, lambda lon_lat, turn=turn: lon_lat + [turn, 0.0])
            pieces += shapely.get_parts(shapely.intersection(turned, WORLD)).tolist()
    # Where a part only touches 180 degrees, the common edge is no part of the result.
    dimension = shapely.get_dimensions(shape)
    return shapely.union_all([piece for piece in pieces if shapely.get_dimensions(piece) == dimension])
