"""Real deliveries: all models are read in the right pixels, and the images agree on the ground."""

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
import rpcfast
from rasterio.warp import transform

from amers.services.errors import FormatError
from amers.services.formats.images.scenes import read_scene
from amers.services.formats.sensor_models.dimap import format_dimap_rpc, parse_dimap_rpc
from amers.services.formats.sensor_models.rpc_files import read_rpc
from amers.services.formats.sensor_models.rpc_text import format_rpc_text, parse_rpc_text
from amers.services.imagery.scene import Scene, scene_centre, scene_gsd_m
from amers.services.imagery.source import Window, render_chip
from amers.services.sensors.correction import fold_into_rpc, no_correction
from amers.services.sensors.rpc import RpcModel, check_rpc
from amers.services.types import Array

pytestmark = [
    pytest.mark.real_data,
    pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning"),
    pytest.mark.filterwarnings("ignore::rpcfast.RPCSelfCheckWarning"),
]

a_nanopixel = 1e-9
a_millionth_of_a_pixel = 1e-6
a_hundredth_of_a_pixel = 0.01
a_tenth_of_a_pixel = 0.1

DIMAP = ["phr_rpc_only/*/*.XML", "rigorous_metadata/pleiades_dimap/RPC_*.XML"]
DIMAP += ["rigorous_metadata/spot6_dimapv2/rpc_SPOT6.xml", "phr_*_*/**/[Rr][Pp][Cc]_*.[Xx][Mm][Ll]"]
TEXT = ["skysat_tiepoints/*/rpcs/*.rpc", "phr_*_pair/*_RPC.TXT"]
TEXT += ["rigorous_metadata/spot1-5_dimap/SP2_RPC.txt"]
VENTOUX_RPC = "RPC_PHR1B_P_201308051042194_SEN_690908101-001.XML"


def files(folder: Path, patterns: list[str]) -> list[Path]:
    return sorted({file for pattern in patterns for file in folder.glob(pattern)})


def ground_of(model: RpcModel, extent: float = 1.0) -> Array:
    normalised = np.random.default_rng(7).uniform(-extent, extent, (500, 3))
    return model.ground_offset + normalised * model.ground_scale


@pytest.mark.long
def test_every_real_model_passes_its_check_and_agrees_with_another_reader(real_data: Path) -> None:
    dimap, text = files(real_data, DIMAP), files(real_data, TEXT)
    assert (len(dimap), len(text)) >= (44, 15)
    for file in dimap + text:
        parse = parse_dimap_rpc if file in dimap else parse_rpc_text
        model = check_rpc(parse(file.read_text("latin-1"), file.name), file.name)
        ground = ground_of(model)
        sample, line = rpcfast.project(rpcfast.read_rpc(str(file)), *ground.T)
        np.testing.assert_allclose(
            model.project(ground), np.column_stack([line, sample]), rtol=1e-12, atol=a_nanopixel
        )
        far = np.array([[1e12, 0.0], [0.0, -1e12], [1e12, 1e12]])
        assert np.isnan(model.locate(far, np.full(3, model.ground_offset[2]))).all(), file.name


def test_every_real_dimap_takes_a_shift_and_a_drift(real_data: Path) -> None:
    parameters = np.array([[40.0, 2.0, 0.0], [-25.0, 0.0, -1.5]])
    for file in files(real_data, DIMAP)[::5]:
        text = file.read_text("latin-1")
        model = parse_dimap_rpc(text)
        refined = fold_into_rpc(model, replace(no_correction((30000, 30000)), parameters=parameters))
        again = parse_dimap_rpc(format_dimap_rpc(text, refined))
        ground = ground_of(model)
        np.testing.assert_allclose(
            again.project(ground), refined.project(ground), rtol=0.0, atol=a_millionth_of_a_pixel
        )


@pytest.mark.parametrize("view", ["01", "02", "03"])
def test_dimap_and_tags_of_one_image_agree_to_the_bit(
    real_data: Path, view: str, tmp_path: Path
) -> None:
    """Proves that DIMAP version 2 counts from one, also in crops.

    The document beside the image goes before its tags, as in GDAL.
    """
    folder = real_data / "phr_calanques_triplet"
    alone = shutil.copy(folder / f"img_{view}.tif", tmp_path)
    tags = read_rpc(Path(alone))
    dimap = read_rpc(folder / f"img_{view}.tif")
    assert (tags.convention, dimap.convention) == ("tags", "dimap")
    ground = ground_of(tags.model)
    np.testing.assert_array_equal(tags.model.project(ground), dimap.model.project(ground))


def test_a_crop_in_its_own_pixels_is_a_whole_number_of_pixels_from_the_full_scene(
    real_data: Path,
) -> None:
    folder = real_data / "phr_calanques_triplet"
    crop = read_rpc(folder / "img_01.tif").model
    full_file = folder / "rpc_full_scene" / "RPC_PHR1A_P_201304171037198_SEN_616226101-001.XML"
    full = parse_dimap_rpc(full_file.read_text())
    corners = np.array([[0.0, 0.0], [0.0, 1023.0], [1023.0, 1023.0], [1023.0, 0.0]])
    shift = full.project(crop.locate(corners, np.full(4, 100.0))) - corners
    np.testing.assert_allclose(shift, [[22671.0, 5301.0]] * 4, rtol=0.0, atol=1e-4)


@pytest.mark.parametrize(
    ("image", "product", "first"),
    [
        ("left", "201308051042194_SEN_690908101-001", (5000.0, 5000.0)),
        ("right", "201308051042523_SEN_690908101-002", (5162.0, 4915.0)),
    ],
)
def test_the_rpc_agrees_with_the_physical_model(
    real_data: Path, image: str, product: str, first: tuple[float, float]
) -> None:
    """The producer's grids locate pixels 4000, 4200 … of the full scene, counted from zero."""
    folder = real_data / "phr_ventoux_pair"
    crop = read_rpc(folder / f"{image}_image.tif").model
    with rasterio.open(folder / "loc_grids" / f"GRID_PHR1B_P_{product}.tif") as grid:
        lon_lat = grid.read()
    line, sample = np.mgrid[0 : grid.height, 0 : grid.width] * 200.0 + 4000.0
    line_sample = np.column_stack([line.ravel() - first[0], sample.ravel() - first[1]])
    for level, height_m in enumerate((-100.0, 485.0, 1000.0, 2000.0)):
        lon, lat = lon_lat[2 * level].ravel(), lon_lat[2 * level + 1].ravel()
        ground = np.column_stack([lon, lat, np.full(lon.size, height_m)])
        np.testing.assert_allclose(
            crop.project(ground), line_sample, rtol=0.0, atol=a_hundredth_of_a_pixel
        )


def test_the_full_scene_s_dimap_is_shifted_to_the_crop(real_data: Path) -> None:
    folder = real_data / "phr_ventoux_pair"
    own = read_rpc(folder / "left_image.tif")
    full = read_rpc(folder / "left_image.tif", folder / VENTOUX_RPC)
    assert (own.crop_origin, full.crop_origin) == ((0.0, 0.0), (5000.0, 5000.0))
    ground = ground_of(own.model)
    np.testing.assert_allclose(
        full.model.project(ground), own.model.project(ground), rtol=0.0, atol=a_millionth_of_a_pixel
    )


@pytest.mark.parametrize("view", ["1", "2"])
def test_models_of_the_full_scene_and_of_the_crop_are_distinguished(
    real_data: Path, tmp_path: Path, view: str
) -> None:
    image = real_data / "phr_gizeh_pair" / f"img{view}.tif"
    own = read_rpc(image)
    assert own.crop_origin == (0.0, 0.0)
    geometry = image.with_suffix(".geom").read_text().splitlines()
    numbers = dict(line.split(":", 1) for line in geometry if line)
    full_offset = np.array([float(numbers["line_off"]), float(numbers["samp_off"])])
    text = format_rpc_text(replace(own.model, image_offset=full_offset))
    (tmp_path / "full_RPC.TXT").write_text(text)
    full = read_rpc(image, tmp_path / "full_RPC.TXT")
    assert full.crop_origin == {"1": (5000.0, 20500.0), "2": (5476.0, 20501.0)}[view]
    np.testing.assert_array_equal(full.model.image_offset, own.model.image_offset)


@pytest.mark.parametrize(
    ("view", "sigma_m"), [("20", np.hypot(0.87, 0.33)), ("30", np.hypot(0.9, 0.16))]
)
def test_a_nitf_gives_its_model_its_accuracy_and_its_pixels(
    real_data: Path, view: str, sigma_m: float
) -> None:
    scene = read_scene(real_data / "wv3_ntf_crops" / f"wv3_{view}.NTF")
    assert scene.image.shape == (500, 500)
    assert scene.sigma_m == pytest.approx(sigma_m)
    assert scene_centre(scene)[:2] == pytest.approx([-58.53, -34.56], abs=0.02)
    assert 0.3 < scene_gsd_m(scene) < 0.4


def test_an_image_without_a_model_is_refused(real_data: Path, tmp_path: Path) -> None:
    image = shutil.copy(real_data / "phr_ventoux_pair" / "lowres_color_image.tif", tmp_path)
    with pytest.raises(FormatError, match="no sensor model"):
        read_scene(Path(image))


def agreement(a: Scene, b: Scene, point: Array) -> tuple[float, float]:
    """Best correlation of two scenes around a ground point, and its distance in pixels."""
    gsd_m = scene_gsd_m(a)
    chip, around = (
        render_chip(a.image, a.model, point, gsd_m, 61),
        render_chip(b.image, b.model, point, gsd_m),
    )
    if not (np.isfinite(chip).all() and np.isfinite(around).all()):
        return -1.0, np.inf
    scores = cv2.matchTemplate(around, chip, cv2.TM_CCOEFF_NORMED)
    row, col = np.unravel_index(np.argmax(scores), scores.shape)
    return float(scores[row, col]), float(np.hypot(row - 20, col - 20))


def matched(a: Scene, b: Scene) -> tuple[Array, Array]:
    """Matched positions in two images, wrong matches included."""
    sift = cv2.SIFT_create()
    seen = []
    for scene in (a, b):
        pixels = scene.image.read(Window(0, 0, *scene.image.shape))
        low, high = np.percentile(pixels, (1, 99))
        seen.append(
            sift.detectAndCompute(np.uint8(np.clip((pixels - low) / (high - low), 0, 1) * 255), None)
        )
    (keys_a, described_a), (keys_b, described_b) = seen
    pairs = cv2.BFMatcher().knnMatch(described_a, described_b, k=2)
    good = [best for best, second in pairs if best.distance < 0.7 * second.distance]
    return (
        np.array([keys_a[m.queryIdx].pt[::-1] for m in good]),
        np.array([keys_b[m.trainIdx].pt[::-1] for m in good]),
    )


@pytest.mark.parametrize(
    ("folder", "names", "epipolar_error_px", "heights_m"),
    [
        (
            "phr_gizeh_pair",
            ("img1.tif", "img2.tif"),
            0.51,
            (40.0, 220.0),
        ),  # the plateau and its pyramids
        ("phr_ventoux_pair", ("left_image.tif", "right_image.tif"), 4.77, (470.0, 580.0)),
        ("phr_iceland_pair", ("img_01.tif", "img_02.tif"), 0.26, (1460.0, 1560.0)),
    ],
)
@pytest.mark.thorough
def test_the_rays_of_a_pair_intersect_at_plausible_heights(
    real_data: Path,
    folder: str,
    names: tuple[str, str],
    epipolar_error_px: float,
    heights_m: tuple[float, float],
) -> None:
    """The rays of a match pass at the known distance of the pair, at plausible heights."""
    a, b = (read_scene(real_data / folder / name) for name in names)
    in_a, in_b = matched(a, b)
    low, high = (
        b.model.project(a.model.locate(in_a, np.full(len(in_a), height_m))) for height_m in heights_m
    )
    along = (high - low) / np.linalg.norm(high - low, axis=1, keepdims=True)
    part = ((in_b - low) * along).sum(axis=1) / np.linalg.norm(high - low, axis=1)
    apart_px = np.abs(along[:, 0] * (in_b - low)[:, 1] - along[:, 1] * (in_b - low)[:, 0])
    likely = apart_px < 10.0
    assert likely.sum() > 100
    assert np.median(apart_px[likely]) == pytest.approx(epipolar_error_px, abs=a_tenth_of_a_pixel)
    assert np.mean((part[likely] > 0.0) & (part[likely] < 1.0)) > 0.95


def test_three_images_agree_at_the_heights_of_a_surface_model(real_data: Path) -> None:
    folder = real_data / "phr_calanques_triplet"
    scenes = [read_scene(folder / f"img_{view}.tif") for view in ("01", "02", "03")]
    with rasterio.open(folder / "expected_output" / "dsm.tif") as dsm:
        height_m = dsm.read(1)
        rows, cols = np.nonzero(np.isfinite(height_m))
        chosen = np.random.default_rng(1).choice(len(rows), 60, replace=False)
        rows, cols = rows[chosen], cols[chosen]
        east, north = dsm.xy(rows, cols)
        lon, lat = transform(dsm.crs, "EPSG:4326", east, north)
    points = np.column_stack([lon, lat, height_m[rows, cols]])
    for other in (1, 2):
        seen = [agreement(scenes[0], scenes[other], point) for point in points]
        apart_px = [apart for score, apart in seen if score > 0.85]
        assert len(apart_px) > 15
        assert np.median(apart_px) < 2.0
