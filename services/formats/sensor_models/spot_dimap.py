"""DIMAP version 1: the rigorous model of SPOT 1 to 5 scenes of level 1A."""

from datetime import datetime
from xml.etree import ElementTree

import numpy as np

from amers.services.errors import FormatError
from amers.services.formats.sensor_models.xml_values import (
    check_increasing,
    midnight_before,
    number,
    seconds,
    single,
    whole_number,
)
from amers.services.formats.text_files import parse_xml
from amers.services.sensors.attitude import integrated_rates, orbital_attitude
from amers.services.sensors.piecewise import (
    PiecewisePolynomial,
    extended,
    from_function,
    lagrange,
    linear,
    polynomial,
)
from amers.services.sensors.pushbroom import (
    MAX_SIZE,
    TERRAIN_M,
    PushbroomModel,
    check_pushbroom,
    used_times,
)
from amers.services.types import Array

_ANGLES = ("YAW", "PITCH", "ROLL")
_TABLE_FROM = 100
"""Detectors from which look angles are a table with straight lines, and not two ends of a row."""


def parse_spot_dimap(text: str, source: str = "DIMAP") -> PushbroomModel:
    """The rigorous model of a DIMAP document of SPOT 1 to 5, for its first band.

    Look angles are those of the scene's mirror step. The attitude is relative to the orbit: corrected by
    the star tracker where the product has it (SPOT 5), otherwise from the first measured angles and the
    measured rates. The frame corners of SPOT 1 to 4 in the document are those without attitude.

    Source: SPOT Satellite Geometry Handbook (S-NT-73-12-SI, 2002).

    Args:
        text: contents of the file.
        source: its name, for messages.

    Raises:
        FormatError: it is not such a document, or a value is missing, impossible or not supported.
    """
    root = parse_xml(text, source)
    declared = root.find("Metadata_Id/METADATA_FORMAT")
    version = "" if declared is None else declared.get("version", "")
    if root.tag != "Dimap_Document" or not version.startswith("1."):
        raise FormatError(
            f"{source}: expected a DIMAP document of version 1, found <{root.tag[:60]}> of version "
            f"{version[:20] or 'unknown'}"
        )
    level = (single(root, "Data_Processing/PROCESSING_LEVEL", source).text or "").strip()
    if level != "1A":
        raise FormatError(
            f"{source}: PROCESSING_LEVEL: {level[:20]!r} found, '1A' expected: the rigorous model is "
            "that of images before resampling"
        )
    shape = (
        whole_number(root, "Raster_Dimensions/NROWS", source, (1, MAX_SIZE)),
        whole_number(root, "Raster_Dimensions/NCOLS", source, (1, MAX_SIZE)),
    )
    strip = single(root, "Data_Strip", source)
    stamp = single(strip, "Sensor_Configuration/Time_Stamp", source)
    centre = single(stamp, "SCENE_CENTER_TIME", source)
    midnight = midnight_before(centre, source)
    centre_s = seconds(centre, midnight, source)
    centre_line = number(stamp, "SCENE_CENTER_LINE", source, (-MAX_SIZE, MAX_SIZE)) - 1.0
    period_s = number(stamp, "LINE_PERIOD", source, (1e-6, 0.1))
    points = strip.findall("Ephemeris/Points/Point")
    orbit_s = check_increasing(_times(points, "TIME", midnight, source), "Ephemeris", 8, source)
    position, velocity = (
        lagrange(orbit_s, np.array([_vector(point, name, source) for point in points]))
        for name in ("Location", "Velocity")
    )
    line_time = polynomial(centre_line, 1.0, np.array([[centre_s, period_s]]))
    used = used_times(line_time, shape[0])
    angles = _angles(single(strip, "Satellite_Attitudes", source), midnight, source)
    model = PushbroomModel(
        image_shape=shape,
        line_time=line_time,
        orbit=extended(position, used, 2),
        attitude=orbital_attitude(position, velocity, extended(angles, used, 1)),
        look=_look(strip, shape[1], source),
        height_range_m=TERRAIN_M,
    )
    return check_pushbroom(model, source)


def _times(entries: list[ElementTree.Element], name: str, midnight: datetime, source: str) -> Array:
    """Times (n,) of entries, seconds after a midnight."""
    return np.array([seconds(single(entry, name, source), midnight, source) for entry in entries])


def _vector(point: ElementTree.Element, name: str, source: str) -> list[float]:
    return [number(point, f"{name}/{axis}", source) for axis in "XYZ"]


def _angles(attitudes: ElementTree.Element, midnight: datetime, source: str) -> PiecewisePolynomial:
    """Yaw, pitch, roll in radians, of the seconds."""

    def table(path: str, needed: int) -> tuple[Array, Array]:
        """Times (n,) and values (n, 3) of the entries that are not marked as out of range."""
        entries = [
            entry
            for entry in attitudes.findall(path)
            if entry.findtext("OUT_OF_RANGE", "N").strip() != "Y"
        ]
        times = check_increasing(_times(entries, "TIME", midnight, source), path, needed, source)
        values = [[number(entry, name, source) for name in _ANGLES] for entry in entries]
        return times, np.array(values)

    if attitudes.findtext("Corrected_Attitudes/STAR_TRACKER_USED", "N").strip() == "Y":
        return linear(*table("Corrected_Attitudes/Corrected_Attitude/Angles", 2))
    raw = "Raw_Attitudes/Aocs_Attitude"
    known_s, known = table(f"{raw}/Angles_List/Angles", 1)
    rates_s, rates = table(f"{raw}/Angular_Speeds_List/Angular_Speeds", 2)
    return integrated_rates(rates_s, rates, (float(known_s[0]), known[0]))


def _look(strip: ElementTree.Element, columns: int, source: str) -> PiecewisePolynomial:
    """Tangents along and across of the detectors of the first band, of the sample."""
    bands = strip.findall("Sensor_Configuration/Instrument_Look_Angles_List/Instrument_Look_Angles")
    if not bands:
        raise FormatError(f"{source}: no Instrument_Look_Angles found, those of a band expected")
    entries = bands[0].findall("Look_Angles_List/Look_Angles")
    ids = np.array([number(entry, "DETECTOR_ID", source) for entry in entries])
    check_increasing(ids, "DETECTOR_ID", 2, source)
    if ids[0] != 1 or ids[-1] != columns:
        raise FormatError(
            f"{source}: look angles of detectors {ids[0]:g} to {ids[-1]:g} found, those of the "
            f"{columns} columns expected"
        )
    psi = linear(
        ids - 1.0,
        np.array(
            [
                [number(entry, name, source, (-1.5, 1.5)) for name in ("PSI_X", "PSI_Y")]
                for entry in entries
            ]
        ),
    )

    def tangents(sample: Array) -> Array:
        return np.tan(psi(sample)) * np.array([1.0, -1.0])

    return from_function(psi.breaks, tangents, 1 if len(ids) > _TABLE_FROM else 7)
