"""An image with finer or coarser pixels than its model says is named, before any long search."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.errors import NoConsensus, NotEnoughPoints, RescaledImage
from amers.services.imagery.source import ArrayImage, Window
from amers.services.registration.on_points import register_scene
from amers.services.registration.options import RegistrationOptions
from amers.services.registration.rescaled import _middle, how_it_is_rescaled, rescaled_scene
from tests.services.registration.small_ground import many_points, resampled, scene, whole


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (2.0, "2 times finer"),
        (3.0, "3 times finer"),
        (4.0, "4 times finer"),
        (1 / 2, "2 times coarser"),
        (1 / 3, "3 times coarser"),
        (1 / 4, "4 times coarser"),
    ],
)
@pytest.mark.long
def test_each_factor_is_named(factor: float, words: str) -> None:
    said = how_it_is_rescaled(resampled(factor), *many_points(), RegistrationOptions())
    assert said.startswith(f"the pixels of the image are {words} than its model says, by ")
    assert "give the model that was delivered with this image" in said


def test_the_model_of_an_image_with_other_pixels_keeps_the_corner_of_the_first() -> None:
    of = rescaled_scene(whole(), 2.0)
    ground = whole().model.locate(np.array([[-0.5, -0.5], [0.0, 0.0], [100.0, 7.0]]), np.zeros(3))
    np.testing.assert_allclose(
        of.model.project(ground), [[-0.5, -0.5], [0.5, 0.5], [200.5, 14.5]], atol=1e-6
    )


def test_an_image_of_its_model_and_one_of_other_ground_are_not_named() -> None:
    assert how_it_is_rescaled(resampled(1.0), *many_points(), RegistrationOptions()) == ""
    noise = np.random.default_rng(3).normal(500.0, 100.0, (400, 400)).astype(np.float32)
    other = replace(resampled(1.0), image=ArrayImage(noise))
    assert how_it_is_rescaled(other, *many_points(), RegistrationOptions()) == ""


@pytest.mark.long
@pytest.mark.parametrize("sigma_m", [3.0, 40.0])
def test_a_registration_is_refused_before_more_points_are_searched_or_the_image_is_turned(
    sigma_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unexpected(*_: object) -> None:
        raise AssertionError("a long search")

    monkeypatch.setattr("amers.services.registration.coarse._with_smaller_chips", unexpected)
    monkeypatch.setattr("amers.services.registration.on_points._how_it_is_turned", unexpected)
    with pytest.raises(RescaledImage, match="2 times finer") as refused:
        register_scene(resampled(2.0, sigma_m), *many_points())
    assert isinstance(refused.value, NoConsensus)
    assert not isinstance(refused.value, NotEnoughPoints)


@pytest.mark.parametrize("side", [200, 2000])
def test_the_middle_of_an_image_is_where_its_model_shows_it(side: int) -> None:
    """Of 400 lines and 500 samples; a smaller image is its own middle."""
    of = scene(np.zeros(2), 5.0, 400, 500)
    middle = _middle(of, side)
    lines, samples = middle.image.shape
    assert (lines, samples) == ((200, 200) if side == 200 else (400, 500))
    first = (400 - lines) // 2, (500 - samples) // 2
    at = np.array([[199.5, 249.5], [150.0, 260.0]])
    ground = of.model.locate(at, np.zeros(2))
    np.testing.assert_allclose(middle.model.project(ground), at - first, atol=1e-6)
    shown, expected = middle.image.read(Window(0, 0, 90, 120)), of.image.read(Window(*first, 90, 120))
    np.testing.assert_array_equal(shown, expected)
