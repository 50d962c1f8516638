"""The blocks of the inverse of a sparse matrix are those of its dense inverse."""

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import splu

from amers.services.adjustment.normal_equations import seen_pairs
from amers.services.adjustment.selected_inverse import selected_inverse

IMAGES, SIZE = 60, 3


@pytest.mark.long
def test_blocks_of_pairs_are_those_of_the_dense_inverse() -> None:
    rng = np.random.default_rng(1)
    # Points are seen by images near each other, in rows of ten.
    point = np.repeat(np.arange(400), 3)
    middle = rng.integers(0, IMAGES, 400)
    image = np.clip(middle[:, None] + rng.choice([-10, -1, 0, 1, 10], (400, 3)), 0, IMAGES - 1)
    image = np.sort(image, axis=1).ravel()
    rows = np.tile(np.arange(2), len(point)) + 2 * np.repeat(point, 2)
    design = sparse.coo_matrix(
        (
            rng.normal(size=2 * SIZE * len(point)),
            (np.repeat(rows, SIZE), (np.repeat(image, 2)[:, None] * SIZE + np.arange(SIZE)).ravel()),
        )
    ).tocsr()
    matrix = (design.T @ design + sparse.identity(design.shape[1])).tocsc()
    pairs = seen_pairs(point.astype(np.int64), image.astype(np.int64), IMAGES)
    assert len(pairs.other) < IMAGES * IMAGES / 4
    options = {"SymmetricMode": True}
    factor = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    found = selected_inverse(factor, pairs, SIZE)
    dense = np.linalg.inv(matrix.toarray()).reshape(IMAGES, SIZE, IMAGES, SIZE)
    first = np.repeat(np.arange(IMAGES), np.diff(pairs.start))
    np.testing.assert_allclose(found, dense[first, :, pairs.other], rtol=1e-9, atol=1e-12)
