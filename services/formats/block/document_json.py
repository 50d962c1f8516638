"""Conversion between `block.json`, a STAC Collection, and the typed `BlockDocument`."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np

from amers.services.conventions import CHIP_SIZE
from amers.services.errors import FormatError
from amers.services.formats.block.document import (
    NAME_PATTERN,
    AccuracyFigure,
    BlockCounts,
    BlockDocument,
    BlockMetadata,
    BlockSpecification,
    Provenance,
    rectangle,
)
from amers.services.formats.block.frame_json import format_frame, parse_frame
from amers.services.types import Acquisition, Array

BLOCK_FORMAT = "amers-block/1"
VERTICAL_DATUM = "EPSG:4979 ellipsoidal height"
BLOCK_JSON = "block.json"


def format_block_json(document: BlockDocument) -> str:
    """The text of `block.json` for a document."""
    metadata = document.metadata
    west, south = (float(v) for v in metadata.extent.min(axis=0))
    east, north = (float(v) for v in metadata.extent.max(axis=0))
    times = sorted(image.acquired_at for image in document.images if image.acquired_at is not None)
    interval = [_time_text(times[0]), _time_text(times[-1])] if times else [None, None]
    outline = [[float(lon), float(lat)] for lon, lat in metadata.extent]
    return json.dumps(
        {
            "type": "Collection",
            "stac_version": "1.0.0",
            "id": metadata.id,
            "title": metadata.title,
            "description": metadata.description,
            "license": metadata.license,
            "extent": {
                "spatial": {"bbox": [[_wrapped(west), south, _wrapped(east), north]]},
                "temporal": {"interval": [interval]},
            },
            "links": [],
            "amers:format": BLOCK_FORMAT,
            "amers:version": metadata.version,
            "amers:created": _time_text(metadata.created),
            "amers:epoch": metadata.epoch,
            "amers:vertical_datum": VERTICAL_DATUM,
            "amers:outline": outline,
            "amers:specification": {
                "gsds_m": list(metadata.specification.gsds_m),
                "chip_size": CHIP_SIZE,
                "min_views": metadata.specification.min_views,
                "points_per_km2": metadata.specification.points_per_km2,
            },
            "amers:counts": {
                "points": document.counts.points,
                "views": document.counts.views,
                "images": document.counts.images,
            },
            "amers:accuracy": {
                kind: [_accuracy_json(figure) for figure in metadata.accuracy if figure.kind == kind]
                for kind in ("relative", "absolute")
            },
            "amers:frame": format_frame(metadata.frame),
            "amers:provenance": {
                "software": metadata.provenance.software,
                "version": metadata.provenance.version,
                "sources": list(metadata.provenance.sources),
                "options": dict(metadata.provenance.options),
            },
            "amers:images": [
                _image_json(image, model)
                for image, model in zip(document.images, document.models, strict=True)
            ],
            "amers:checksums": dict(document.checksums),
        },
        indent=1,
        allow_nan=False,
    )


def parse_block_json(text: str) -> BlockDocument:
    """The typed document of the text of a `block.json`.

    Raises:
        FormatError: a field is missing or has another type; the message names the first one.
    """
    try:
        root = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{BLOCK_JSON}: cannot be parsed as JSON: {error}") from error
    if not isinstance(root, dict):
        raise FormatError(f"{BLOCK_JSON}: {type(root).__name__} found, a JSON object expected")
    if root.get("amers:format") != BLOCK_FORMAT:
        raise FormatError(
            f"{BLOCK_JSON}: amers:format: {root.get('amers:format')!r} found, {BLOCK_FORMAT!r} expected"
        )
    if root.get("amers:vertical_datum") != VERTICAL_DATUM:
        raise FormatError(
            f"{BLOCK_JSON}: amers:vertical_datum: {root.get('amers:vertical_datum')!r} found, "
            f"{VERTICAL_DATUM!r} expected"
        )
    images = [
        _parse_image(_Node(image, f"amers:images[{i}]"))
        for i, image in enumerate(_Node(root).items("amers:images"))
    ]
    counts = _Node(root).node("amers:counts")
    checksums = _Node(root).node("amers:checksums")
    return BlockDocument(
        metadata=_parse_metadata(_Node(root)),
        counts=BlockCounts(counts.integer("points"), counts.integer("views"), counts.integer("images")),
        images=tuple(image for image, _ in images),
        models=tuple(model for _, model in images),
        checksums={name: checksums.text(name) for name in checksums.value},
    )


@dataclass(frozen=True)
class _Node:
    """An object of the document with its path, which error messages name."""

    value: Any
    path: str = ""

    def __post_init__(self) -> None:
        if not isinstance(self.value, dict):
            raise FormatError(f"{BLOCK_JSON}: {self.path}: {self.value!r} found, an object expected")

    def _get(self, name: str, kinds: tuple[type, ...], expected: str) -> Any:
        value = self.value.get(name)
        if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
            actual = "nothing" if name not in self.value else f"{value!r:.80}"
            raise FormatError(f"{BLOCK_JSON}: {self._name(name)}: {actual} found, {expected} expected")
        return value

    def _name(self, name: str) -> str:
        return f"{self.path}.{name}" if self.path else name

    def node(self, name: str) -> "_Node":
        return _Node(self._get(name, (dict,), "an object"), self._name(name))

    def text(self, name: str) -> str:
        return str(self._get(name, (str,), "a text"))

    def items(self, name: str) -> Sequence[Any]:
        return list(self._get(name, (list,), "a list"))

    def integer(self, name: str) -> int:
        return int(self._get(name, (int,), "a whole number"))

    def number(self, name: str) -> float:
        value = float(self._get(name, (int, float), "a number"))
        if not math.isfinite(value):
            raise FormatError(
                f"{BLOCK_JSON}: {self._name(name)}: {value} found, a finite number expected"
            )
        return value

    def number_or_none(self, name: str) -> float | None:
        return None if self.value.get(name) is None else self.number(name)

    def time_or_none(self, name: str) -> datetime | None:
        return None if self.value.get(name) is None else self.time(name)

    def time(self, name: str) -> datetime:
        text = self.text(name)
        try:
            time = datetime.fromisoformat(text)
            if time.tzinfo is not None:
                return time.astimezone(UTC)
        except (ValueError, OverflowError):
            pass
        raise FormatError(
            f"{BLOCK_JSON}: {self._name(name)}: {text!r} found,"
            " an ISO 8601 time with a time zone expected"
        )


def _parse_metadata(root: _Node) -> BlockMetadata:
    name = root.text("id")
    if not NAME_PATTERN.fullmatch(name):
        raise FormatError(
            f"{BLOCK_JSON}: id: {name!r:.120} found, a letter followed by letters, digits, dots, "
            "dashes or underscores expected, at most 100 characters"
        )
    provenance = root.node("amers:provenance")
    accuracy = _parse_accuracy(root.node("amers:accuracy"))
    sigmas_m = [figure.value for figure in accuracy if figure.name == "frame_sigma_m"]
    return BlockMetadata(
        id=name,
        version=root.text("amers:version"),
        title=root.text("title"),
        description=root.text("description"),
        license=root.text("license"),
        extent=_parse_outline(root),
        created=root.time("amers:created"),
        specification=_parse_specification(root.node("amers:specification")),
        provenance=Provenance(
            software=provenance.text("software"),
            version=provenance.text("version"),
            sources=tuple(str(source) for source in provenance.items("sources")),
            options=provenance.node("options").value,
        ),
        epoch=root.number_or_none("amers:epoch"),
        accuracy=tuple(accuracy),
        frame=parse_frame(root.value.get("amers:frame"), next(iter(sigmas_m), None)),
    )


def _parse_specification(node: _Node) -> BlockSpecification:
    gsds = node.items("gsds_m")
    if not gsds or not all(isinstance(gsd, int | float) and 0.0 < gsd < math.inf for gsd in gsds):
        raise FormatError(
            f"{BLOCK_JSON}: {node.path}.gsds_m: {gsds!r:.80} found, a list of positive numbers "
            "of metres expected"
        )
    size = node.integer("chip_size")
    if size != CHIP_SIZE:
        raise FormatError(f"{BLOCK_JSON}: {node.path}.chip_size: {size} found, {CHIP_SIZE} expected")
    return BlockSpecification(
        gsds_m=tuple(float(gsd) for gsd in gsds),
        min_views=node.integer("min_views"),
        points_per_km2=node.number_or_none("points_per_km2"),
    )


def _parse_outline(root: _Node) -> Array:
    """The outline of the block, or the box of its STAC extent where `amers:outline` is missing."""
    if "amers:outline" in root.value:
        field, corners = "amers:outline", root.items("amers:outline")
    else:
        field, corners = "extent.spatial.bbox", root.node("extent").node("spatial").items("bbox")
    try:
        outline = np.array(corners, dtype=np.float64)
    except (TypeError, ValueError):
        outline = np.empty(0)
    if field == "extent.spatial.bbox" and outline.shape == (1, 4):
        outline = rectangle(*(float(v) for v in outline[0]))
    if outline.ndim != 2 or outline.shape[0] < 3 or outline.shape[1] != 2:
        raise FormatError(
            f"{BLOCK_JSON}: {field}: {corners!r:.80} found, at least three pairs of lon, lat expected"
        )
    inside = np.isfinite(outline).all() and (np.abs(outline) <= [540.0, 90.0]).all()
    if not inside:
        raise FormatError(
            f"{BLOCK_JSON}: {field}: {corners!r:.80} found, longitudes within 540 and latitudes within "
            "90 degrees expected"
        )
    return outline


def _parse_accuracy(node: _Node) -> list[AccuracyFigure]:
    figures = []
    for kind in ("relative", "absolute"):
        for i, value in enumerate(node.items(kind) if kind in node.value else []):
            figure = _Node(value, f"{node.path}.{kind}[{i}]")
            figures.append(
                AccuracyFigure(
                    kind=kind,
                    name=figure.text("name"),
                    value=figure.number("value"),
                    count=figure.integer("count"),
                    against=figure.text("against"),
                )
            )
    return figures


def _parse_image(node: _Node) -> tuple[Acquisition, str | None]:
    angles = {
        name: math.nan if (value := node.number_or_none(name)) is None else value
        for name in ("incidence_deg", "azimuth_deg", "sun_elevation_deg", "sun_azimuth_deg")
    }
    acquisition = Acquisition(
        image_id=node.text("image_id"),
        sensor=node.text("sensor"),
        acquired_at=node.time_or_none("acquired_at"),
        **angles,
    )
    return acquisition, node.text("model") if node.value.get("model") is not None else None


def _image_json(image: Acquisition, model: str | None) -> dict[str, str | float | None]:
    return {
        "image_id": image.image_id,
        "sensor": image.sensor,
        "acquired_at": None if image.acquired_at is None else _time_text(image.acquired_at),
        "incidence_deg": _number_or_none(image.incidence_deg),
        "azimuth_deg": _number_or_none(image.azimuth_deg),
        "sun_elevation_deg": _number_or_none(image.sun_elevation_deg),
        "sun_azimuth_deg": _number_or_none(image.sun_azimuth_deg),
        "model": model,
    }


def _accuracy_json(figure: AccuracyFigure) -> dict[str, str | float | int]:
    return {
        "name": figure.name,
        "value": figure.value,
        "count": figure.count,
        "against": figure.against,
    }


def _number_or_none(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _time_text(time: datetime) -> str:
    return time.astimezone(UTC).isoformat().replace("+00:00", "Z")


def _wrapped(lon_deg: float) -> float:
    return (lon_deg + 180.0) % 360.0 - 180.0 if abs(lon_deg) > 180.0 else lon_deg
