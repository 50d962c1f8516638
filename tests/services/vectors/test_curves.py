"""Edges that bend keep to their curves, wherever these lead."""

import numpy as np
import pytest
import shapely

from amers.services.types import Array
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
