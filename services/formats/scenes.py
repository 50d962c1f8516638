"""Scenes: an image file, the sensor model that belongs to it, and what is known of the acquisition."""

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from services.errors import FormatError
from services.formats.dimap import parse_dimap_acquisition, parse_imaging_time
from services.formats.raster import RasterImage, open_raster
from services.formats.rpc_files import DeliveredModel, model_of_image, read_text
from services.formats.rpc_text import rpb_satellite
from services.scene import Scene, view_direction
from services.sensors.rpc import RpcModel
from services.types import Acquisition, Array

CE90_TO_SIGMA = 1.0 / math.sqrt(2.0 * math.log(10.0))
"""From CE90 to one standard deviation a coordinate, for a circular normal law: 1 / 2.1460."""

CE90_M = (
    ("PHR", 8.5),
    ("PNEO", 5.0),
    ("SPOT6", 10.0),
    ("SPOT7", 10.0),
    ("WV", 5.0),
    ("GE01", 5.0),
    ("QB02", 21.0),
)
"""Horizontal accuracy without control, by the start of the sensor's name.

Sources: Pléiades and Pléiades Neo, imagery user guides of Airbus Defence and Space (incidence to 30
degrees); SPOT 6/7, their technical sheet; WorldView and GeoEye, "better than 5 m CE90" of their
operator; QuickBird, Smiley (2009), the worst quarter of two years.
"""

UNKNOWN_SIGMA_M = 50.0
"""Accuracy of a model whose producer and sensor say nothing."""


def read_scene(
    path: Path,
    model_path: Path | None = None,
    sigma_m: float | None = None,
    band: int = 1,
    crop_origin: tuple[float, float] | None = None,
) -> Scene:
    """An image with its model; the image stays open and is read by windows.

    Args:
        path: GeoTIFF, JPEG 2000 or NITF.
        model_path, crop_origin: as of `read_rpc`.
        sigma_m: horizontal accuracy of the model, one standard deviation a coordinate; by default what
            the producer states, else what is known of the sensor, else 50 m.
        band: counted from one.

    Raises:
        FormatError: when the image or its model cannot be used.
    """
    image = open_raster(path, band)
    try:
        delivered = model_of_image(image, model_path, crop_origin)
        acquisition = _acquisition(image, delivered)
    except FormatError:
        image.close()
        raise
    if sigma_m is None:
        sigma_m = prior_sigma_m(delivered.model, acquisition.sensor)
    return Scene(image, delivered.model, acquisition, sigma_m)


def prior_sigma_m(model: RpcModel, sensor: str) -> float:
    """Horizontal accuracy of a model before registration, one standard deviation a coordinate.

    What the model states (RPC00B: bias and random error, each a standard deviation a horizontal axis),
    else the CE90 of the sensor as a circular normal law, else 50 m.
    """
    if model.error_bias_m > 0.0:
        random_m = 0.0 if math.isnan(model.error_random_m) else model.error_random_m
        return math.hypot(model.error_bias_m, random_m)
    for start, ce90_m in CE90_M:
        if sensor.startswith(start):
            return ce90_m * CE90_TO_SIGMA
    return UNKNOWN_SIGMA_M


def _acquisition(image: RasterImage, delivered: DeliveredModel) -> Acquisition:
    """What the files say of the acquisition, with the direction of view of the model."""
    image_id = image.path.stem
    told = Acquisition(image_id)
    if delivered.convention == "dimap":
        told = _dimap_acquisition(delivered.path, image_id)
    elif delivered.convention == "rpb":
        told = Acquisition(image_id, sensor=rpb_satellite(read_text(delivered.path)))
    if not told.sensor:
        tags = image.dataset.tags()
        sensor = tags.get("MISSION", "") + tags.get("MISSION_INDEX", "")
        time = parse_imaging_time(tags.get("IMAGING_DATE", ""), tags.get("IMAGING_TIME", ""))
        told = replace(told, sensor=sensor, acquired_at=time)
    incidence_deg, azimuth_deg = _central_view(delivered.model, image.shape)
    return replace(told, incidence_deg=incidence_deg, azimuth_deg=azimuth_deg)


def _dimap_acquisition(path: Path, image_id: str) -> Acquisition:
    """From the product's document when it lies beside the RPC's, else from the RPC's."""
    product = path.with_name(re.sub("^RPC_", "DIM_", path.name, flags=re.IGNORECASE))
    source = product if product.is_file() else path
    return parse_dimap_acquisition(read_text(source), image_id, source.name)


def _central_view(model: RpcModel, shape: tuple[int, int]) -> tuple[float, float]:
    centre: Array = (np.array([shape], dtype=np.float64) - 1.0) / 2.0
    ground = model.locate(centre, np.array([sum(model.height_range_m) / 2.0]))
    incidence_deg, azimuth_deg = view_direction(model, centre, ground)
    return float(incidence_deg[0]), float(azimuth_deg[0])
