"""Edges that bend keep to their curves, wherever these lead."""

import numpy as np
import pytest
import shapely

from amers.services.types import Array
from amers.services.vectors import curves
from amers.services.vectors.curves import Curves, Transformation, curved
from amers.services.vectors.shapes import shapes_of

TOLERANCE = 0.05


def bent(farther: float) -> Curves:
    """A straight edge of unit length, whose middle is moved along it and back again."""

    def apply(place: Array) -> Array:
        x = place[:, 0]
        return np.column_stack([x + farther * np.sin(np.pi * x), np.zeros(len(x))])

    def pieces(start: Array, _: Array) -> Array:
        return np.full(len(start), 64.0)

    edge = shapes_of(shapely.linestrings([[[0.0, 0.0], [1.0, 0.0]]]))
    return curved(edge, Transformation(apply, pieces, pieces, np.full(2, TOLERANCE)))


@pytest.mark.parametrize("farther", [2.0, -2.0])
def test_an_edge_that_leads_beyond_its_end_and_back_does_so_on_the_map(farther: float) -> None:
    reached = bent(farther).target.vertices[:, 0]
    x = np.linspace(0.0, 1.0, 1001)
    true = x + farther * np.sin(np.pi * x)
    assert reached.max() == pytest.approx(true.max(), abs=TOLERANCE)
    assert reached.min() == pytest.approx(true.min(), abs=TOLERANCE)


def test_an_edge_that_is_stretched_along_itself_needs_no_vertex() -> None:
    assert len(bent(0.2).target.vertices) == 2


def zigzag(seen: list[Array]) -> Transformation:
    """Up and down however finely it is looked at, and nowhere beyond 0.9; it tells where it is asked."""

    def apply(place: Array) -> Array:
        seen.append(place[:, 0])
        high = np.where(place[:, 0] > 0.9, np.nan, np.sin(1e4 * place[:, 0]))
        return np.column_stack([place[:, 0], high])

    def pieces(start: Array, end: Array) -> Array:
        return 1.0 + np.floor(7.0 * np.abs(end - start)[:, 0])

    def finest(start: Array, end: Array) -> Array:
        return 64.0 * np.abs(end - start)[:, 0]

    return Transformation(apply, pieces, finest, np.full(2, TOLERANCE))


def test_an_edge_is_cut_into_its_finest_pieces_at_most() -> None:
    seen: list[Array] = []
    curved(shapes_of(shapely.linestrings([[[0.0, 0.0], [1.0, 0.0]]])), zigzag(seen))
    assert np.diff(np.unique(np.concatenate(seen))).min() == pytest.approx(1.0 / 64.0)


def test_edges_that_are_transformed_in_batches_are_those_of_one(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = shapely.linestrings(np.random.default_rng(1).uniform(0.0, 1.0, (20, 3, 2)))
    whole = curved(shapes_of(lines), zigzag([]))
    monkeypatch.setattr(curves, "_BATCH", 10)
    parts = curved(shapes_of(lines), zigzag([]))
    assert 0 < whole.broken.sum() < 20
    np.testing.assert_array_equal(parts.broken, whole.broken)
    for one, other in ((parts.source, whole.source), (parts.target, whole.target)):
        np.testing.assert_array_equal(one.vertices[one.index], other.vertices[other.index])
