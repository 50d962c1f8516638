"""RPC00B and RPC00A in NITF files, as raw bytes of the standard."""

from pathlib import Path

import numpy as np
import pytest
import rasterio

from services.formats.rpc_files import read_rpc
from services.sensors.rpc import RpcModel

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")

a_thousandth_of_a_pixel = 1e-3
GROUND = (5.2, 44.2, 600.0), (0.05, 0.04, 500.0)
# STDI-0002, RPC00B: term by term, powers of longitude, latitude and height.
TERMS_B = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, 1), (0, 1, 1), (2, 0, 0)]
TERMS_B += [(0, 2, 0), (0, 0, 2), (1, 1, 1), (3, 0, 0), (1, 2, 0), (1, 0, 2), (2, 1, 0), (0, 3, 0)]
TERMS_B += [(0, 1, 2), (2, 0, 1), (0, 2, 1), (0, 0, 3)]
# RPC00A: the product of all three before the squares, the third degree by falling powers.
TERMS_A = [*TERMS_B[:7], (1, 1, 1), (2, 0, 0), (0, 2, 0), (0, 0, 2), (3, 0, 0), (2, 1, 0), (2, 0, 1)]
TERMS_A += [(1, 2, 0), (0, 3, 0), (0, 2, 1), (1, 0, 2), (0, 1, 2), (0, 0, 3)]


def coefficients() -> list[dict[tuple[int, int, int], float]]:
    """Four polynomials whose terms all differ."""
    rng = np.random.default_rng(3)
    out = []
    for k in range(4):
        values = {term: float(np.round(rng.uniform(1.0, 9.0) * 1e-4, 6)) for term in TERMS_B}
        values[0, 0, 0] = 0.001 if k % 2 == 0 else 1.0
        if k % 2 == 0:
            values[(0, 1, 0) if k == 0 else (1, 0, 0)] = -0.9 if k == 0 else 0.9
        out.append(values)
    return out


def record(terms: list[tuple[int, int, int]]) -> str:
    """The 1,041 bytes of the record."""
    numbers = "".join(
        f"{polynomial[term]:+.6E}".replace("E+0", "E+").replace("E-0", "E-")
        for polynomial in coefficients()
        for term in terms
    )
    head = "1" + "0003.00" + "0000.50" + "001000" + "01200"
    head += f"{GROUND[0][1]:+08.4f}{GROUND[0][0]:+09.4f}{600:+05d}"
    head += "001000" + "01200" + f"{GROUND[1][1]:+08.4f}{GROUND[1][0]:+09.4f}{500:+05d}"
    assert len(head + numbers) == 1041
    return head + numbers


def write_nitf(path: Path, name: str, terms: list[tuple[int, int, int]]) -> Path:
    pixels = np.ones((1, 2000, 2400), np.uint8)
    with rasterio.open(
        path,
        "w",
        driver="NITF",
        height=2000,
        width=2400,
        count=1,
        dtype="uint8",
        TRE=f"{name}={record(terms)}",
    ) as file:
        file.write(pixels)
    return path


def expected(lon_lat_h: np.ndarray) -> np.ndarray:
    """The ratios, term by term, from nothing but powers."""
    normalised = (lon_lat_h - np.array(GROUND[0])) / np.array(GROUND[1])
    sums = [
        sum(value * np.prod(normalised ** np.array(term), axis=1) for term, value in polynomial.items())
        for polynomial in coefficients()
    ]
    return np.column_stack([1000.0 + 1000.0 * sums[0] / sums[1], 1200.0 + 1200.0 * sums[2] / sums[3]])


@pytest.mark.parametrize(("name", "terms"), [("RPC00B", TERMS_B), ("RPC00A", TERMS_A)])
def test_a_record_is_read_as_the_standard_has_it(
    tmp_path: Path, name: str, terms: list[tuple[int, int, int]]
) -> None:
    delivered = read_rpc(write_nitf(tmp_path / "a.ntf", name, terms))
    model = delivered.model
    assert isinstance(model, RpcModel)
    ground = np.array(GROUND[0]) + np.random.default_rng(1).uniform(-0.9, 0.9, (200, 3)) * np.array(
        GROUND[1]
    )
    np.testing.assert_allclose(model.project(ground), expected(ground), atol=a_thousandth_of_a_pixel)
    assert (model.error_bias_m, model.error_random_m) == (3.0, 0.5)
