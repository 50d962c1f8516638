"""Geometries become vertices and geometries again."""

import numpy as np
import pytest
import shapely

from amers.services.errors import InputError
from amers.services.vectors.shapes import geometries_of, place_of, shapes_of

WKT = [
    "POINT (1 2)",
    "POLYGON ((0 0, 4 0, 4 4, 0 4, 0 0), (1 1, 2 1, 2 2, 1 1), (3 3, 3.5 3, 3.5 3.5, 3 3))",
    "MULTIPOLYGON (((0 0, 4 0, 4 4, 0 0)), ((5 5, 9 5, 9 9, 5 5), (6 5.5, 7 5.5, 7 6, 6 5.5)))",
    "POLYGON EMPTY",
    "MULTIPOINT (1 2, 3 4)",
    "LINESTRING (0 0, 1 1, 2 2, 0 0)",
    "MULTILINESTRING ((0 0, 1 1), (2 2, 3 3, 4 4))",
    "POINT EMPTY",
    "MULTILINESTRING EMPTY",
    "MULTIPOLYGON EMPTY",
    "POLYGON ((0 0, 2 2, 2 0, 0 2, 0 0))",
]


def test_all_types_survive_with_their_parts_holes_and_missing_ones() -> None:
    geometries = np.array([None, *shapely.from_wkt(WKT), None], dtype=object)
    again = geometries_of(shapes_of(geometries))
    assert again[0] is None
    assert again[-1] is None
    assert [shape.wkt for shape in again[1:-1]] == [shape.wkt for shape in geometries[1:-1]]


def test_the_types_survive_with_heights() -> None:
    geometries = shapely.from_wkt(["POINT Z (1 2 3)", "LINESTRING Z (0 0 5, 1 1 6, 0 0 7)"])
    shapes = shapes_of(geometries)
    assert shapes.vertices.shape == (4, 3)
    assert shapely.to_wkt(geometries_of(shapes)).tolist() == shapely.to_wkt(geometries).tolist()


def test_vertices_that_neighbours_share_are_one() -> None:
    shapes = shapes_of(shapely.from_wkt([WKT[1], WKT[2], WKT[5]]))
    assert len(shapes.vertices) < len(shapes.index)
    assert len(np.unique(shapes.vertices, axis=0)) == len(shapes.vertices)


def test_a_vertex_is_named_by_its_feature_and_number() -> None:
    shapes = shapes_of(np.array([None, *shapely.from_wkt(["POINT (1 1)", WKT[6]])], dtype=object))
    assert place_of(shapes, 0) == "feature 2, vertex 1"
    assert place_of(shapes, 5) == "feature 3, vertex 5"


def test_the_largest_value_is_that_of_the_vertices_of_a_geometry() -> None:
    shapes = shapes_of(np.array([None, *shapely.from_wkt(["POINT (1 1)", WKT[5]])], dtype=object))
    assert shapes.largest(shapes.vertices[:, 0]).tolist()[1:] == [1.0, 2.0]
    assert np.isnan(shapes.largest(shapes.vertices[:, 0])[0])
    shapes.vertices[shapes.index[-2], 0] = np.nan
    assert np.isnan(shapes.largest(shapes.vertices[:, 0])[2])


@pytest.mark.parametrize(
    ("wkt", "problem"),
    [
        ("GEOMETRYCOLLECTION (POINT (1 1))", "feature 2: GeometryCollection found, points, lines"),
        ("LINESTRING (0 0, NaN 1, 2 2)", "feature 2, vertex 2: a coordinate that is no finite number"),
    ],
)
def test_what_cannot_be_used_is_named(wkt: str, problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        shapes_of(shapely.from_wkt(["POINT (0 0)", wkt]))
