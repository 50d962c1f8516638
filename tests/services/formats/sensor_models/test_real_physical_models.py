"""Physical models of real products against what their producers computed."""

from dataclasses import replace
from datetime import datetime, time
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import rasterio

from services.formats.sensor_models.dimap_physical import parse_dimap_physical
from services.formats.sensor_models.phr_dimap import parse_phr_dimap
from services.formats.sensor_models.rpc_text import parse_rpc_text
from services.formats.sensor_models.spot_dimap import parse_spot_dimap
from services.formats.sensor_models.worldview_isd import parse_worldview_isd
from services.formats.text_files import read_text
from services.sensors.attitude import orbital_attitude
from services.sensors.base import SensorModel
from services.sensors.piecewise import PiecewisePolynomial, lagrange, linear
from services.sensors.pushbroom import PushbroomModel
from services.sensors.rpc import RpcModel

pytestmark = pytest.mark.real_data

a_hundredth_of_a_pixel = 0.01


def grid_of_image(shape: tuple[int, int], heights_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, 2) over an image, at each of the heights (n,)."""
    line, sample, height = np.meshgrid(
        np.linspace(0.0, shape[0] - 1.0, 15), np.linspace(0.0, shape[1] - 1.0, 15), heights_m
    )
    return np.column_stack([line.ravel(), sample.ravel()]), height.ravel()


def worldview_rpc(text: str) -> RpcModel:
    """The RPC of the vendor within an ISD document."""
    (image,) = ElementTree.fromstring(text).findall("RPB/IMAGE")

    def values(*names: str) -> np.ndarray:
        return np.array([float(word) for name in names for word in image.findtext(name, "").split()])

    return RpcModel(
        *(values(f"{name}COEFList/{name}COEF") for name in ("LINENUM", "LINEDEN", "SAMPNUM", "SAMPDEN")),
        values("LINEOFFSET", "SAMPOFFSET"),
        values("LINESCALE", "SAMPSCALE"),
        values("LONGOFFSET", "LATOFFSET", "HEIGHTOFFSET"),
        values("LONGSCALE", "LATSCALE", "HEIGHTSCALE"),
    )


def image_difference(model: SensorModel, other: SensorModel, shape, heights_m) -> np.ndarray:
    """Differences (n, 2) in the image of another model from a model, over image and heights."""
    image, height = grid_of_image(shape, heights_m)
    return other.project(model.locate(image, height)) - image


def test_pleiades_agrees_with_the_location_grid_of_cnes(real_data: Path) -> None:
    folder = real_data / "rigorous_metadata" / "pleiades_dimap"
    name = "P1BP--2018122638935449CP"
    model = parse_phr_dimap(read_text(folder / f"PHRDIMAP_{name}.XML"), name)
    with rasterio.open(folder / "loc_grids_ellipsoide" / name / f"GRID_{name}.tif") as grid:
        bands, step, tags = grid.read(), grid.transform, grid.tags()
    sample, line = np.meshgrid(np.arange(bands.shape[2]) * step.a, np.arange(bands.shape[1]) * step.e)
    image = np.column_stack([line.ravel(), sample.ravel()])
    for k in range(0, len(bands), 2):
        height = np.full(len(image), float(tags[f"ALTITUDE_B{k}"]))
        ground = np.column_stack([bands[k].ravel(), bands[k + 1].ravel(), height])
        np.testing.assert_allclose(model.project(ground), image, atol=a_hundredth_of_a_pixel)


@pytest.mark.parametrize(
    "name",
    ["WV1.XML", "WV2.XML", "WV3.XML", "wv_mvp_1.xml", "wv_mvp_2.xml", "wv_test1.xml", "wv_test2.xml"],
)
def test_worldview_agrees_with_the_rpc_of_the_vendor(real_data: Path, name: str) -> None:
    text = read_text(real_data / "rigorous_metadata" / "worldview_isd" / name)
    model, rpc = parse_worldview_isd(text, name), worldview_rpc(text)
    heights_m = rpc.ground_offset[2] + np.linspace(-0.9, 0.9, 5) * rpc.ground_scale[2]
    difference = image_difference(model, rpc, model.image_shape, heights_m)
    assert np.abs(difference.mean(axis=0)).max() < 0.1
    assert difference.std(axis=0).max() < 0.4


def frame_corners(text: str, names: str) -> np.ndarray:
    """Longitude, latitude, row, column (n, 4) of corners and centre in a DIMAP document."""
    root = ElementTree.fromstring(text)
    frame = root.find("Dataset_Frame")
    corners = root.find("Dataset_Content/Dataset_Extent") if frame is None else frame
    assert corners is not None
    points = corners.findall("Vertex") + corners.findall("Scene_Center") + corners.findall("Center")
    return np.array(
        [
            [float(point.findtext(f"{names}{key}", "")) for key in ("LON", "LAT", "ROW", "COL")]
            for point in points
        ]
    )


def test_pleiades_agrees_with_the_rpc_of_its_own_document(real_data: Path) -> None:
    name = "PHRDIMAP_P1BP--2017030824934340CP.XML"
    text = read_text(real_data / "rigorous_metadata" / "pleiades_dimap" / name)
    model = parse_phr_dimap(text, name)
    (inverse,) = ElementTree.fromstring(text).findall(".//Inverse_Model")
    (validity,) = ElementTree.fromstring(text).findall(".//RFM_Validity")
    half = {key: float(validity.findtext(f"{key}/A", "")) for key in ("Lon", "Lat", "Alt", "Col", "Row")}
    middle = {key: float(validity.findtext(f"{key}/B", "")) for key in half}
    column, row = (
        np.array([float(word) for word in inverse.findtext(key, "").split()])
        for key in ("F_COL", "F_ROW")
    )
    rpc = RpcModel(
        row[:20],
        row[20:],
        column[:20],
        column[20:],
        np.array([middle["Row"] - 1.0, middle["Col"] - 1.0]),
        np.array([half["Row"], half["Col"]]),
        np.array([middle[key] for key in ("Lon", "Lat", "Alt")]),
        np.array([half[key] for key in ("Lon", "Lat", "Alt")]),
    )
    heights_m = middle["Alt"] + half["Alt"] * np.linspace(-0.9, 0.9, 3)
    difference = image_difference(model, rpc, model.image_shape, heights_m)
    assert np.abs(difference.mean(axis=0)).max() < 0.05
    assert difference.std(axis=0).max() < 0.05


@pytest.mark.parametrize(
    ("name", "limit_px"),
    [
        ("SPOT5.DIM", 0.02),
        ("SPOT1.DIM", 1.0),
        ("SPOT2.DIM", 1.0),
        ("SP-2.DIM", 1.0),
        ("SP2_METADATA.DIM", 1.0),
        ("SP2_20010409_METADATA.DIM", 1.0),
        ("SPOT3.DIM", 2.5),
        ("SPOT4.DIM", 2.5),
    ],
)
def test_spot_agrees_with_its_frame_corners_up_to_the_attitude_they_leave_out(
    real_data: Path, name: str, limit_px: float
) -> None:
    text = read_text(real_data / "rigorous_metadata" / "spot1-5_dimap" / name)
    model, corners = parse_spot_dimap(text, name), frame_corners(text, "FRAME_")
    ellipsoid = np.zeros((len(corners), 1))
    differences = model.project(np.hstack([corners[:, :2], ellipsoid])) - (corners[:, 2:] - 1.0)
    assert np.abs(differences).max() < limit_px
    level = replace(model, attitude=without_angles(model, text))
    differences = level.project(np.hstack([corners[:, :2], ellipsoid])) - (corners[:, 2:] - 1.0)
    if name != "SPOT5.DIM":
        assert np.abs(differences).max() < 0.3


def without_angles(model: PushbroomModel, text: str) -> PiecewisePolynomial:
    """The attitude of a SPOT satellite whose yaw, pitch and roll are zero."""
    root = ElementTree.fromstring(text)
    times = model.attitude.breaks
    points = root.findall("Data_Strip/Ephemeris/Points/Point")
    stamps = [datetime.fromisoformat(point.findtext("TIME", "").strip()) for point in points]
    midnight = datetime.combine(stamps[0].date(), time())
    velocity = lagrange(
        np.array([(stamp - midnight).total_seconds() for stamp in stamps]),
        np.array(
            [[float(point.findtext(f"Velocity/{axis}", "")) for axis in "XYZ"] for point in points]
        ),
    )
    zero = linear(times[[0, -1]], np.zeros((2, 3)))
    return orbital_attitude(model.orbit, velocity, zero)


def test_spot_2_agrees_with_the_rpc_that_another_tool_fitted_to_the_same_metadata(
    real_data: Path,
) -> None:
    folder = real_data / "rigorous_metadata" / "spot1-5_dimap"
    model = parse_spot_dimap(read_text(folder / "SP2_METADATA.DIM"), "SP2_METADATA.DIM")
    rpc = parse_rpc_text(read_text(folder / "SP2_RPC.txt"), "SP2_RPC.txt")
    image, height = grid_of_image(
        model.image_shape, rpc.ground_offset[2] + np.linspace(-1000.0, 1300.0, 5)
    )
    difference = rpc.project(model.locate(image, height)) - 1.0 - image
    assert np.abs(difference.mean(axis=0)).max() < 0.5
    assert difference.std(axis=0).max() < 0.5


def test_spot_6_has_its_frame_corners_at_one_height(real_data: Path) -> None:
    """The document has no heights: one height must suit five positions, in two coordinates each."""
    text = read_text(real_data / "rigorous_metadata" / "spot6_dimapv2" / "SPOT6.XML")
    model, corners = parse_dimap_physical(text, "SPOT6.XML"), frame_corners(text, "")
    heights_m = np.arange(800.0, 900.0, 0.1)
    largest_px = [
        np.abs(
            model.project(np.hstack([corners[:, :2], np.full((len(corners), 1), height_m)]))
            - (corners[:, 2:] - 1.0)
        ).max()
        for height_m in heights_m
    ]
    assert min(largest_px) < 0.05
