"""What an Amers block says of itself, as typed data: `block.json` without its JSON."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np

from services.types import Acquisition, Array

NAME_PATTERN = re.compile(r"[A-Za-z][A-Za-z0-9._-]{0,99}")
"""Names of blocks: they go into file names, URLs and command lines as they are."""


@dataclass(frozen=True)
class BlockSpecification:
    """What every point of a block is promised to have.

    Attributes:
        gsds_m: ground samplings of the chips, finest first.
        min_views: images at least that see a point.
        points_per_km2: density aimed at, None when not stated.
    """

    gsds_m: tuple[float, ...]
    min_views: int
    points_per_km2: float | None = None


@dataclass(frozen=True)
class AccuracyFigure:
    """One figure on the accuracy of a block and what it was measured against.

    Attributes:
        kind: "relative" within the block's own frame, "absolute" on the Earth.
        name: with its unit, as `ce90_m`.
        count: number of checks behind it.
        against: the reference.
    """

    kind: str
    name: str
    value: float
    count: int
    against: str


@dataclass(frozen=True)
class Provenance:
    """How a block was made: software and version, source images or bases, options as JSON values."""

    software: str
    version: str
    sources: tuple[str, ...]
    options: Mapping[str, Any]


@dataclass(frozen=True)
class BlockMetadata:
    """What the producer of a block says about it.

    Attributes:
        id: name of the block, a letter then letters, digits, dots, dashes, underscores.
        version: one block is one version; a change is a new version.
        extent: (m, 2) lon, lat of the outline all points lie in, not closed, longitudes continuous
            (beyond 180 degrees where it crosses the antimeridian).
        created: UTC.
        epoch: decimal year of the coordinates, None when unknown.
        provenance: how it was made.
        accuracy: figures with what they were measured against.
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


@dataclass(frozen=True)
class BlockCounts:
    """How much a block holds."""

    points: int
    views: int
    images: int


@dataclass(frozen=True)
class BlockDocument:
    """All of block.json.

    Attributes:
        images: the images its chips were cut from.
        models: adjusted model of each image, path in the block, None where not delivered.
        checksums: sha256 of every file but block.json, by path in the block.
    """

    metadata: BlockMetadata
    counts: BlockCounts
    images: tuple[Acquisition, ...]
    models: tuple[str | None, ...]
    checksums: Mapping[str, str]


def rectangle(west: float, south: float, east: float, north: float) -> Array:
    """Outline (4, 2) of a box, counter-clockwise; a box with `east` below `west` crosses 180 degrees."""
    east = east + 360.0 if east < west else east
    return np.array([[west, south], [east, south], [east, north], [west, north]])
