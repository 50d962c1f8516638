"""Rigorous models of real products beside what their producers or other tools computed."""

from dataclasses import dataclass, replace
from datetime import datetime, time
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import rasterio

from amers.services.formats.sensor_models.dimap_rigorous import parse_dimap_rigorous
from amers.services.formats.sensor_models.phr_dimap import parse_phr_dimap
from amers.services.formats.sensor_models.rpc_text import parse_rpc_text
from amers.services.formats.sensor_models.spot_dimap import parse_spot_dimap
from amers.services.formats.sensor_models.worldview_isd import parse_worldview_isd
from amers.services.formats.text_files import read_text
from amers.services.sensors.attitude import orbital_attitude
from amers.services.sensors.base import SensorModel
from amers.services.sensors.light_path import GEOMETRIC, LightPath
from amers.services.sensors.piecewise import PiecewisePolynomial, lagrange, linear
from amers.services.sensors.pushbroom import PushbroomModel
from amers.services.sensors.rpc import RpcModel
from amers.services.types import Array

METADATA = "rigorous_metadata"
"""The folder of the metadata in the folder of real data."""

WORLDVIEW = ["WV1.XML", "WV2.XML", "WV3.XML"]
WORLDVIEW += ["wv_mvp_1.xml", "wv_mvp_2.xml", "wv_test1.xml", "wv_test2.xml"]
SPOT = ["SPOT1.DIM", "SPOT2.DIM", "SP-2.DIM", "SP2_METADATA.DIM", "SP2_20010409_METADATA.DIM"]
SPOT += ["SPOT3.DIM", "SPOT4.DIM", "SPOT5.DIM"]
PLEIADES = ["P1BP--2017030824934340CP", "P1BP--2018122638935449CP"]
ALL_EFFECTS = LightPath(velocity_aberration=True, light_time=True, refraction=True)
LIGHT_PATHS = {
    "no effect": GEOMETRIC,
    "aberration": LightPath(velocity_aberration=True),
    "aberration, light time": LightPath(velocity_aberration=True, light_time=True),
    "aberration, light time, refraction": ALL_EFFECTS,
}


@dataclass(frozen=True)
class Comparison:
    """A model and its differences from an oracle.

    Attributes:
        product, oracle: what is compared.
        model: the rigorous model.
        difference_px: (n, 2) lines and samples, always in the same sense for one kind of oracle.
    """

    product: str
    oracle: str
    model: PushbroomModel
    difference_px: Array


def pleiades_grid(folder: Path) -> Comparison:
    """Pléiades and the direct location grid of CNES, nine heights from -30 to 4,900 m."""
    name = PLEIADES[1]
    model = parse_phr_dimap(read_text(folder / f"pleiades_dimap/PHRDIMAP_{name}.XML"), name)
    with rasterio.open(folder / f"pleiades_dimap/loc_grids_ellipsoide/{name}/GRID_{name}.tif") as grid:
        bands, step, tags = grid.read(), grid.transform, grid.tags()
    sample, line = np.meshgrid(np.arange(bands.shape[2]) * step.a, np.arange(bands.shape[1]) * step.e)
    image = np.column_stack([line.ravel(), sample.ravel()])
    differences = []
    for k in range(0, len(bands), 2):
        height = np.full(len(image), float(tags[f"ALTITUDE_B{k}"]))
        ground = np.column_stack([bands[k].ravel(), bands[k + 1].ravel(), height])
        differences.append(model.project(ground) - image)
    return Comparison(name, "location grid of CNES", model, np.concatenate(differences))


def pleiades_rpc(folder: Path, name: str) -> Comparison:
    """Pléiades and the rational functions in the same document."""
    text = read_text(folder / f"pleiades_dimap/PHRDIMAP_{name}.XML")
    model, root = parse_phr_dimap(text, name), ElementTree.fromstring(text)
    (inverse,) = root.findall(".//Inverse_Model")
    (validity,) = root.findall(".//RFM_Validity")

    def norm(part: str, *keys: str) -> Array:
        return np.array([float(validity.findtext(f"{key}/{part}", "")) for key in keys])

    column, row = (_numbers(inverse, key) for key in ("F_COL", "F_ROW"))
    rpc = RpcModel(
        row[:20],
        row[20:],
        column[:20],
        column[20:],
        norm("B", "Row", "Col") - 1.0,
        norm("A", "Row", "Col"),
        norm("B", "Lon", "Lat", "Alt"),
        norm("A", "Lon", "Lat", "Alt"),
    )
    return Comparison(name, "its rational functions", model, _from_rpc(model, rpc, 0.9))


def worldview(folder: Path, name: str, light_path: LightPath = ALL_EFFECTS) -> Comparison:
    """WorldView and the RPC of the vendor in the same document."""
    model = parse_worldview_isd(read_text(folder / "worldview_isd" / name), name, light_path)
    rpc = worldview_rpc(folder, name)
    return Comparison(name, "RPC of the vendor", model, _from_rpc(model, rpc, 0.9))


def worldview_rpc(folder: Path, name: str) -> RpcModel:
    """The RPC of the vendor in a WorldView document."""
    text = read_text(folder / "worldview_isd" / name)
    (image,) = ElementTree.fromstring(text).findall("RPB/IMAGE")
    return RpcModel(
        *(
            _numbers(image, f"{key}COEFList/{key}COEF")
            for key in ("LINENUM", "LINEDEN", "SAMPNUM", "SAMPDEN")
        ),
        _numbers(image, "LINEOFFSET", "SAMPOFFSET"),
        _numbers(image, "LINESCALE", "SAMPSCALE"),
        _numbers(image, "LONGOFFSET", "LATOFFSET", "HEIGHTOFFSET"),
        _numbers(image, "LONGSCALE", "LATSCALE", "HEIGHTSCALE"),
    )


def spot_corners(folder: Path, name: str) -> Comparison:
    """SPOT 1 to 5 and the frame corners and centre of the document, on the ellipsoid."""
    text = read_text(folder / "spot1-5_dimap" / name)
    model = parse_spot_dimap(text, name)
    return Comparison(name, "frame corners", model, _from_corners(model, _corners(text, "FRAME_"), 0.0))


def spot_corners_without_attitude(folder: Path, name: str) -> Comparison:
    """SPOT 1 to 4 without yaw, pitch and roll, and the frame corners and centre of the document."""
    text = read_text(folder / "spot1-5_dimap" / name)
    model = parse_spot_dimap(text, name)
    model = replace(model, attitude=_without_angles(model, text))
    difference_px = _from_corners(model, _corners(text, "FRAME_"), 0.0)
    return Comparison(name, "frame corners, attitude left out", model, difference_px)


def spot_2_rpc(folder: Path) -> Comparison:
    """SPOT 2 and an RPC that COSI-Corr fitted to the same metadata; it counts pixels from (1, 1)."""
    name = "SP2_METADATA.DIM"
    model = parse_spot_dimap(read_text(folder / "spot1-5_dimap" / name), name)
    rpc = parse_rpc_text(read_text(folder / "spot1-5_dimap" / "SP2_RPC.txt"), "SP2_RPC.txt")
    return Comparison(name, "RPC of COSI-Corr", model, _from_rpc(model, rpc, 0.75) - 1.0)


def spot_6_corners(folder: Path) -> Comparison:
    """SPOT 6 and its frame corners and centre, at the height that suits them best: none is stated."""
    text = read_text(folder / "spot6_dimapv2" / "SPOT6.XML")
    model = parse_dimap_rigorous(text, "SPOT6.XML")
    corners = _corners(text, "")
    tried = [_from_corners(model, corners, height_m) for height_m in np.arange(800.0, 900.0, 0.1)]
    best = min(tried, key=lambda difference_px: float(np.abs(difference_px).max()))
    return Comparison("SPOT6.XML", "frame corners, one height fitted", model, best)


def _numbers(parent: ElementTree.Element, *paths: str) -> Array:
    return np.array([float(word) for path in paths for word in parent.findtext(path, "").split()])


def _from_rpc(model: PushbroomModel, rpc: RpcModel, share: float) -> Array:
    """Positions by an RPC minus those by a model, over the image and a share of the RPC's heights."""
    shape = model.image_shape
    line, sample, height = (
        axis.ravel()
        for axis in np.meshgrid(
            np.linspace(0.0, shape[0] - 1.0, 15),
            np.linspace(0.0, shape[1] - 1.0, 15),
            rpc.ground_offset[2] + share * np.linspace(-1.0, 1.0, 5) * rpc.ground_scale[2],
        )
    )
    image = np.column_stack([line, sample])
    return np.asarray(rpc.project(model.locate(image, height)) - image)


def _corners(text: str, prefix: str) -> Array:
    """Longitude, latitude, row, column (n, 4) of corners and centre in a DIMAP document."""
    root = ElementTree.fromstring(text)
    frame = root.find("Dataset_Frame")
    corners = root.find("Dataset_Content/Dataset_Extent") if frame is None else frame
    assert corners is not None
    points = [point for point in corners if point.tag in ("Vertex", "Scene_Center", "Center")]
    keys = ("LON", "LAT", "ROW", "COL")
    return np.array([[float(point.findtext(prefix + key, "")) for key in keys] for point in points])


def _from_corners(model: SensorModel, corners: Array, height_m: float) -> Array:
    ground = np.column_stack([corners[:, :2], np.full(len(corners), height_m)])
    return model.project(ground) - (corners[:, 2:] - 1.0)


def _without_angles(model: PushbroomModel, text: str) -> PiecewisePolynomial:
    """The attitude of a SPOT satellite whose yaw, pitch and roll are zero."""
    points = ElementTree.fromstring(text).findall("Data_Strip/Ephemeris/Points/Point")
    stamps = [datetime.fromisoformat(point.findtext("TIME", "").strip()) for point in points]
    midnight = datetime.combine(stamps[0].date(), time())
    velocity = lagrange(
        np.array([(stamp - midnight).total_seconds() for stamp in stamps]),
        np.array([_numbers(point, *(f"Velocity/{axis}" for axis in "XYZ")) for point in points]),
    )
    zero = linear(model.attitude.breaks[[0, -1]], np.zeros((2, 3)))
    return orbital_attitude(model.orbit, velocity, zero)
