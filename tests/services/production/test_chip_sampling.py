"""The ground samplings of the chips of a block."""

import pytest

from amers.services.errors import InputError
from amers.services.production import chip_sampling
from amers.services.production.chip_sampling import chip_samplings_m


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ((None, None), (0.71, 2.84)),
        ((0.5, None), (0.5, 2.0)),
        ((None, 7.0), (0.71, 7.0)),
        ((2.0, 20.0), (2.0, 20.0)),
    ],
)
def test_chips_have_the_sampling_of_the_coarsest_image_unless_another_is_given(
    given: tuple[float | None, float | None],
    expected: tuple[float, float],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(chip_sampling, "scene_gsd_m", float)
    assert chip_samplings_m([0.504, 0.7091, 0.69], *given) == pytest.approx(expected)  # type: ignore[list-item]


@pytest.mark.parametrize("given", [(0.0, 2.0), (-1.0, None), (2.0, 2.0), (20.0, 2.0)])
def test_samplings_in_no_order_are_refused(given: tuple[float, float | None]) -> None:
    with pytest.raises(InputError, match="expected a fine one above 0 and below the coarse one"):
        chip_samplings_m([], *given)
