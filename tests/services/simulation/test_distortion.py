"""Distortions have the sizes asked for and exact inverses, and pixels are distorted as they say."""

import numpy as np
import pytest

from amers.services.imagery.source import ArrayImage, Window
from amers.services.simulation.distortion import (
    Bend,
    DistortedImage,
    Distortion,
    Kink,
    MovedGround,
    Seam,
    Step,
    Waves,
)
from amers.services.simulation.render import surface_seen
from amers.services.simulation.tiles import TiledView
from amers.services.simulation.view import ViewGeometry
from amers.services.simulation.world import World
from amers.services.types import Array, FloatImage

SHAPE = (300, 330)
WHOLE = Window(0, 0, *SHAPE)
JITTER = Waves(np.array([[2.0, -1.0], [0.5, 0.7]]), np.array([100.0, 170.0]), np.full((2, 2), 0.3))
CHIRP = Waves(np.array([[0.0, 3.0]]), np.array([150.0]), np.zeros((1, 2)), 1.0 / 300.0)
BOW = Bend(np.array([[0.0, 0.0], [0.0, 0.0], [4.0, -2.0]]), 0, SHAPE[0])
SMILE = Bend(np.array([[0.0, 0.0], [0.0, 0.0], [-1.5, 2.0], [0.5, 0.0]]), 1, SHAPE[1])
KINK = Kink(120.0, np.array([0.01, -0.02]))
LANDSLIDE = MovedGround(np.array([140.0, 150.0]), np.array([80.0, 40.0]), 0.4, np.array([6.25, -9.5]))
DISTORTIONS = {
    "none": Distortion(SHAPE),
    "jitter": Distortion(SHAPE, (JITTER,)),
    "chirp": Distortion(SHAPE, (CHIRP,)),
    "bow": Distortion(SHAPE, (BOW, SMILE)),
    "kink": Distortion(SHAPE, (KINK,)),
    "steps": Distortion(SHAPE, steps=(Step(90, -12), Step(200, 30))),
    "moved": Distortion(SHAPE, moved=LANDSLIDE),
    "seams": Distortion(
        SHAPE, seams=(Seam(1, 70, np.array([1.3, -2.2])), Seam(0, 220, np.array([0.0, 4.1])))
    ),
    "mixture": Distortion(SHAPE, (JITTER, SMILE), (Step(200, 7),), LANDSLIDE),
    "mirrored": Distortion(SHAPE, (JITTER,), turn="mirrored"),
    "upside down": Distortion(SHAPE, turn="upside down"),
    "swapped": Distortion((300, 300), (JITTER,), turn="swapped"),
}
rounding = 2.0
accuracy_of_the_spline = 5e-4  # on white noise of unit variance, whose spline is hardest
hundredth_of_the_contrast = 0.01


@pytest.fixture(scope="module")
def straight(world: World, taken: ViewGeometry) -> FloatImage:
    return TiledView(world, taken, 1).read(WHOLE)


def pixels_of(shape: tuple[int, int]) -> Array:
    return np.indices(shape).reshape(2, -1).T.astype(np.float64)


@pytest.mark.parametrize("name", DISTORTIONS)
@pytest.mark.long
def test_the_inverse_gives_back_every_pixel_that_is_shown_once(name: str) -> None:
    distortion = DISTORTIONS[name]
    pixels = pixels_of(distortion.shape)
    back = distortion.distorted(distortion.undistorted(pixels))
    unique = np.isfinite(back).all(axis=1)
    np.testing.assert_allclose(back[unique], pixels[unique], atol=1e-8)
    unknown = distortion.distorted(np.vstack([[np.nan, 5.0], distortion.undistorted(pixels[unique])]))
    assert np.isnan(unknown[0]).all()
    np.testing.assert_allclose(unknown[1:], pixels[unique], atol=1e-8)
    jumps = distortion.steps or distortion.moved or distortion.seams
    assert unique.all() if not jumps else 0.5 < unique.mean() < 1.0


def test_waves_have_their_amplitudes_and_periods() -> None:
    line = np.arange(0.0, 100.0, 0.5)
    wave = Waves(np.array([[2.0, 0.7]]), np.array([100.0]), np.array([[0.0, 1.0]]))
    places = np.column_stack([line, np.full(len(line), 55.0)])
    moved = wave.at(places)
    np.testing.assert_allclose(moved, wave.at(places + [100.0, -40.0]), atol=1e-9)
    np.testing.assert_allclose(np.ptp(moved, axis=0) / 2.0, [2.0, 0.7], rtol=1e-3)


def test_a_chirp_is_twice_as_fast_when_its_frequency_has_doubled() -> None:
    line = np.arange(0.0, 600.0, 0.01)
    moved = CHIRP.at(np.column_stack([line, line]))[:, 1]
    crossings = line[:-1][np.diff(np.sign(moved)) != 0]
    halves = np.diff(crossings)
    assert halves[0] == pytest.approx(75.0, rel=0.2)
    at_300 = halves[np.argmin(np.abs(crossings[1:] - 300.0))]
    assert at_300 == pytest.approx(75.0 / 2.0, rel=0.1)


def test_bends_are_as_large_as_stated_at_the_last_line() -> None:
    ends = np.array([[0.0, 9.0], [SHAPE[0] - 1.0, 200.0]])
    np.testing.assert_allclose(BOW.at(ends), [[4.0, -2.0], [4.0, -2.0]], atol=1e-12)
    middle = BOW.at(np.array([[(SHAPE[0] - 1.0) / 2.0, 0.0]]))
    np.testing.assert_allclose(middle, [[-2.0, 1.0]], atol=1e-12)


def test_a_kink_moves_what_lies_behind_it_by_its_rate() -> None:
    places = np.array([[20.0, 7.0], [120.0, 200.0], [220.0, 7.0]])
    np.testing.assert_allclose(KINK.at(places), [[0.0, 0.0], [0.0, 0.0], [1.0, -2.0]], atol=1e-12)


def test_what_lies_behind_a_seam_is_shifted_and_the_middle_is_not() -> None:
    moved = DISTORTIONS["seams"].undistorted(pixels := pixels_of(SHAPE)) - pixels
    by_part = {
        (bool(line >= 220), bool(sample >= 70)): shift.tolist()
        for (line, sample), shift in zip(pixels, moved, strict=True)
    }
    assert by_part[False, True] == [0.0, 0.0]
    np.testing.assert_allclose(by_part[False, False], [-1.3, 2.2])
    np.testing.assert_allclose(by_part[True, True], [0.0, 4.1])
    np.testing.assert_allclose(by_part[True, False], [-1.3, 6.3])


def test_repeated_lines_repeat_their_pixels_and_lost_ones_are_nowhere() -> None:
    image = ArrayImage(np.random.default_rng(1).normal(0.0, 1.0, (500, 330)).astype(np.float32))
    distortion = DISTORTIONS["steps"]
    inside = np.s_[:, 3:-3]
    pixels = DistortedImage(image, distortion, (100, 0)).read(WHOLE)[inside]
    np.testing.assert_allclose(pixels[90:102], pixels[78:90], atol=accuracy_of_the_spline)
    np.testing.assert_allclose(pixels[200:], image.pixels[inside][330:430], atol=accuracy_of_the_spline)
    np.testing.assert_allclose(
        pixels[102:200], image.pixels[inside][202:300], atol=accuracy_of_the_spline
    )
    lost = np.column_stack([np.arange(201.0, 229.0), np.full(28, 5.0)])
    assert np.isnan(distortion.distorted(lost)).all()
    repeated = np.column_stack([np.arange(91.0, 101.0) - 12.0, np.full(10, 5.0)])
    assert not distortion.is_unique(repeated + [12.0, 0.0]).any()


@pytest.mark.parametrize("name", ["mirrored", "upside down", "swapped"])
def test_turned_images_show_the_same_pixels_elsewhere(
    world: World, taken: ViewGeometry, straight: FloatImage, name: str
) -> None:
    """What a pixel holds is a mean over its lines: it is not quite that over its samples."""
    distortion = Distortion(SHAPE, turn=name)  # type: ignore[arg-type]
    pixels = TiledView(world, taken, 1, distortion=distortion).read(WHOLE)
    turned = {
        "mirrored": straight[:, ::-1],
        "upside down": straight[::-1],
        "swapped": straight[:, :300].T,
    }[name]
    both = pixels[: turned.shape[0], : turned.shape[1]], turned[: pixels.shape[0]]
    assert np.corrcoef(both[0].ravel(), both[1].ravel())[0, 1] > 0.99


@pytest.mark.parametrize("name", ["jitter", "bow", "steps", "moved", "seams", "mixture"])
def test_rendered_pixels_are_where_the_distortion_says(
    world: World, taken: ViewGeometry, straight: FloatImage, name: str
) -> None:
    """The same image resampled by the exact map: what is rendered differs by resampling alone."""
    distortion = DISTORTIONS[name]
    rendered = TiledView(world, taken, 1, distortion=distortion).read(WHOLE)
    resampled = DistortedImage(ArrayImage(straight), distortion).read(WHOLE)
    inside = np.isfinite(resampled)
    assert inside.mean() > (0.88 if name == "steps" else 0.9)
    error = (rendered - resampled)[inside]
    untouched = (straight - resampled)[inside]
    assert error.std() < 0.35 * untouched.std()
    assert abs(error.mean()) < hundredth_of_the_contrast * straight.std()


def test_moved_ground_is_told_from_the_rest(world: World, taken: ViewGeometry) -> None:
    distortion = DISTORTIONS["moved"]
    pixels = pixels_of(SHAPE)
    moved = distortion.is_moved(pixels)
    assert moved.mean() == pytest.approx(np.pi * 80.0 * 40.0 / (300.0 * 330.0), rel=0.01)
    shown = surface_seen(world, taken.true_model, distortion.undistorted(pixels))
    elsewhere = taken.true_model.project(shown) - pixels
    np.testing.assert_allclose(elsewhere[moved].mean(axis=0), [6.25, -9.5], atol=1e-3)
    np.testing.assert_allclose(elsewhere[~moved], 0.0, atol=1e-3)


def test_pixels_do_not_depend_on_the_windows_they_are_read_by(world: World, taken: ViewGeometry) -> None:
    whole = TiledView(world, taken, 1, distortion=DISTORTIONS["mixture"]).read(WHOLE)
    pieces = TiledView(world, taken, 1, distortion=DISTORTIONS["mixture"])
    window = Window(120, 90, 100, 110)
    np.testing.assert_array_equal(pieces.read(window), whole[120:220, 90:200])
    image = DistortedImage(ArrayImage(whole), DISTORTIONS["mixture"])
    np.testing.assert_allclose(image.read(window), image.read(WHOLE)[120:220, 90:200], atol=0.5)
    beyond = image.read(Window(-10, -20, 30, 40))
    assert np.isnan(beyond[:10]).all()
    assert np.isnan(beyond[:, :20]).all()
