"""Writes the invented RPC into this folder in five formats, without the code under test."""

from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
LINE_OFF, SAMP_OFF, LINE_SCALE, SAMP_SCALE = 12999.5, 13249.25, 13000.0, 13250.0
LONG_OFF, LAT_OFF, HEIGHT_OFF = 12.3456789, 41.9012345, 310.0
LONG_SCALE, LAT_SCALE, HEIGHT_SCALE = 0.0801, 0.0602, 420.0
MAIN = {
    "LINE_NUM": [2.1e-3, 0.0183, -1.021, 0.0114, -4.2e-4, 2.3e-5, 3.1e-5, -3.3e-4, 8.1e-4, 1.2e-6],
    "LINE_DEN": [1.0, 3.1e-4, -7.2e-4, 2.4e-5],
    "SAMP_NUM": [-1.4e-3, 1.017, 0.0124, -0.0231, 5.1e-4, -2.9e-5, 1.8e-5, 6.2e-4, -2.2e-4, 4.1e-7],
    "SAMP_DEN": [1.0, 4.4e-4, 2.6e-4, -3.1e-5],
}
POWERS = [
    (0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, 1), (0, 1, 1), (2, 0, 0), (0, 2, 0),
    (0, 0, 2), (1, 1, 1), (3, 0, 0), (1, 2, 0), (1, 0, 2), (2, 1, 0), (0, 3, 0), (0, 1, 2), (2, 0, 1),
    (0, 2, 1), (0, 0, 3),
]  # fmt: skip


def terms(x, y, z):
    return np.column_stack([x**a * y**b * z**c for a, b, c in POWERS])


def polynomials():
    rng = np.random.default_rng(20)
    small = {name: np.round(rng.normal(0.0, 1e-6, 20), 12) for name in MAIN}
    for name, main in MAIN.items():
        small[name][: len(main)] = main
    return small


def inverse(model):
    """Numerator and denominator of lon, then of lat, as functions of sample, line and height."""
    rng = np.random.default_rng(21)
    x, y, z = rng.uniform(-1.1, 1.1, (3, 4000))
    t = terms(x, y, z)
    line = t @ model["LINE_NUM"] / (t @ model["LINE_DEN"])
    sample = t @ model["SAMP_NUM"] / (t @ model["SAMP_DEN"])
    design = terms(sample, line, z)
    polynomials = []
    for side in (x, y):
        both = np.column_stack([design, -side[:, None] * design[:, 1:]])
        solution = np.linalg.lstsq(both, side, rcond=None)[0]
        polynomials += [solution[:20], np.concatenate([[1.0], solution[20:]])]
    return polynomials


def numbers(names, values):
    return "".join(f"        <{n}>{float(v)!r}</{n}>\n" for n, v in zip(names, values, strict=True))


def coefficients(name, values):
    return numbers([f"{name}_COEFF_{i}" for i in range(1, 21)], values)


def dimap(model, version, first, layout):
    (to_ground, lon, lat), (from_ground, domain_of_ground), domain_of_image = layout
    names = f"{lon}_NUM", f"{lon}_DEN", f"{lat}_NUM", f"{lat}_DEN"
    direct = "".join(coefficients(n, v) for n, v in zip(names, inverse(model), strict=True))
    return (
        '<?xml version="1.0" encoding="UTF-8" standalone="no"?>\n<!-- invented -->\n<Dimap_Document>\n'
        "  <Metadata_Identification>\n"
        f'    <METADATA_FORMAT version="{version}">DIMAP</METADATA_FORMAT>\n'
        f"    <METADATA_PROFILE>{'PHR' if first else 'PNEO'}_SENSOR</METADATA_PROFILE>\n"
        "  </Metadata_Identification>\n  <Rational_Function_Model>\n    <Global_RFM>\n"
        f"      <{to_ground}>\n{direct}      </{to_ground}>\n"
        f"      <{from_ground}>\n{''.join(coefficients(name, model[name]) for name in MAIN)}"
        "        <ERR_BIAS_ROW>0.0005</ERR_BIAS_ROW>\n        <ERR_BIAS_COL>0.0006</ERR_BIAS_COL>\n"
        f"      </{from_ground}>\n      <RFM_Validity>\n        <{domain_of_image}>\n"
        f"        <FIRST_ROW>{first}</FIRST_ROW>\n        <FIRST_COL>{first}</FIRST_COL>\n"
        f"        <LAST_ROW>{25999 + first}</LAST_ROW>\n        <LAST_COL>{26499 + first}</LAST_COL>\n"
        f"        </{domain_of_image}>\n        <{domain_of_ground}>\n        </{domain_of_ground}>\n"
        + numbers(
            ["LONG_SCALE", "LONG_OFF", "LAT_SCALE", "LAT_OFF", "HEIGHT_SCALE", "HEIGHT_OFF"]
            + ["SAMP_SCALE", "SAMP_OFF", "LINE_SCALE", "LINE_OFF"],
            [LONG_SCALE, LONG_OFF, LAT_SCALE, LAT_OFF, HEIGHT_SCALE, HEIGHT_OFF]
            + [SAMP_SCALE, SAMP_OFF + first, LINE_SCALE, LINE_OFF + first],
        )
        + "      </RFM_Validity>\n    </Global_RFM>\n  </Rational_Function_Model>\n</Dimap_Document>\n"
    )


def text(model):
    lines = ["ERR_BIAS: 2.5", "ERR_RAND: 0.25"]
    lines += [f"LINE_OFF: {LINE_OFF} pixels", f"SAMP_OFF: {SAMP_OFF} pixels"]
    lines += [f"LAT_OFF: {LAT_OFF} degrees", f"LONG_OFF: {LONG_OFF} degrees"]
    lines += [f"HEIGHT_OFF: {HEIGHT_OFF} meters", f"LINE_SCALE: {LINE_SCALE} pixels"]
    lines += [f"SAMP_SCALE: {SAMP_SCALE} pixels", f"LAT_SCALE: {LAT_SCALE} degrees"]
    lines += [f"LONG_SCALE: {LONG_SCALE} degrees", f"HEIGHT_SCALE: {HEIGHT_SCALE} meters"]
    lines += [f"{n}_COEFF_{i}: {float(v)!r}" for n in MAIN for i, v in enumerate(model[n], start=1)]
    return "\n".join(lines) + "\n"


def rpb(model):
    lines = ['satId = "WV02";', 'bandId = "P";', 'SpecId = "RPC00B";', "BEGIN_GROUP = IMAGE"]
    lines += ["\terrBias = 2.5;", "\terrRand = 0.25;", f"\tlineOffset = {LINE_OFF};"]
    lines += [f"\tsampOffset = {SAMP_OFF};", f"\tlatOffset = {LAT_OFF};", f"\tlongOffset = {LONG_OFF};"]
    lines += [f"\theightOffset = {HEIGHT_OFF};", f"\tlineScale = {LINE_SCALE};"]
    lines += [f"\tsampScale = {SAMP_SCALE};", f"\tlatScale = {LAT_SCALE};"]
    lines += [f"\tlongScale = {LONG_SCALE};", f"\theightScale = {HEIGHT_SCALE};"]
    for name in MAIN:
        words = name.lower().split("_")
        values = ",\n".join(f"\t\t\t{float(v):+.15E}" for v in model[name])
        lines.append(f"\t{words[0]}{words[1].title()}Coef = (\n{values});")
    return "\n".join([*lines, "END_GROUP = IMAGE", "END;", ""])


def geom(model, order):
    """An OSSIM keyword list; order A has the terms of the second and third degree elsewhere."""
    a_powers = [
        *POWERS[:7], (1, 1, 1), (2, 0, 0), (0, 2, 0), (0, 0, 2), (3, 0, 0), (2, 1, 0), (2, 0, 1),
        (1, 2, 0), (0, 3, 0), (0, 2, 1), (1, 0, 2), (0, 1, 2), (0, 0, 3),
    ]  # fmt: skip
    powers = POWERS if order == "B" else a_powers
    lines = ["type:  ossimRpcModel", f"polynomial_format:  {order}", "sensor:  PHR 1B"]
    lines += ["// invented", "bias_error:  2.5", "rand_error:  0.25", f"line_off:  {LINE_OFF}"]
    lines += [f"samp_off:  {SAMP_OFF}", f"line_scale:  {LINE_SCALE}", f"samp_scale:  {SAMP_SCALE}"]
    lines += [f"lat_off:  {LAT_OFF}", f"long_off:  {LONG_OFF}", f"height_off:  {HEIGHT_OFF}"]
    lines += [f"lat_scale:  {LAT_SCALE}", f"long_scale:  {LONG_SCALE}", f"height_scale:  {HEIGHT_SCALE}"]
    for name in MAIN:
        value_of = dict(zip(POWERS, model[name], strict=True))
        lines += [f"{name.lower()}_coeff_{i:02d}:  {float(value_of[p])!r}" for i, p in enumerate(powers)]
    lines += ["number_lines:  26000", "number_samples:  26500", "rect:  0 0 26499 25999"]
    lines += ["number_of_adjustments:  1", "current_adjustment:  0"]
    lines += ["adjustment_0.description:  Initial adjustment", "adjustment_0.number_of_params:  5"]
    parameters = "intrack_offset", "crtrack_offset", "intrack_scale", "crtrack_scale", "map_rotation"
    for k, name in enumerate(parameters):
        stem = f"adjustment_0.adj_param_{k}"
        sigma = 0.1 if name == "map_rotation" else 50
        lines += [f"{stem}.description:  {name}", f"{stem}.center:  0", f"{stem}.parameter:  0"]
        lines += [f"{stem}.sigma:  {sigma}", f"{stem}.lock_flag:  0"]
    lines += ["support_data.image_date:  2024-05-28T10:25:07.4Z"]
    lines += ['support_data.azimuth_angle:  """150.5 150.4 ', '150.3 """']
    lines += ['support_data.elevation_angle:  """60.1 60.2 60.3 """']
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    model = polynomials()
    (HERE / "invented.geom").write_text(geom(model, "B"))
    (HERE / "invented_a.geom").write_text(geom(model, "A"))
    v2 = ("Direct_Model", "SAMP", "LINE"), ("Inverse_Model", "Inverse_Model_Validity_Domain")
    v3 = (
        ("ImagetoGround_Values", "LON", "LAT"),
        ("GroundtoImage_Values", "GroundtoImage_Validity_Domain"),
    )
    (HERE / "invented_RPC.TXT").write_text(text(model))
    (HERE / "invented.RPB").write_text(rpb(model))
    (HERE / "RPC_invented_v2.XML").write_text(
        dimap(model, "2.15", 1, (*v2, "Direct_Model_Validity_Domain"))
    )
    (HERE / "RPC_invented_v3.XML").write_text(
        dimap(model, "3.0.0", 0, (*v3, "ImagetoGround_Validity_Domain"))
    )
