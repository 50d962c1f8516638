"""Sentences of reports about a scene and its registration."""

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from datetime import datetime
from typing import Any

from amers.services.reports.numbers import ABSENT
from amers.services.reports.report import RunRecord, SceneRecord
from amers.services.types import Array


def scene_facts(scene: SceneRecord, size: str) -> str:
    """Sensor and time of a scene, where they are known, its size in words and where its middle is."""
    acquired = scene.acquisition.acquired_at
    known = (scene.acquisition.sensor, time_words(acquired) if acquired else "", size)
    return " · ".join([*filter(None, known), centre_words(scene.footprint_lon_lat)])


def centre_words(footprint: Array) -> str:
    """Latitude and longitude of the middle of the scene."""
    if not len(footprint):
        return ABSENT
    lon, lat = footprint.mean(axis=0)
    lon = (lon + 180.0) % 360.0 - 180.0
    return f"{abs(lat):.4f}° {'N' if lat >= 0 else 'S'}, {abs(lon):.4f}° {'E' if lon >= 0 else 'W'}"


def time_words(moment: datetime | None) -> str:
    """A time in UTC to the minute."""
    return f"{moment:%Y-%m-%d %H:%M} UTC" if moment else ABSENT


def flat_options(options: Any, prefix: str = "") -> Iterator[tuple[str, str]]:
    """Options and the options inside them, with dotted names."""
    for field in fields(options) if is_dataclass(options) else ():
        value = getattr(options, field.name)
        if is_dataclass(value):
            yield from flat_options(value, f"{prefix}{field.name}.")
        else:
            yield f"{prefix}{field.name}", str(value)


def run_foot(run: RunRecord, document_format: str) -> str:
    """Version, time and format of the document."""
    finished = time_words(run.finished_at) if run.finished_at else ""
    return " · ".join(filter(None, (f"Amers {run.software_version}", finished, document_format)))
