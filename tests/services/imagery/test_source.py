"""Chips show the ground of their geometry, at their own resolution."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from amers.services.geodesy import east_north_up, lon_lat_h_from_east_north_up
from amers.services.imagery.gaps import filled
from amers.services.imagery.source import (
    ArrayImage,
    CachedImage,
    Window,
    block_means,
    chip_ground,
    image_gsd_m,
    low_pass,
    quick_view,
    reduce_image,
    render_chip,
)
from amers.services.map_grid import MapGrid
from amers.services.sensors.ortho import OrthoModel
from amers.services.types import Array, FloatImage

a_millimetre = 1e-3
half_a_percent_of_the_amplitude = 0.005
a_fiftieth_of_a_pixel = 0.02
bicubic_px = 0.048 + 0.016
"""Allowed displacement: OpenCV's bicubic (a = -0.75) moves a slope by up to 0.048 px, and its positions
are multiples of 1/32 px."""
a_quarter_is_left = 0.25
a_float32 = 1e-4
half_a_percent = 0.005

ORIGIN = np.array([5.4, 43.6, 120.0])
SHAPE = (900, 1000)
AMPLITUDE = 100.0

most_alike = 0.99


@dataclass(frozen=True)
class PlaneModel:
    """A map of the plane tangent at `ORIGIN`, turned.

    Attributes:
        gsd_m: ground sampling.
        turn_deg: clockwise.
    """

    gsd_m: float = 1.0
    turn_deg: float = 0.0
    height_range_m: tuple[float, float] = (0.0, 500.0)

    @property
    def line_sample_per_metre(self) -> Array:
        """(2, 2) derivative by east and north."""
        c, s = np.cos(np.radians(self.turn_deg)), np.sin(np.radians(self.turn_deg))
        return np.array([[-s, -c], [c, -s]]) / self.gsd_m

    def project(self, lon_lat_h: Array) -> Array:
        enu = east_north_up(lon_lat_h, ORIGIN)
        return np.asarray(enu[:, :2] @ self.line_sample_per_metre.T + [450.0, 500.0])

    def project_derivative(self, lon_lat_h: Array) -> Array:
        one = np.column_stack([self.line_sample_per_metre, np.zeros(2)])
        return np.broadcast_to(one, (len(lon_lat_h), 2, 3))

    def locate(self, line_sample: Array, height_m: Array) -> Array:
        plane = (line_sample - [450.0, 500.0]) @ np.linalg.inv(self.line_sample_per_metre).T
        return lon_lat_h_from_east_north_up(np.column_stack([plane, 0.0 * height_m]), ORIGIN)

    def line_of_sight(self, line_sample: Array) -> tuple[Array, Array]:
        raise NotImplementedError("a map has no lines of sight")


def east_north_of_pixels(model: PlaneModel) -> Array:
    """(lines, samples, 2) metres east and north of `ORIGIN`."""
    pixels = np.stack(np.meshgrid(*map(np.arange, SHAPE), indexing="ij"), axis=-1)
    return np.asarray((pixels - [450.0, 500.0]) @ np.linalg.inv(model.line_sample_per_metre).T)


def waves(east_north: Array, wavelength_m: float) -> Array:
    """A pattern without symmetry: two waves and a slope."""
    east, north = east_north[..., 0], east_north[..., 1]
    turn = 2.0 * np.pi / wavelength_m
    value = 600.0 + AMPLITUDE * np.sin(turn * (east + 0.4 * north) + 0.3)
    return np.asarray(value + AMPLITUDE * np.cos(turn * (0.9 * north - 0.2 * east) + 1.0) + 0.2 * north)


def point_at(east_m: float, north_m: float) -> Array:
    return lon_lat_h_from_east_north_up(np.array([[east_m, north_m, 0.0]]), ORIGIN)[0]


def picture(model: PlaneModel, wavelength_m: float) -> ArrayImage:
    return ArrayImage(waves(east_north_of_pixels(model), wavelength_m).astype(np.float32))


def noise_image(seed: int = 0, smooth_px: float = 3.0) -> ArrayImage:
    noise = np.random.default_rng(seed).normal(0.0, 100.0, SHAPE).astype(np.float32)
    return ArrayImage(np.float32(500.0) + 3.0 * low_pass(noise, np.hypot(1.0, smooth_px / 0.4)))


def shift_between(one: FloatImage, other: FloatImage) -> Array:
    """Displacement (2,), rows and columns, of `other` relative to `one`, linearised at their mean."""
    middle = (one.astype(np.float64) + other) / 2.0
    slope = np.stack(np.gradient(middle), axis=-1)[2:-2, 2:-2].reshape(-1, 2)
    change = (one.astype(np.float64) - other)[2:-2, 2:-2].ravel()
    return np.asarray(np.linalg.lstsq(slope, change, rcond=None)[0])


@pytest.mark.parametrize("turn_deg", [0.0, 33.0, 190.0])
@pytest.mark.parametrize("gsd_m", [0.5, 1.0, 1.7, 4.0, 5.0])
def test_a_chip_shows_the_ground_of_its_grid_north_up(gsd_m: float, turn_deg: float) -> None:
    model = PlaneModel(1.0, turn_deg)
    wavelength_m = 60.0 * max(gsd_m, 1.0)
    chip = render_chip(picture(model, wavelength_m), model, point_at(37.3, -21.8), gsd_m)
    assert chip.shape == (101, 101)
    row, col = np.mgrid[0:101, 0:101]
    east_north = np.stack([37.3 + (col - 50) * gsd_m, -21.8 + (50 - row) * gsd_m], axis=-1)
    expected = waves(east_north, wavelength_m)
    assert np.isfinite(chip).all()
    slope_per_px = np.hypot(*np.gradient(expected)).max() * max(1.0, 0.5 * gsd_m) / gsd_m
    blur = 2.0 * AMPLITUDE * half_a_percent_of_the_amplitude
    assert np.abs(chip - expected).max() < slope_per_px * bicubic_px + blur


@pytest.mark.parametrize("gsd_m", [0.5, 1.0, 4.0])
def test_the_middle_of_a_chip_is_its_point_and_rows_go_south(gsd_m: float) -> None:
    point = point_at(-12.0, 31.0)
    ground = chip_ground(point, gsd_m, 5).reshape(5, 5, 3)
    enu = east_north_up(ground.reshape(-1, 3), point).reshape(5, 5, 3)
    np.testing.assert_allclose(enu[2, 2], 0.0, atol=a_millimetre)
    np.testing.assert_allclose(enu[0, 4], [2.0 * gsd_m, 2.0 * gsd_m, 0.0], atol=a_millimetre)
    np.testing.assert_allclose(enu[4, 0], [-2.0 * gsd_m, -2.0 * gsd_m, 0.0], atol=a_millimetre)


def test_a_chip_finer_than_the_image_is_not_blurred() -> None:
    model = PlaneModel(1.0)
    image = picture(model, 8.0)
    chip = render_chip(image, model, point_at(0.0, 0.0), 0.5)
    on_pixels = chip[::2, ::2]
    np.testing.assert_allclose(on_pixels, image.pixels[425:476, 475:526], atol=0.02)


@pytest.mark.parametrize("turn_deg", [0.0, 45.0])
@pytest.mark.parametrize("wavelength_px", [2.0, 2.5, 3.0, 4.0])
def test_detail_too_fine_for_a_chip_is_damped_and_not_aliased(
    wavelength_px: float, turn_deg: float
) -> None:
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    line, sample = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    fine = np.sin(2.0 * np.pi * (c * sample + s * line) / wavelength_px + 0.4)
    chip = render_chip(ArrayImage(fine.astype(np.float32)), PlaneModel(1.0), point_at(0.2, 0.3), 4.0)
    assert chip.std() < a_quarter_is_left * fine.std()


def test_a_chip_keeps_the_detail_that_it_can_show() -> None:
    model = PlaneModel(1.0)
    sample = np.broadcast_to(np.arange(SHAPE[1]), SHAPE)
    wave = np.sin(2.0 * np.pi * sample / 16.0).astype(np.float32)
    chip = render_chip(ArrayImage(wave), model, point_at(0.0, 0.0), 4.0)
    assert chip.std() > 0.8 * wave.std()


@pytest.mark.parametrize("ratio", [1.5, 2.0, 6.0])
def test_the_low_pass_keeps_the_mean_and_flat_images(ratio: float) -> None:
    pixels = noise_image(smooth_px=1.0).pixels
    smooth = low_pass(pixels, ratio)
    assert smooth.std() < pixels.std()
    assert float(smooth.mean()) == pytest.approx(float(pixels.mean()), abs=0.01 * float(pixels.std()))
    flat = np.full((40, 50), 321.0, dtype=np.float32)
    np.testing.assert_allclose(low_pass(flat, ratio), flat, rtol=1e-5)


@pytest.mark.parametrize("ratio", [0.3, 1.0])
def test_the_low_pass_leaves_coarser_images_unchanged(ratio: float) -> None:
    pixels = noise_image().pixels
    np.testing.assert_array_equal(low_pass(pixels, ratio), pixels)


@pytest.mark.parametrize("gsd_m", [0.5, 1.0, 4.0])
def test_a_chip_across_the_border_is_missing_outside_the_image(gsd_m: float) -> None:
    model = PlaneModel(1.0)
    image = noise_image()
    point = point_at(-490.0, 0.0)  # 10 px inside the western border
    chip = render_chip(image, model, point, gsd_m)
    east_m = -490.0 + (np.arange(101) - 50) * gsd_m
    missing = ~np.isfinite(chip)
    assert missing[:, east_m < -500.5].all()
    reach_m = 3.0 * gsd_m + 3.0
    inside = (east_m > -500.0 + reach_m) & (east_m < 499.0 - reach_m)
    assert not missing[:, inside].any()


@pytest.mark.parametrize(
    ("east_m", "north_m"), [(-5000.0, 0.0), (5000.0, 0.0), (0.0, 3000.0), (0.0, -3e3)]
)
def test_a_chip_beyond_the_image_is_missing(east_m: float, north_m: float) -> None:
    chip = render_chip(noise_image(), PlaneModel(1.0), point_at(east_m, north_m), 1.0)
    assert chip.shape == (101, 101)
    assert np.isnan(chip).all()


def test_nodata_stays_missing_and_does_not_spread_far() -> None:
    model = PlaneModel(1.0)
    pixels = noise_image().pixels.copy()
    pixels[440:461, 490:511] = np.nan
    chip = render_chip(ArrayImage(pixels), model, point_at(0.0, 0.0), 2.0)
    missing = np.argwhere(~np.isfinite(chip)) - 50
    assert (~np.isfinite(chip))[46:55, 46:55].all()
    assert np.abs(missing).max() <= 10


def test_a_chip_is_missing_beside_undefined_nodes_of_the_model_and_nowhere_else() -> None:
    @dataclass(frozen=True)
    class PartlyUndefined(PlaneModel):
        def project(self, lon_lat_h: Array) -> Array:
            line_sample = super().project(lon_lat_h)
            line_sample[0] = np.nan
            return line_sample

    chip = render_chip(noise_image(), PartlyUndefined(), point_at(0.0, 0.0), 1.0)
    whole = render_chip(noise_image(), PlaneModel(), point_at(0.0, 0.0), 1.0)
    defined = np.ones(chip.shape, dtype=bool)
    defined[:10, :10] = False
    assert np.isnan(chip[~defined]).all()
    np.testing.assert_array_equal(chip[defined], whole[defined])


def test_windows_are_nan_beyond_the_image() -> None:
    pixels = np.arange(12, dtype=np.float32).reshape(3, 4)
    image = ArrayImage(pixels)
    window = image.read(Window(-1, -2, 6, 8))
    np.testing.assert_array_equal(window[1:4, 2:6], pixels)
    assert np.isnan(window).sum() == 6 * 8 - 12
    np.testing.assert_array_equal(image.read(Window(1, 2, 1, 2)), pixels[1:2, 2:4])
    for away in (Window(5, 0, 2, 2), Window(0, -9, 2, 2), Window(-2, 0, 2, 2)):
        assert np.isnan(image.read(away)).all()


@pytest.mark.parametrize("factor", [1, 2, 3, 7])
@pytest.mark.parametrize("strip_pixels", [1, 5_000, 16_000_000])
def test_a_reduction_consists_of_block_means_for_any_size_of_the_strips(
    factor: int, strip_pixels: int
) -> None:
    image = ArrayImage(noise_image().pixels[:101, :130])
    reduced = reduce_image(image, factor, strip_pixels)
    lines, samples = 101 // factor, 130 // factor
    whole = image.pixels[: lines * factor, : samples * factor].astype(np.float64)
    means = whole.reshape(lines, factor, samples, factor).mean(axis=(1, 3))
    assert reduced.factor == factor
    assert reduced.pixels.dtype == np.float32
    np.testing.assert_allclose(reduced.pixels, means, rtol=0.0, atol=500.0 * a_float32)


@pytest.mark.parametrize("border", [0, 8, 9])
@pytest.mark.parametrize("lost", [np.nan, np.inf])
def test_blocks_beside_lost_ones_are_means_of_pixels_whose_gaps_are_filled(
    border: int, lost: float
) -> None:
    """Blocks of two pixels a side, along a border that cuts through them or not, and with a gap."""
    for gap in (False, True):
        pixels = noise_image().pixels[:40, :40].copy()
        pixels[:, :border] = lost
        if gap:
            pixels[21, 31] = lost
        whole = filled(pixels).astype(np.float64).reshape(20, 2, 20, 2).mean(axis=(1, 3))
        whole[:, : border // 2] = lost
        np.testing.assert_allclose(block_means(pixels, 2), whole, rtol=1e-6)


def test_a_block_is_lost_when_more_than_half_of_it_is() -> None:
    pixels = np.ones((6, 6), dtype=np.float32)
    pixels[0, 0] = pixels[1, 1] = np.nan
    pixels[2:4, 0:2] = [[np.nan, np.nan], [np.inf, 1.0]]
    pixels[4:6, 4:6] = [[np.inf, np.nan], [np.inf, 1.0]]
    expected = np.ones((3, 3))
    expected[1, 0] = np.nan
    expected[2, 2] = np.inf
    np.testing.assert_array_equal(block_means(pixels, 2), expected)


@pytest.mark.parametrize(("gsd_m", "factor"), [(8.0, 2), (8.0, 3), (8.0, 4), (5.0, 2)])
def test_a_chip_from_a_reduction_is_not_displaced(gsd_m: float, factor: int) -> None:
    model = PlaneModel(1.0, 20.0)
    image = noise_image(smooth_px=2.0 * gsd_m)
    point = point_at(11.3, -7.9)
    whole = render_chip(image, model, point, gsd_m, 51)
    reduced = render_chip(reduce_image(image, factor), model, point, gsd_m, 51)
    moved_px = shift_between(whole, reduced) * gsd_m
    assert np.abs(moved_px).max() < a_fiftieth_of_a_pixel
    assert np.std(whole - reduced) < 0.02 * np.std(whole)


@pytest.mark.parametrize("gsd_m", [0.5, 3.0])
def test_the_ground_sampling_of_an_image_is_the_side_of_its_pixels_on_the_ground(gsd_m: float) -> None:
    model = replace(PlaneModel(gsd_m), turn_deg=25.0)
    assert image_gsd_m(model, point_at(10.0, 20.0)) == pytest.approx(gsd_m, rel=1e-9)


def test_a_window_inside_a_cached_one_is_not_read_again() -> None:
    image, model, read = noise_image(), PlaneModel(1.0), []

    class Counted(ArrayImage):
        def read(self, window: Window) -> FloatImage:
            read.append(window)
            return super().read(window)

    for gsd_m in (1.0, 4.5):
        read.clear()
        cached = CachedImage(Counted(image.pixels))
        render_chip(cached, model, point_at(0.0, 0.0), gsd_m, 141)
        again = render_chip(cached, model, point_at(7.3, -4.1), gsd_m, 113)
        assert len(read) == 1
        np.testing.assert_array_equal(again, render_chip(image, model, point_at(7.3, -4.1), gsd_m, 113))
        render_chip(cached, model, point_at(40.0, 0.0), gsd_m, 141)
        assert len(read) == 2


def test_windows_beyond_the_limit_of_the_cache_are_read_again() -> None:
    image, model = noise_image(), PlaneModel(1.0)
    cached = CachedImage(image, max_bytes=200_000)
    wanted = render_chip(image, model, point_at(90.0, 0.0), 1.0)
    for _ in range(2):
        for east_m in (0.0, 30.0, 60.0, 90.0):
            chip = render_chip(cached, model, point_at(east_m, 0.0), 1.0)
    np.testing.assert_array_equal(chip, wanted)
    assert 0 < cached.cached_bytes <= 200_000


def test_a_geographic_ortho_image_at_60_degrees_north_has_half_the_sampling_to_the_east() -> None:
    step_deg = 1e-4
    grid = MapGrid(
        "EPSG:4326", np.array([10.0, 60.0]), step_deg * np.array([[0.0, 1.0], [-1.0, 0.0]]), (3, 3)
    )
    derivative = OrthoModel(grid).project_derivative(np.array([[10.0, 60.0, 0.0]]))[0]
    north_m, east_m = 1.0 / np.abs(derivative[[0, 1], [1, 0]])
    assert east_m == pytest.approx(north_m / 2.0, rel=half_a_percent)
    gsd_m = image_gsd_m(OrthoModel(grid), np.array([10.0, 60.0, 0.0]))
    assert gsd_m == pytest.approx(np.sqrt(east_m * north_m), rel=1e-6)
    assert gsd_m < 0.75 * north_m


def test_means_of_an_image_that_is_read_once_are_of_the_squares_asked_for() -> None:
    """The same window in larger squares, and a part of it in the squares that it has."""
    rng = np.random.default_rng(6)
    image = ArrayImage(rng.normal(size=(64, 64)).astype(np.float32))
    cached, whole = CachedImage(image), Window(0, 0, 64, 64)
    for factor in (2, 4, 2):
        np.testing.assert_array_equal(
            cached.means(whole, factor), block_means(image.read(whole), factor)
        )
    part = Window(8, 16, 32, 24)
    np.testing.assert_array_equal(cached.means(part, 4), block_means(image.read(part), 4))


@pytest.mark.parametrize("factor", [4, 7])
def test_a_quick_view_looks_like_the_means_and_is_missing_where_they_are(factor: int) -> None:
    image = noise_image(smooth_px=12.0)
    image.pixels[: 8 * factor, : 5 * factor] = np.nan
    image.pixels[-6 * factor :, -4 * factor :] = np.inf
    means = reduce_image(image, factor).pixels
    view = quick_view(image, factor)
    assert view.shape == means.shape
    seen = np.isfinite(means)
    np.testing.assert_array_equal(np.isnan(view), np.isnan(means))
    assert (np.isposinf(view) != np.isposinf(means)).sum() <= max(means.shape)  # the squares of an edge
    seen &= np.isfinite(view)
    assert np.corrcoef(view[seen], means[seen])[0, 1] > most_alike
