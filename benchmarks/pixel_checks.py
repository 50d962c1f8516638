"""Statistics of pixels on clean and on distorted real images, and how far apart they are.

Needs AMERS_REAL_DATA. Each image of one band, and each band of the others, is clean; the first bands are
distorted in all kinds, amounts and places. Whole places are kept apart: the limit of each statistic is
set on half of the places: 15 % above its largest value on clean images, or the geometric mean of that
and the 5 % quantile of distorted ones where this is larger. It is judged on the other half, and the
halves are exchanged. *Named* is the share of distorted images that have the finding at the limits of the
code. Five minutes.
Run: python -m benchmarks.pixel_checks
"""

import math
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
import rasterio

from amers.services.imagery.pixel_checks import (
    Fault,
    PixelStatistics,
    findings_of,
    pixel_statistics,
)
from amers.services.imagery.source import ArrayImage
from amers.services.types import FloatImage
from benchmarks._measuring import keep, print_table
from tests.services.imagery.textures import (
    changed,
    hazy,
    interlaced,
    lost,
    moved,
    pasted,
    repeated,
    seen_twice,
)

FOLDERS = (
    "phr_calanques_triplet",
    "phr_gizeh_pair",
    "phr_iceland_pair",
    "phr_ventoux_pair",
    "s2_maricopa_pair",
    "s2a_berlin_pair",
    "wv3_jacksonville",
    "wv3_ntf_crops",
)
NO_IMAGES = ("grid", "mask", "lidar")
AT = (0.02, 0.12, 0.3, 0.5, 0.7, 0.9, 0.98)
"""Fraction of the lines and samples of an image where a distortion begins."""
_ABOVE = 1.15
"""Limit of a statistic over its largest value on clean images."""
FALSE_KINDS = ("clean", "changed", "haze")


@dataclass(frozen=True)
class Case:
    """One image, distorted or not, and its statistics.

    Attributes:
        place: folder of the image.
        kind, amount, at: what was done to it; see `CASES`.
        values: of the statistics, by name.
        named: kinds of the findings.
        cpu_s: of all checks.
        megapixels: of the image.
    """

    place: str
    kind: str
    amount: float
    at: float
    values: dict[str, float]
    named: tuple[str, ...]
    cpu_s: float
    megapixels: float


@dataclass(frozen=True)
class Check:
    """A check: its statistic and what it is of.

    Attributes:
        statistic: name of the value.
        kind: of the distortion.
        faults: kinds of findings that name it.
        least: amount from which on it is to be named, pixels.
    """

    statistic: str
    kind: str
    faults: tuple[Fault, ...]
    least: float


CHECKS = (
    Check("equal lines", "repeated", (Fault.REPEATED_LINES,), 1.0),
    Check("jump", "lost", (Fault.LOST_LINES,), 2.0),
    Check("corner", "pasted", (Fault.PART,), 2.0),
    Check("odd, px", "interlace", (Fault.ODD_LINES,), 0.1),
    Check("second image", "ghost", (Fault.SECOND_IMAGE,), 5.0),
    Check("bands, px", "bands", (Fault.BANDS,), 0.5),
)
AMOUNTS = {
    "repeated": (1, 2, 5, 25, 60),
    "lost": (1, 2, 5, 12, 40),
    "pasted": (1, 2, 5, 12, 30),
    "interlace": (0.1, 0.3, 1, 3, 20),
    "ghost": (3, 5, 10, 30),
    "bands": (0.5, 1.5, 10, 40),
    "changed": (12, 30),
    "haze": (12, 40),
}
WHOLE = ("interlace", "ghost", "bands")
"""Kinds that have no place."""


def distorted(pixels: FloatImage, kind: str, amount: float, at: float) -> FloatImage:
    """An image distorted; its gaps are where they were, or follow their lines."""
    filled = np.nan_to_num(pixels)
    line, count = int(at * len(pixels)), int(amount)
    side = int(0.35 * min(pixels.shape))
    ways: dict[str, Callable[[FloatImage], FloatImage]] = {
        "repeated": lambda image: repeated(image, line, count),
        "lost": lambda image: lost(image, line, count),
        "pasted": lambda image: pasted(image, (line, int(at * image.shape[1])), side, count),
        "interlace": lambda image: interlaced(image, amount),
        "ghost": lambda image: seen_twice(image, count, count),
        "changed": lambda image: changed(image, line, int(amount / 100.0 * len(image))),
        "haze": lambda image: hazy(image, line, amount / 100.0),
    }
    out = ways[kind](filled)
    gaps = np.isnan(pixels)
    if kind in ("repeated", "lost"):
        gaps = ways[kind](gaps.astype(np.float32)) > 0.5
    out = np.rint(out) if np.array_equal(filled, np.rint(filled)) else out.copy()
    out = np.clip(out, filled.min(), filled.max())
    out[gaps] = np.nan
    return np.asarray(out, np.float32)


def cases(folder: Path) -> Iterator[Case]:
    """All images as they are, and distorted."""
    for place in FOLDERS:
        files = [*(folder / place).glob("*.tif"), *(folder / place).glob("*.NTF")]
        for path in sorted(files):
            if any(word in path.name for word in NO_IMAGES):
                continue
            bands = read_bands(path)
            for band in bands:
                yield case(place, "clean", 0.0, 0.0, [band])
            if len(bands) > 1:
                yield case(place, "clean", 0.0, 0.0, bands[:3])
            yield from distorted_cases(place, bands[0])


def distorted_cases(place: str, pixels: FloatImage) -> Iterator[Case]:
    """One image in all kinds, amounts and places."""
    for kind, amounts in AMOUNTS.items():
        for number, amount in enumerate(amounts):
            for at in (0.0,) if kind in WHOLE else AT[number % 2 :: 2]:
                if kind == "bands":
                    others = [moved(pixels, amount, 0.0), moved(pixels, 0.0, amount)]
                    yield case(place, kind, amount, at, [pixels, *others])
                    continue
                out = distorted(pixels, kind, amount, at)
                same = out.shape == pixels.shape and np.array_equal(out, pixels, equal_nan=True)
                if not same and not leaves_nothing(kind, amount, at, len(pixels)):
                    yield case(place, kind, amount, at, [out])


def leaves_nothing(kind: str, amount: float, at: float, lines: int) -> bool:
    """Whether what follows the place has four lines at most; a part, a twentieth of the lines."""
    behind = lines - int(at * lines) - (int(amount) if kind == "lost" else 0)
    return kind in ("lost", "repeated", "pasted") and behind <= (0.05 * lines if kind == "pasted" else 4)


def read_bands(path: Path) -> list[FloatImage]:
    """The bands of an image."""
    with rasterio.open(path) as file:
        pixels = file.read().astype(np.float32)
        if file.nodata is not None:
            pixels[pixels == file.nodata] = np.nan
    return list(pixels)


def case(place: str, kind: str, amount: float, at: float, bands: list[FloatImage]) -> Case:
    """The statistics and findings of an image."""
    images = [ArrayImage(np.ascontiguousarray(band)) for band in bands]
    begun = time.process_time()
    statistics = pixel_statistics(images[0], images if len(images) > 1 else ())
    found = findings_of(images[0], statistics)
    cpu_s = time.process_time() - begun
    named = tuple(one.kind.value for one in found)
    return Case(place, kind, amount, at, values(statistics), named, cpu_s, bands[0].size / 1e6)


def values(statistics: PixelStatistics) -> dict[str, float]:
    """The statistics as numbers that are larger the clearer the fault."""
    known = [one for one in statistics.bands if one.score >= 10.0]
    places = np.array([np.zeros(2), *(one.line_sample for one in known)])
    return {
        "equal lines": float(sum(one.count for axis in statistics.repeated for one in axis)),
        "jump": max(float(axis[4:-4].max(initial=0.0)) for axis in statistics.jumps),
        "corner": statistics.corner.score,
        "odd, px": max(abs(float(one.line_sample[1])) for one in statistics.fields),
        "second image": statistics.echo.score,
        "bands, px": float(np.linalg.norm(places[:, None] - places[None, :], axis=2).max()),
        "odd along, px": max(abs(float(one.line_sample[0])) for one in statistics.fields),
    }


@dataclass(frozen=True)
class Margin:
    """How far a statistic of clean images is from that of distorted ones.

    Attributes:
        statistic: its name.
        clean: number of images that are clean, changed or hazy.
        largest_clean: on these.
        distorted: number of distorted images, of amounts that are to be named.
        smallest, fifth: on these: the smallest and the 5 % quantile.
        named: share of these with the finding at the limits of the code.
        kept_apart: share of these above the limit of the other half of the places.
        false_apart: clean images above it.
    """

    statistic: str
    clean: int
    largest_clean: float
    distorted: int
    smallest: float
    fifth: float
    named: float
    kept_apart: float
    false_apart: int


def margin(check: Check, done: list[Case]) -> Margin:
    """The margin of one check."""
    clean = [one for one in done if one.kind in FALSE_KINDS]
    faulty = [one for one in done if one.kind == check.kind and one.amount >= check.least]
    value = lambda one: one.values[check.statistic]  # noqa: E731
    above = false = 0
    for half in range(2):
        tuned = {place for k, place in enumerate(FOLDERS) if k % 2 == half}
        worst = max(value(one) for one in clean if one.place in tuned)
        fifth = float(np.quantile([value(one) for one in faulty if one.place in tuned], 0.05))
        limit = max(_ABOVE * worst, math.sqrt(worst * fifth))
        above += sum(value(one) > limit for one in faulty if one.place not in tuned)
        false += sum(value(one) > limit for one in clean if one.place not in tuned)
    found = np.array([value(one) for one in faulty])
    return Margin(
        check.statistic,
        len(clean),
        max(map(value, clean)),
        len(faulty),
        float(found.min()),
        float(np.quantile(found, 0.05)),
        float(np.mean([any(fault.value in one.named for fault in check.faults) for one in faulty])),
        above / len(faulty),
        false,
    )


def main() -> None:
    """Measure all images and print the margins."""
    cv2.setNumThreads(1)
    folder = Path(os.environ["AMERS_REAL_DATA"])
    done = list(cases(folder))
    margins = [margin(check, done) for check in CHECKS]
    false = [one for one in done if one.kind in FALSE_KINDS and one.named]
    unnamed = [one for one in done if one.kind not in FALSE_KINDS and not one.named]
    keep(
        "pixel_checks",
        {
            "margins": [asdict(one) for one in margins],
            "false": [asdict(one) for one in false],
            "unnamed": [asdict(one) for one in unnamed],
            "images": sum(one.kind == "clean" for one in done),
            "cpu_s": float(np.median([one.cpu_s for one in done])),
            "cases": [asdict(one) for one in done],
        },
    )
    print_table(
        "Pixel checks",
        margins,
        {
            "statistic": lambda one: one.statistic,
            "clean": lambda one: one.clean,
            "largest": lambda one: f"{one.largest_clean:.3f}",
            "distorted": lambda one: one.distorted,
            "smallest": lambda one: f"{one.smallest:.3f}",
            "5 %": lambda one: f"{one.fifth:.2f}",
            "named": lambda one: f"{one.named:.3f}",
            "kept apart": lambda one: f"{one.kept_apart:.3f}",
            "false apart": lambda one: one.false_apart,
        },
        width=120,
        caption=f"{len(false)} of {margins[0].clean} clean, changed or hazy images have a finding",
    )


if __name__ == "__main__":
    main()
