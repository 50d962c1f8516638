"""RPC projection and its inverse: Amers, rpcfast and GDAL (through rasterio) on the same points.

The table shows the CPU time of one thread (median of interleaved runs) and the largest difference from
Amers in pixels; for `locate` also the largest difference from the requested position. Ground positions
are compared by their projections. The centre of the first pixel is (0, 0) in Amers and rpcfast and
(0.5, 0.5) in GDAL: half a pixel is subtracted from GDAL's projections and added to the positions that it
locates. Each implementation locates to its default tolerance (rpcfast 1e-8 px, Amers 1e-7 px, GDAL
0.1 px), and GDAL also to 1e-6 px. GDAL gets fewer points. Run: python -m benchmarks.rpc
"""

import os

# Numba reads this when it is first imported.
os.environ["NUMBA_NUM_THREADS"] = "1"

import argparse
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import rpcfast
from rasterio.transform import RPCTransformer

from amers.services.formats.images.raster import gdal_rpc
from amers.services.formats.sensor_models.rpc_text import parse_rpc_text
from amers.services.sensors.rpc import RpcModel
from amers.services.types import Array
from benchmarks._measuring import cpu_medians_s, keep, print_table

MODEL = Path(__file__).parents[1] / "tests" / "golden" / "invented_RPC.TXT"
GDAL_FIRST_PIXEL = 0.5
STRICT = {"RPC_PIXEL_ERROR_THRESHOLD": "1e-6", "RPC_MAX_ITERATIONS": "40"}


@dataclass(frozen=True)
class Outcome:
    """The result of one implementation in one direction."""

    direction: str
    implementation: str
    points: int
    cpu_s: float
    points_per_s: float
    amers_is_faster: float
    largest_difference_px: float
    round_trip_px: float | None


@dataclass(frozen=True)
class Variant:
    """One implementation in one direction.

    Attributes:
        points: number of points.
        run: the function to time.
        result: its result in the conventions of Amers.
    """

    points: int
    run: Callable[[], object]
    result: Callable[[], Array]


def main() -> None:
    """Measure, print the table and store the outcomes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--gdal-points", type=int, default=200_000)
    parser.add_argument("--repeats", type=int, default=15)
    arguments = parser.parse_args()
    model = parse_rpc_text(MODEL.read_text())
    rng = np.random.default_rng(1)
    ground = model.ground_offset + rng.uniform(-1.0, 1.0, (arguments.points, 3)) * model.ground_scale
    line_sample = model.image_offset + rng.uniform(-1.0, 1.0, (arguments.points, 2)) * model.image_scale
    with ExitStack() as stack:
        gdal = stack.enter_context(RPCTransformer(gdal_rpc(model)))
        strict = stack.enter_context(RPCTransformer(gdal_rpc(model), **STRICT))
        few = ground[: arguments.gdal_points]
        projecting = {
            "Amers": amers_project(model, ground),
            "rpcfast": rpcfast_project(model, ground),
            "GDAL": gdal_project(gdal, few),
        }
        outcomes = compared("project", projecting, arguments.repeats, lambda variant: variant.result())
        few_px = line_sample[: arguments.gdal_points]
        locating = {
            "Amers": amers_locate(model, line_sample, ground[:, 2]),
            "rpcfast": rpcfast_locate(model, line_sample, ground[:, 2]),
            "GDAL": gdal_locate(gdal, few_px, few[:, 2]),
            "GDAL to 1e-6 px": gdal_locate(strict, few_px, few[:, 2]),
        }
        outcomes += compared(
            "locate",
            locating,
            arguments.repeats,
            lambda variant: model.project(variant.result()),
            line_sample,
        )
    print_table("RPC, one thread; largest differences", outcomes, COLUMNS, width=105)
    keep("rpc", [asdict(outcome) for outcome in outcomes])


def compared(
    direction: str,
    variants: dict[str, Variant],
    repeats: int,
    in_pixels: Callable[[Variant], Array],
    requested: Array | None = None,
) -> list[Outcome]:
    """Times and largest differences of some variants; the first one is the reference."""
    taken_s = cpu_medians_s({name: variant.run for name, variant in variants.items()}, repeats)
    pixels = {name: in_pixels(variant) for name, variant in variants.items()}
    reference = next(iter(variants))
    outcomes = []
    for name, variant in variants.items():
        speed = variant.points / taken_s[name]
        faster = variants[reference].points / taken_s[reference] / speed
        difference_px = largest(pixels[name] - pixels[reference][: variant.points])
        round_trip_px = (
            None if requested is None else largest(pixels[name] - requested[: variant.points])
        )
        outcomes.append(
            Outcome(
                direction,
                name,
                variant.points,
                taken_s[name],
                speed,
                faster,
                difference_px,
                round_trip_px,
            )
        )
    return outcomes


def largest(difference: Array) -> float:
    """Largest absolute value; an undefined position counts as infinitely far."""
    return float(np.nan_to_num(np.abs(difference), nan=np.inf).max())


def amers_project(model: RpcModel, ground: Array) -> Variant:
    """Amers."""
    return Variant(len(ground), lambda: model.project(ground), lambda: model.project(ground))


def amers_locate(model: RpcModel, line_sample: Array, height_m: Array) -> Variant:
    """Amers."""
    return Variant(
        len(height_m),
        lambda: model.locate(line_sample, height_m),
        lambda: model.locate(line_sample, height_m),
    )


def rpcfast_project(model: RpcModel, ground: Array) -> Variant:
    """Rpcfast, which needs separate, contiguous coordinates."""
    other, coordinates = fast(model), [np.ascontiguousarray(column) for column in ground.T]

    def result() -> Array:
        sample, line = rpcfast.project(other, *coordinates)
        return np.column_stack([line, sample])

    return Variant(len(ground), lambda: rpcfast.project(other, *coordinates), result)


def rpcfast_locate(model: RpcModel, line_sample: Array, height_m: Array) -> Variant:
    """Rpcfast, which needs separate, contiguous coordinates."""
    other = fast(model)
    sample_line_h = [np.ascontiguousarray(c) for c in (line_sample[:, 1], line_sample[:, 0], height_m)]

    def result() -> Array:
        lon, lat, _ = rpcfast.localize(other, *sample_line_h)
        return np.column_stack([lon, lat, height_m])

    return Variant(len(height_m), lambda: rpcfast.localize(other, *sample_line_h), result)


def gdal_project(gdal: RPCTransformer, ground: Array) -> Variant:
    """GDAL, without rounding to whole pixels."""
    coordinates = [np.ascontiguousarray(column) for column in ground.T]

    def run() -> tuple[Array, Array]:
        line, sample = gdal.rowcol(*coordinates, op=unrounded)
        return line, sample

    return Variant(len(ground), run, lambda: np.column_stack(run()) - GDAL_FIRST_PIXEL)


def gdal_locate(gdal: RPCTransformer, line_sample: Array, height_m: Array) -> Variant:
    """GDAL, with positions from the corner of the first pixel ("ul")."""
    line, sample = (np.ascontiguousarray(column) for column in line_sample.T + GDAL_FIRST_PIXEL)

    def run() -> tuple[Array, Array]:
        lon, lat = gdal.xy(line, sample, zs=height_m, offset="ul")
        return lon, lat

    return Variant(len(height_m), run, lambda: np.column_stack([*run(), height_m]))


def unrounded(position: Array) -> Array:
    """The position itself: the operation that rasterio applies to its results."""
    return position


def fast(model: RpcModel) -> rpcfast.RPCModel:
    """The model in the structure of rpcfast."""
    rpc = gdal_rpc(model)
    names = [
        f"{axis}_{what}"
        for axis in ("line", "samp", "lat", "long", "height")
        for what in ("off", "scale")
    ]
    names += [f"{axis}_{part}_coeff" for axis in ("line", "samp") for part in ("num", "den")]
    return rpcfast.RPCModel(**{name: np.asarray(getattr(rpc, name)) for name in names})


COLUMNS: dict[str, Callable[[Outcome], object]] = {
    "": lambda o: o.direction,
    "implementation": lambda o: o.implementation,
    "points": lambda o: f"{o.points:,}",
    "M points/s": lambda o: f"{o.points_per_s / 1e6:.1f}",
    "Amers is faster": lambda o: f"{o.amers_is_faster:.1f} x",
    "from Amers": lambda o: f"{o.largest_difference_px:.1e} px",
    "from the request": lambda o: None if o.round_trip_px is None else f"{o.round_trip_px:.1e} px",
}


if __name__ == "__main__":
    main()
