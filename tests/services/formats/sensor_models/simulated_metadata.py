"""Metadata of products written from a simulated satellite, whose true model the readers must find."""

from dataclasses import replace
from datetime import datetime, timedelta

import numpy as np
from scipy.spatial.transform import Rotation

from amers.services.sensors.light_path import GEOMETRIC, LightPath
from amers.services.sensors.pushbroom import PushbroomModel
from amers.services.simulation.orbit import pushbroom_over

SHAPE = (4000, 3000)
_MIDDLE = datetime(2021, 6, 3, 10, 20, 30, 250000)


def truth(light_path: LightPath = GEOMETRIC, incidence_deg: float = 18.0) -> PushbroomModel:
    """The model of a satellite over the Alps; its time zero is the middle of the image."""
    target = np.array([7.0, 45.9, 1500.0])
    model = pushbroom_over(target, SHAPE, 0.7, (incidence_deg, 100.0), (0.0, 4000.0))
    return replace(model, light_path=light_path)


def utc(time_s: float) -> str:
    """A time of the model as text, to a tenth of a microsecond."""
    ticks = round(time_s * 1e7)
    whole = _MIDDLE + timedelta(microseconds=ticks // 10)
    return whole.strftime("%Y-%m-%dT%H:%M:%S.%f") + str(ticks % 10) + "Z"


def row(values: np.ndarray) -> str:
    """Numbers with all their digits, separated by blanks."""
    return " ".join(repr(float(value)) for value in np.ravel(values))


def line_time_s(model: PushbroomModel, line: float) -> float:
    """The time of a line of the model, seconds after the middle of the image."""
    return float(model.line_time(np.array([line]))[0, 0])


def worldview_isd(model: PushbroomModel) -> str:
    """An ISD document with orbit and attitude at 50 Hz."""
    focal_mm = 13246.0
    step_s, count = 0.02, 101
    first_s = -step_s * (count // 2)
    times = first_s + step_s * np.arange(count)
    position, velocity = model.orbit(times), model.orbit.derivative(times)
    quaternions = model.attitude(times)
    quaternions[::3] *= -1.0
    ephemeris = "".join(
        f"<EPHEMLIST>{row([i + 1])} {row(p)} {row(v)} 0 0 0 0 0 0</EPHEMLIST>\n"
        for i, (p, v) in enumerate(zip(position, velocity, strict=True))
    )
    attitude = "".join(
        f"<ATTLIST>{row([i + 1])} {row(q)} 0 0 0</ATTLIST>\n" for i, q in enumerate(quaternions)
    )
    origin_mm = model.look(np.zeros(1))[0] * focal_mm
    pitch_mm = -model.look.derivative(np.zeros(1))[0, 1] * focal_mm
    start_s = line_time_s(model, 0.0)
    last_s = line_time_s(model, SHAPE[0] / 2.0) - start_s
    table = f"<STARTTIME>{utc(first_s)}</STARTTIME><NUMPOINTS>{count}</NUMPOINTS>"
    table += f"<TIMEINTERVAL>{step_s}</TIMEINTERVAL>"
    return f"""<?xml version="1.0" encoding="utf-8"?>
<isd><IMD><NUMROWS>{SHAPE[0]}</NUMROWS><NUMCOLUMNS>{SHAPE[1]}</NUMCOLUMNS><IMAGE>
<SATID>WV02</SATID><TLCTIME>{utc(start_s)}</TLCTIME><TLCLISTList>
<TLCLIST>0.0 0.0</TLCLIST><TLCLIST>{SHAPE[0] / 2.0!r} {last_s!r}</TLCLIST></TLCLISTList></IMAGE></IMD>
<EPH>{table}<EPHEMLISTList>{ephemeris}</EPHEMLISTList></EPH>
<ATT>{table}<ATTLISTList>{attitude}</ATTLISTList></ATT>
<GEO><PRINCIPAL_DISTANCE><PD>{focal_mm}</PD></PRINCIPAL_DISTANCE>
<OPTICAL_DISTORTION><POLYORDER>-1</POLYORDER></OPTICAL_DISTORTION>
<PERSPECTIVE_CENTER><CX>0</CX><CY>0</CY><CZ>0</CZ></PERSPECTIVE_CENTER>
<CAMERA_ATTITUDE><QCS1>0</QCS1><QCS2>0</QCS2><QCS3>0</QCS3><QCS4>1</QCS4></CAMERA_ATTITUDE>
<DETECTOR_MOUNTING><BAND_P><DETECTOR_ARRAY><DETORIGINX>{row(origin_mm[0])}</DETORIGINX>
<DETORIGINY>{row(origin_mm[1])}</DETORIGINY><DETROTANGLE>0</DETROTANGLE>
<DETPITCH>{row(pitch_mm)}</DETPITCH></DETECTOR_ARRAY></BAND_P></DETECTOR_MOUNTING></GEO></isd>
"""


def phr_dimap(model: PushbroomModel) -> str:
    """A PHRDIMAP document with quaternions as polynomials of degree six."""
    start_s, end_s = line_time_s(model, 0.0), line_time_s(model, SHAPE[0] - 1.0)
    midnight_s = (_MIDDLE - _MIDDLE.replace(hour=0, minute=0, second=0, microsecond=0)).total_seconds()
    half_s = 2.0 * (end_s - start_s)
    times = half_s * np.cos(np.pi * (np.arange(40) + 0.5) / 40.0) / 2.0
    fitted = np.polynomial.polynomial.polyfit(times / half_s, model.attitude(times), 6)
    x, y, z, w = fitted.T
    points = "".join(
        f"<Point><LOCATION_VALUES unit='m'>{row(model.orbit(np.array([t])))}</LOCATION_VALUES>"
        f"<UTC_TIME>{utc(t)}</UTC_TIME></Point>\n"
        for t in np.round(np.linspace(-0.6, 0.6, 10), 7)
    )
    polynomials = "".join(
        f"<Q{k}><DEGREE>6</DEGREE><COEFFICIENTS>{row(q)}</COEFFICIENTS></Q{k}>"
        for k, q in enumerate((w, x, y, z))
    )
    across = [model.look(np.zeros(1))[0, 1], model.look.derivative(np.zeros(1))[0, 1]]
    return f"""<?xml version="1.0" encoding="ISO-8859-1"?>
<PHR_Dimap_Document><Raster_Dimensions><NROWS>{SHAPE[0]}</NROWS><NCOLS>{SHAPE[1]}</NCOLS></Raster_Dimensions>
<Geometric_Data><Sensor_Model_Characteristics>
<UTC_Sensor_Model_Range><START>{utc(start_s)}</START><END>{utc(end_s)}</END></UTC_Sensor_Model_Range>
<Sensor_Ephemeris><Point_List>{points}</Point_List></Sensor_Ephemeris>
<Sensor_Attitudes><Polynomial_Models>{polynomials}</Polynomial_Models>
<OFFSET>{midnight_s!r}</OFFSET><SCALE>{half_s!r}</SCALE></Sensor_Attitudes>
<SENSOR_LINE_PERIOD>{1e3 * (end_s - start_s) / (SHAPE[0] - 1.0)!r}</SENSOR_LINE_PERIOD>
<Sensor_Viewing_Model><Viewing_Directions>
<PsiX_Model><DEGREE>1</DEGREE><COEFFICIENTS>{row(-np.array(across))}</COEFFICIENTS></PsiX_Model>
<PsiY_Model><DEGREE>0</DEGREE><COEFFICIENTS>0.0</COEFFICIENTS></PsiY_Model>
</Viewing_Directions></Sensor_Viewing_Model></Sensor_Model_Characteristics></Geometric_Data>
</PHR_Dimap_Document>
"""


def dimap_v2(model: PushbroomModel) -> str:
    """A DIMAP document of version 2 with quaternions at 32 Hz that end with the image."""
    start_s, end_s = line_time_s(model, 0.0), line_time_s(model, model.image_shape[0] - 1.0)
    times = np.round(np.linspace(start_s - 1e-3, end_s + 1e-3, 16), 7)
    quaternions = "".join(
        f"<Quaternion><Q0>{row(q[3])}</Q0><Q1>{row(q[0])}</Q1><Q2>{row(q[1])}</Q2><Q3>{row(q[2])}</Q3>"
        f"<TIME>{utc(t)}</TIME></Quaternion>\n"
        for t, q in zip(times, model.attitude(times), strict=True)
    )
    points_s = np.array([-0.7, -0.1, 0.5])
    points = "".join(
        f"<Point><LOCATION_XYZ>{row(p)}</LOCATION_XYZ><VELOCITY_XYZ>{row(v)}</VELOCITY_XYZ>"
        f"<TIME>{utc(t)}</TIME></Point>\n"
        for t, p, v in zip(points_s, *_orbit(model, points_s), strict=True)
    )
    across = [model.look(np.zeros(1))[0, 1], model.look.derivative(np.zeros(1))[0, 1]]
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<Dimap_Document><Metadata_Identification><METADATA_FORMAT version="2.12">DIMAP</METADATA_FORMAT>
</Metadata_Identification>
<Raster_Dimensions><NROWS>{model.image_shape[0]}</NROWS><NCOLS>{model.image_shape[1]}</NCOLS></Raster_Dimensions>
<Geometric_Data><Refined_Model><Time><Time_Range><START>{utc(start_s)}</START></Time_Range><Time_Stamp>
<LINE_PERIOD unit="microsecond">{1e6 * (end_s - start_s) / (model.image_shape[0] - 1.0)!r}</LINE_PERIOD>
</Time_Stamp></Time><Ephemeris><Point_List>{points}</Point_List></Ephemeris>
<Attitudes><Quaternion_List>{quaternions}</Quaternion_List></Attitudes>
<Geometric_Calibration><Instrument_Calibration><Band_Calibration_List><Band_Calibration>
<Swath_Range><FIRST_COL>1</FIRST_COL></Swath_Range><Polynomial_Look_Angles>
<XLOS_0>{row(-across[0])}</XLOS_0><XLOS_1>{row(-across[1])}</XLOS_1><YLOS_0>0.0</YLOS_0>
</Polynomial_Look_Angles></Band_Calibration></Band_Calibration_List>
<Instrument_Biases><YAW>0.0</YAW><PITCH>0.0</PITCH><ROLL>0.0</ROLL></Instrument_Biases>
</Instrument_Calibration></Geometric_Calibration></Refined_Model></Geometric_Data></Dimap_Document>
"""


def spot5_dimap(model: PushbroomModel) -> str:
    """A DIMAP document of version 1 with corrected angles and a table of all detectors."""
    times = np.round(np.arange(-0.8, 0.8, 0.02), 7)
    corrected = _entries("Angles", times, _spot_angles(model, times))
    attitudes = (
        "<Corrected_Attitudes><STAR_TRACKER_USED>Y</STAR_TRACKER_USED>"
        f"<Corrected_Attitude>{corrected}</Corrected_Attitude></Corrected_Attitudes>"
    )
    return _dimap_v1(model, attitudes, np.arange(SHAPE[1]))


def spot4_dimap(model: PushbroomModel) -> str:
    """A DIMAP document of version 1 with one angle, measured rates and the two ends of the detectors.

    One rate is marked as out of range, and wrong.
    """
    times = np.round(np.arange(-0.5, 0.5, 0.02), 7)
    step_s = 0.01
    rates = (_spot_angles(model, times + step_s) - _spot_angles(model, times - step_s)) / (2.0 * step_s)
    known_s = np.array([-0.41])
    known = _entries("Angles", known_s, _spot_angles(model, known_s))
    speeds = _entries("Angular_Speeds", times, rates)
    wrong = _entries("Angular_Speeds", np.array([0.005]), np.ones((1, 3))).replace(">N<", ">Y<")
    attitudes = (
        f"<Raw_Attitudes><Aocs_Attitude><Angles_List>{known}</Angles_List><Angular_Speeds_List>{speeds}{wrong}</Angular_Speeds_List></Aocs_Attitude>"
        "</Raw_Attitudes>"
    )
    return _dimap_v1(model, attitudes, np.array([0, SHAPE[1] - 1]))


def _orbit(model: PushbroomModel, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return model.orbit(times), model.orbit.derivative(times)


def _entries(tag: str, times: np.ndarray, values: np.ndarray) -> str:
    """Angles or rates about three axes with their times."""
    return "".join(
        f"<{tag}><TIME>{utc(t)}</TIME><YAW>{row(y)}</YAW><PITCH>{row(p)}</PITCH><ROLL>{row(r)}</ROLL>"
        f"<OUT_OF_RANGE>N</OUT_OF_RANGE></{tag}>\n"
        for t, (y, p, r) in zip(times, values, strict=True)
    )


def _spot_angles(model: PushbroomModel, times: np.ndarray) -> np.ndarray:
    """Yaw, pitch, roll (n, 3) of a model by the matrices of the SPOT handbook, in its navigation frame.

    There x points to the right, y forwards and z up; the rotation is pitch times roll times yaw.
    """
    position, velocity = model.orbit(times), model.orbit.derivative(times)
    up = position / np.linalg.norm(position, axis=1, keepdims=True)
    right = np.cross(velocity, up)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    orbital = np.stack([right, np.cross(up, right), up], axis=-1)
    body = Rotation.from_quat(model.attitude(times)).as_matrix()
    navigation = np.stack([body[:, :, 1], body[:, :, 0], -body[:, :, 2]], axis=-1)
    m = np.einsum("nji,njk->nik", orbital, navigation)
    roll = -np.arcsin(m[:, 0, 2])
    pitch = np.arctan2(m[:, 1, 2], m[:, 2, 2])
    yaw = np.arctan2(-m[:, 0, 1], m[:, 0, 0])
    return np.stack([yaw, pitch, roll], axis=-1)


def _dimap_v1(model: PushbroomModel, attitudes: str, samples: np.ndarray) -> str:
    """A DIMAP document of version 1 with the look angles of some samples."""
    psi_y = -np.arctan(model.look(samples.astype(float))[:, 1])
    detectors = "".join(
        f"<Look_Angles><DETECTOR_ID>{sample + 1}</DETECTOR_ID><PSI_X>0.0</PSI_X>"
        f"<PSI_Y>{row(psi)}</PSI_Y></Look_Angles>\n"
        for sample, psi in zip(samples, psi_y, strict=True)
    )

    def axes(name: str, vector: np.ndarray) -> str:
        x, y, z = vector
        return f"<{name}><X>{row(x)}</X><Y>{row(y)}</Y><Z>{row(z)}</Z></{name}>"

    points_s = np.round(np.linspace(-0.75, 0.75, 9), 7)
    points = "".join(
        f"<Point><TIME>{utc(t)}</TIME>{axes('Location', p)}{axes('Velocity', v)}</Point>\n"
        for t, p, v in zip(points_s, *_orbit(model, points_s), strict=True)
    )
    centre = SHAPE[0] // 2
    period_s = line_time_s(model, 1.0) - line_time_s(model, 0.0)
    return f"""<?xml version="1.0" encoding="ISO-8859-1"?>
<Dimap_Document><Metadata_Id><METADATA_FORMAT version="1.1">DIMAP</METADATA_FORMAT></Metadata_Id>
<Raster_Dimensions><NROWS>{SHAPE[0]}</NROWS><NCOLS>{SHAPE[1]}</NCOLS></Raster_Dimensions>
<Data_Processing><PROCESSING_LEVEL>1A</PROCESSING_LEVEL></Data_Processing>
<Data_Strip><Ephemeris><Points>{points}</Points></Ephemeris>
<Satellite_Attitudes>{attitudes}</Satellite_Attitudes>
<Sensor_Configuration><Time_Stamp><LINE_PERIOD>{period_s!r}</LINE_PERIOD>
<SCENE_CENTER_TIME>{utc(line_time_s(model, centre - 1.0))}</SCENE_CENTER_TIME>
<SCENE_CENTER_LINE>{centre}</SCENE_CENTER_LINE></Time_Stamp>
<Instrument_Look_Angles_List><Instrument_Look_Angles><Look_Angles_List>{detectors}</Look_Angles_List>
</Instrument_Look_Angles></Instrument_Look_Angles_List></Sensor_Configuration></Data_Strip></Dimap_Document>
"""
