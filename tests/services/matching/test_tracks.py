"""Tie points over many images, from matches of pairs that are partly wrong."""

import numpy as np

from amers.services.matching.tie_points import Matches
from amers.services.matching.tracks import image_cells, spread_tracks, tracks


def links_of(
    rng: np.random.Generator, n_images: int, n_details: int, wrong: float
) -> list[tuple[int, int, Matches]]:
    """Matches of all pairs of images, in which feature i shows detail i; wrong ones are less alike."""
    links = []
    for one in range(n_images):
        for other in range(one + 1, n_images):
            rows = np.column_stack([np.arange(n_details)] * 2)
            is_wrong = rng.random(n_details) < wrong
            rows[is_wrong, 1] = rng.integers(0, n_details, is_wrong.sum())
            similarity = np.where(
                is_wrong, rng.uniform(0.5, 0.9, n_details), rng.uniform(0.7, 1.0, n_details)
            )
            links.append((one, other, Matches(rows, similarity)))
    return links


def test_wrong_matches_do_not_run_tie_points_together() -> None:
    n_images, n_details = 8, 500
    links = links_of(np.random.default_rng(1), n_images, n_details, wrong=0.05)
    image = np.repeat(np.arange(n_images), n_details)
    start = np.arange(n_images) * n_details
    point = tracks(image, links, start)
    shown = np.stack([point[start[i] : start[i] + n_details] for i in range(n_images)], axis=1)
    # Nearly all tie points are one detail in all images. Without the rule nearly none would be.
    assert (shown == shown[:, :1]).all(axis=1).mean() > 0.97
    for number in np.unique(point[point >= 0]):
        images = image[point == number]
        assert len(np.unique(images)) == len(images)


def test_the_order_of_the_pairs_does_not_matter_for_whole_tie_points() -> None:
    links = links_of(np.random.default_rng(2), 5, 100, wrong=0.0)
    image, start = np.repeat(np.arange(5), 100), np.arange(5) * 100
    np.testing.assert_array_equal(tracks(image, links, start), tracks(image, links[::-1], start))


def test_features_without_a_match_have_no_tie_point() -> None:
    links = [(0, 1, Matches(np.array([[2, 0]]), np.array([0.9])))]
    image, start = np.array([0, 0, 0, 1, 1]), np.array([0, 3])
    np.testing.assert_array_equal(tracks(image, links, start), [-1, -1, 0, 0, -1])


def test_no_links_give_no_tie_points() -> None:
    assert (tracks(np.zeros(3, dtype=np.int64), [], np.array([0])) == -1).all()


def test_tie_points_are_thinned_to_an_even_spread_and_long_ones_stay() -> None:
    rng = np.random.default_rng(3)
    n, n_images = 2_000, 3
    length = rng.integers(2, 4, n)
    point = np.repeat(np.arange(n), length)
    image = np.concatenate([np.arange(count) for count in length])
    crowded = rng.random(n) < 0.9
    place = np.where(crowded[:, None], rng.uniform(0, 100, (n, 2)), rng.uniform(0, 1000, (n, 2)))
    cell = image_cells(place[point], (1000, 1000), 10)
    kept = spread_tracks(point, image, cell, per_cell=5)
    assert (
        np.bincount(point[kept], minlength=n)[np.unique(point[kept])] == length[np.unique(point[kept])]
    ).all()
    for i in range(n_images):
        before = np.bincount(cell[image == i], minlength=100)
        after = np.bincount(cell[kept & (image == i)], minlength=100)
        assert (after >= np.minimum(before, 5)).all()
    assert np.bincount(cell[kept])[0] < 30
    assert length[np.unique(point[kept])].mean() > length.mean()


def test_cells_divide_the_lines_and_the_samples_of_an_image() -> None:
    """Three by three of 30 lines and 60 samples; what lies beyond the border is in a cell beside it."""
    at = np.argwhere(np.ones((30, 60)))
    np.testing.assert_array_equal(image_cells(at, (30, 60), 3), 3 * (at[:, 0] // 10) + at[:, 1] // 20)
    beyond = np.array([[-0.6, 59.6], [35.0, -9.0], [15.0, 70.0], [9.4, 19.4], [9.6, 19.6]])
    np.testing.assert_array_equal(image_cells(beyond, (30, 60), 3), [2, 6, 5, 0, 4])
