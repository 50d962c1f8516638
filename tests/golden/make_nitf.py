"""Writes two NITF 2.1 files byte by byte, with RPC00B and RPC00A, and projected points.

Source: MIL-STD-2500C for the headers, NGA STDI-0002 for the records.
"""

import json
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
LINES, SAMPLES = 32, 48
OFFSET, SCALE = (5.2, 44.2, 600.0), (0.05, 0.04, 500.0)
LINE_OFF, SAMP_OFF, LINE_SCALE, SAMP_SCALE = 15, 23, 16, 24
# RPC00B, term by term: powers of longitude, latitude and height.
TERMS_B = [
    (0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, 1), (0, 1, 1), (2, 0, 0), (0, 2, 0),
    (0, 0, 2), (1, 1, 1), (3, 0, 0), (1, 2, 0), (1, 0, 2), (2, 1, 0), (0, 3, 0), (0, 1, 2), (2, 0, 1),
    (0, 2, 1), (0, 0, 3),
]  # fmt: skip
# RPC00A: the product of all three before the squares, the third degree by descending powers.
TERMS_A = [
    (0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, 1), (0, 1, 1), (1, 1, 1), (2, 0, 0),
    (0, 2, 0), (0, 0, 2), (3, 0, 0), (2, 1, 0), (2, 0, 1), (1, 2, 0), (0, 3, 0), (0, 2, 1), (1, 0, 2),
    (0, 1, 2), (0, 0, 3),
]  # fmt: skip


def polynomials():
    """Line numerator and denominator, sample numerator and denominator; all their terms differ."""
    rng = np.random.default_rng(3)
    out = []
    for k in range(4):
        values = {term: float(np.round(rng.uniform(1.0, 9.0) * 1e-4, 6)) for term in TERMS_B}
        values[0, 0, 0] = 0.001 if k % 2 == 0 else 1.0
        if k % 2 == 0:
            values[(0, 1, 0) if k == 0 else (1, 0, 0)] = -0.9 if k == 0 else 0.9
        out.append(values)
    return out


def record(terms):
    """The 1,041 bytes of the record."""
    numbers = ""
    for polynomial in polynomials():
        for term in terms:
            mantissa, exponent = f"{polynomial[term]:+.6E}".split("E")
            numbers += f"{mantissa}E{int(exponent):+d}"
    head = f"10003.000000.50{LINE_OFF:06d}{SAMP_OFF:05d}"
    head += f"{OFFSET[1]:+08.4f}{OFFSET[0]:+09.4f}{OFFSET[2]:+05.0f}{LINE_SCALE:06d}{SAMP_SCALE:05d}"
    head += f"{SCALE[1]:+08.4f}{SCALE[0]:+09.4f}{SCALE[2]:+05.0f}"
    assert len(head + numbers) == 1041
    return head + numbers


def security():
    """The security fields that file and image header share: unclassified."""
    return "U" + " " * 166


def image_header(name, terms):
    tre = f"{name}01041{record(terms)}"
    text = (
        f"IM{'invented':10}{'20240101120000'}{'':17}{'invented, shows nothing':80}{security()}0{'':42}"
    )
    text += f"{LINES:08d}{SAMPLES:08d}INT{'MONO':8}{'VIS':8}08R 0NC1M {'':6}N{'':3}00B"
    text += f"00010001{SAMPLES:04d}{LINES:04d}080010000000000000" + "1.0 " + "00000"
    return text + f"{len(tre) + 3:05d}000{tre}"


def nitf(name, terms):
    """The file: its header of 404 bytes, the image's, the pixels."""
    line, sample = np.indices((LINES, SAMPLES))
    pixels = ((5 * line + 2 * sample) % 251 + 1).astype(np.uint8).tobytes()
    header = image_header(name, terms)
    text = f"NITF02.1003BF01{'amers':10}20240101120000{'invented':80}{security()}00000000000"
    text += "\0\0\0" + " " * 42
    text += f"{404 + len(header) + len(pixels):012d}{404:06d}001{len(header):06d}{len(pixels):010d}"
    text += "000" * 5 + "00000" * 2
    assert len(text) == 404
    return text.encode("ascii") + header.encode("ascii") + pixels


def places():
    """Ground points, and their image positions by the ratios, computed term by term."""
    rng = np.random.default_rng(1)
    normalised = np.round(rng.uniform(-0.9, 0.9, (12, 3)), 6)
    ground = normalised * np.array(SCALE) + np.array(OFFSET)
    normalised = (ground - np.array(OFFSET)) / np.array(SCALE)
    sums = [
        sum(value * np.prod(normalised ** np.array(term), axis=1) for term, value in polynomial.items())
        for polynomial in polynomials()
    ]
    line = LINE_OFF + LINE_SCALE * sums[0] / sums[1]
    sample = SAMP_OFF + SAMP_SCALE * sums[2] / sums[3]
    return {"lon_lat_h": ground.tolist(), "line_sample": np.column_stack([line, sample]).tolist()}


if __name__ == "__main__":
    (HERE / "invented_rpc00b.ntf").write_bytes(nitf("RPC00B", TERMS_B))
    (HERE / "invented_rpc00a.ntf").write_bytes(nitf("RPC00A", TERMS_A))
    (HERE / "invented_nitf_places.json").write_text(json.dumps(places(), indent=1) + "\n")
