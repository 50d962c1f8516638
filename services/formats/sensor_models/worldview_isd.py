"""WorldView ISD: the rigorous model of basic (1B) products of WorldView satellites."""

import math
from datetime import datetime
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from amers.services.errors import FormatError
from amers.services.formats.reader_rows import Reader, Treatment
from amers.services.formats.sensor_models.dimap import parse_imaging_time
from amers.services.formats.sensor_models.xml_values import (
    check_increasing,
    midnight_before,
    number,
    numbers,
    seconds,
    single,
    whole_number,
)
from amers.services.formats.text_files import parse_number, parse_xml
from amers.services.sensors.attitude import interpolated_attitude
from amers.services.sensors.light_path import LightPath
from amers.services.sensors.piecewise import extended, lagrange, linear, polynomial
from amers.services.sensors.pushbroom import (
    MAX_SIZE,
    TERRAIN_M,
    PushbroomModel,
    check_pushbroom,
    used_times,
)
from amers.services.statements import Subject
from amers.services.types import Acquisition, Array

READER = Reader(
    "XML of WorldView products (ISD)",
    ("parse_worldview_isd", "parse_isd_acquisition"),
    (
        Treatment(
            Subject.MODEL,
            "used",
            "The block RPB states the RPC. Without this block, Amers fits an RPC to orbit and attitude.",
        ),
        Treatment(Subject.MODEL, "refused", "A value is missing or impossible."),
        Treatment(
            Subject.PLACE,
            "used",
            "The `.TIL` file of the product states the position of a tile in its image.",
        ),
        Treatment(
            Subject.PLACE,
            "assumed",
            "The image has another size than NUMROWS x NUMCOLUMNS: Amers assumes that "
            "both begin at the same first pixel.",
        ),
        Treatment(Subject.ORDER, "refused", "SPECID is not RPC00B."),
        Treatment(Subject.ACCURACY, "used", "ERRBIAS and ERRRAND are positive numbers, in metres."),
        Treatment(
            Subject.ACCURACY,
            "assumed",
            "ERRBIAS and ERRRAND are zero: Amers uses the accuracy of the sensor.",
        ),
        Treatment(
            Subject.IDENTITY, "used", "SATID, FIRSTLINETIME and the sun angles describe the acquisition."
        ),
    ),
    never=(
        Subject.PIXEL_ORIGIN,
        Subject.HORIZONTAL_DATUM,
        Subject.VERTICAL_DATUM,
        Subject.UNIT,
        Subject.EPOCH,
        Subject.VALIDITY,
        Subject.BANDS,
    ),
)

_LIGHT_PATH = LightPath(velocity_aberration=True, light_time=True, refraction=True)


def parse_worldview_isd(
    text: str, source: str = "ISD", light_path: LightPath = _LIGHT_PATH
) -> PushbroomModel:
    """The rigorous model of the XML of a basic WorldView product.

    The attitude is that of the camera at the time of a line, without aberration, light time and
    refraction: the RPC of the product contains these effects.

    Args:
        text: contents of the file.
        source: its name, for messages.
        light_path: the effects that the model applies.

    Raises:
        FormatError: it is not such a document, or a value is missing, impossible or not supported.
    """
    root = parse_xml(text, source)
    if root.tag != "isd":
        raise FormatError(f"{source}: expected <isd>, found <{root.tag[:60]}>")
    image = single(root, "IMD/IMAGE", source)
    start = single(image, "TLCTIME", source)
    midnight = midnight_before(start, source)
    shape = (
        whole_number(root, "IMD/NUMROWS", source, (1, MAX_SIZE)),
        whole_number(root, "IMD/NUMCOLUMNS", source, (1, MAX_SIZE)),
    )
    lines = np.array([numbers(entry, source, 2) for entry in image.iter("TLCLIST")])
    check_increasing(lines[:, 0] if len(lines) else np.empty(0), "lines of TLCLIST", 2, source)

    orbit, attitude = (single(root, part, source) for part in ("EPH", "ATT"))
    orbit_s, position = _table(orbit, "EPHEMLIST", slice(1, 4), midnight, source)
    attitude_s, quaternions = _table(attitude, "ATTLIST", slice(1, 5), midnight, source)
    if not (np.linalg.norm(quaternions, axis=1) > 0.5).all():
        raise FormatError(f"{source}: ATTLIST: a quaternion is not of unit length")
    geometry = single(root, "GEO", source)
    turned = Rotation.from_quat(interpolated_attitude(attitude_s, quaternions)(orbit_s))
    centre = [number(geometry, f"PERSPECTIVE_CENTER/{key}", source) for key in ("CX", "CY", "CZ")]
    position = position + turned.apply(centre)
    camera = [number(geometry, f"CAMERA_ATTITUDE/QCS{k}", source, (-1.0, 1.0)) for k in (1, 2, 3, 4)]
    quaternions = (Rotation.from_quat(quaternions) * Rotation.from_quat(camera)).as_quat()
    tlc_s = seconds(start, midnight, source)
    line_time = linear(lines[:, 0], tlc_s + lines[:, 1:])
    used = used_times(line_time, shape[0])
    model = PushbroomModel(
        image_shape=shape,
        line_time=line_time,
        orbit=extended(lagrange(orbit_s, position), used, 2),
        attitude=extended(interpolated_attitude(attitude_s, quaternions), used, 1),
        look=polynomial(0.0, 1.0, _look(geometry, source)),
        height_range_m=TERRAIN_M,
        light_path=light_path,
    )
    return check_pushbroom(model, source)


def parse_isd_acquisition(text: str, image_id: str, source: str = "ISD") -> Acquisition:
    """Sensor, time and sun of an image from the XML of a WorldView product.

    Args:
        text: contents of the file.
        image_id: name of the image.
        source: name of the file, for messages.

    Raises:
        FormatError: it is not an XML document.
    """
    root = parse_xml(text, source)

    def angle(name: str) -> float:
        try:
            return parse_number(root.findtext(f".//{name}", ""), name, source)
        except FormatError:
            return math.nan

    date, _, time = root.findtext(".//FIRSTLINETIME", "").strip().partition("T")
    return Acquisition(
        image_id,
        (root.findtext(".//SATID") or "").strip(),
        parse_imaging_time(date, time),
        sun_elevation_deg=angle("MEANSUNEL"),
        sun_azimuth_deg=angle("MEANSUNAZ"),
    )


def _table(
    parent: ElementTree.Element, entry: str, columns: slice, midnight: datetime, source: str
) -> tuple[Array, Array]:
    """Times and columns of the table of a part of the document, evenly spaced in time."""
    last = columns.stop
    rows = [numbers(row, source) for row in parent.iter(entry)]
    count = whole_number(parent, "NUMPOINTS", source, (8, 1_000_000))
    if len(rows) != count or any(len(row) < last for row in rows):
        raise FormatError(
            f"{source}: {parent.tag}: {len(rows)} {entry} found, "
            f"{count} of at least {last} numbers expected"
        )
    first_s = seconds(single(parent, "STARTTIME", source), midnight, source)
    step_s = number(parent, "TIMEINTERVAL", source, (1e-6, 1e3))
    values = np.array([row[columns] for row in rows], dtype=np.float64)
    return first_s + step_s * np.arange(count, dtype=np.float64), values


def _look(geometry: ElementTree.Element, source: str) -> Array:
    """Tangents along and across (2, 2), constant and change per sample, of the row of detectors."""
    order = number(geometry, "OPTICAL_DISTORTION/POLYORDER", source)
    if order >= 0:
        raise FormatError(
            f"{source}: OPTICAL_DISTORTION/POLYORDER: {order:g} found, only -1 (none) is supported"
        )
    focal_mm = number(geometry, "PRINCIPAL_DISTANCE/PD", source, (1.0, 1e6))
    detectors = single(geometry, "DETECTOR_MOUNTING//DETECTOR_ARRAY", source)
    x_mm = number(detectors, "DETORIGINX", source)
    y_mm = number(detectors, "DETORIGINY", source)
    pitch_mm = number(detectors, "DETPITCH", source, (1e-6, 10.0))
    angle = np.radians(number(detectors, "DETROTANGLE", source, (-360.0, 360.0)))
    return np.array([[x_mm, pitch_mm * np.sin(angle)], [y_mm, -pitch_mm * np.cos(angle)]]) / focal_mm
