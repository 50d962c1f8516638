"""Metadata of an Amers block as typed data: the content of `block.json`, independent of JSON."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np

from amers.services.types import UNKNOWN_FRAME, Acquisition, Array, Frame

NAME_PATTERN = re.compile(r"[A-Za-z][A-Za-z0-9._-]{0,99}")
"""Pattern of block names: names appear unquoted in file names, URLs and command lines."""


@dataclass(frozen=True)
class BlockSpecification:
    """The guarantees of a block for each of its points.

    Attributes:
        gsds_m: ground sampling distances of the chips in metres, finest first.
        min_views: smallest number of images that show a point.
        points_per_km2: intended density, None when not stated.
    """

    gsds_m: tuple[float, ...]
    min_views: int
    points_per_km2: float | None = None


@dataclass(frozen=True)
class AccuracyFigure:
    """One accuracy figure of a block, with the reference it was measured against.

    Attributes:
        kind: "relative" within the block's own frame, "absolute" on the Earth.
        name: name of the figure with its unit, such as `ce90_m`.
        count: number of check measurements.
        against: name of the reference.
    """

    kind: str
    name: str
    value: float
    count: int
    against: str


@dataclass(frozen=True)
class Provenance:
    """The origin of a block: software, version, source images or bases, options as JSON values."""

    software: str
    version: str
    sources: tuple[str, ...]
    options: Mapping[str, Any]


@dataclass(frozen=True)
class BlockMetadata:
    """The description of a block by its producer.

    Attributes:
        id: name of the block, see `NAME_PATTERN`.
        version: version of the block; a block never changes, a change is a new version.
        extent: (m, 2) lon, lat in degrees of the outline that contains all points; not closed,
            longitudes continuous (beyond 180 degrees where it crosses the antimeridian).
        created: time of production, UTC.
        epoch: decimal year of the coordinates, None when unknown.
        provenance: software, sources and options of the production.
        accuracy: accuracy figures with their references.
        frame: how well the frame of the block is known on the Earth.
    """

    id: str
    version: str
    title: str
    description: str
    license: str
    extent: Array
    created: datetime
    specification: BlockSpecification
    provenance: Provenance
    epoch: float | None = None
    accuracy: tuple[AccuracyFigure, ...] = ()
    frame: Frame = UNKNOWN_FRAME


@dataclass(frozen=True)
class BlockCounts:
    """The number of points, views and images of a block."""

    points: int
    views: int
    images: int


@dataclass(frozen=True)
class BlockDocument:
    """The whole content of `block.json`.

    Attributes:
        images: the images the chips were cut from.
        models: path in the block of the adjusted model of each image, None where not delivered.
        checksums: SHA-256 of every file except `block.json`, by path in the block.
    """

    metadata: BlockMetadata
    counts: BlockCounts
    images: tuple[Acquisition, ...]
    models: tuple[str | None, ...]
    checksums: Mapping[str, str]


def rectangle(west: float, south: float, east: float, north: float) -> Array:
    """The outline (4, 2) of a box in degrees, counter-clockwise.

    A box with `east` below `west` crosses the antimeridian.
    """
    east = east + 360.0 if east < west else east
    return np.array([[west, south], [east, south], [east, north], [west, north]])
