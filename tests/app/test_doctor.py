"""`amers doctor`: what works, and what to do where something does not."""

import json
import os
from pathlib import Path

import pytest

from amers.app.config import Settings
from amers.app.usecases import doctor
from amers.app.usecases.doctor import Finding, examine
from tests.command_line import amers_here, environment_of


def found(settings: Settings) -> dict[str, Finding]:
    return {one.part: one for one in examine(settings)}


def test_every_part_of_a_working_installation_is_told(settings: Settings) -> None:
    parts = found(settings)
    for part in ("versions", "machine", "database", "schema", "storage", "disk", "data folder"):
        assert parts[part].status == "ok", parts[part]
    assert "none runs" in parts["worker"].found
    assert "PROJ" in parts["versions"].found
    assert {"map page", "geoid EGM96", "geoid EGM2008"} <= set(parts)


def test_a_database_that_does_not_answer_ends_with_a_refusal_and_the_rest_is_told(
    tmp_path: Path,
) -> None:
    environment = {
        **os.environ,
        "AMERS_DATABASE_URL": "postgresql://somebody:secret@127.0.0.1:9/base",
        "AMERS_DATA_FOLDER": str(tmp_path),
    }
    done = amers_here(("doctor", "--json"), environment)
    assert done.returncode == 2, done.stderr
    parts = {one["part"]: one for one in json.loads(done.stdout)}
    assert parts["database"]["status"] == "failed"
    assert "nothing listens there" in parts["database"]["found"]
    assert "secret" not in done.stdout
    assert parts["data folder"]["status"] == "ok"
    assert "storage" not in parts


def test_nothing_is_made_where_there_is_no_installation_yet(tmp_path: Path) -> None:
    environment = {**os.environ, "AMERS_DATA_FOLDER": str(tmp_path / "data")}
    environment.pop("AMERS_DATABASE_URL", None)
    done = amers_here(("doctor",), environment)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "the first command that needs it makes it" in done.stdout
    assert not (tmp_path / "data").exists()


def test_a_working_installation_ends_well(settings: Settings) -> None:
    done = amers_here(("doctor",), environment_of(settings))
    assert done.returncode == 0, done.stdout + done.stderr


def test_what_is_missing_says_how_to_get_it(
    settings: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor.resources, "files", lambda _package: tmp_path)
    monkeypatch.setattr(doctor, "_WORKING_BYTES", 1 << 60)
    parts = found(settings)
    assert (parts["map page"].status, parts["machine"].status) == ("degraded", "degraded")
    assert "make page" in parts["map page"].found
    assert parts["data folder"].status == "degraded"
    assert "free some room" in parts["data folder"].found


@pytest.mark.parametrize(
    ("settings_free", "working_free"), [(True, False), (False, True), (False, False)]
)
def test_room_is_short_where_less_is_free_than_the_settings_or_large_scenes_need(
    settings: Settings, monkeypatch: pytest.MonkeyPatch, *, settings_free: bool, working_free: bool
) -> None:
    monkeypatch.setattr(doctor, "_WORKING_BYTES", 1 if working_free else 1 << 60)
    least = settings.model_copy(update={"min_free_bytes": 1 if settings_free else 1 << 60})
    room = doctor._room(least)
    assert room.status == "degraded"
    monkeypatch.setattr(doctor, "_WORKING_BYTES", 1)
    assert doctor._room(settings.model_copy(update={"min_free_bytes": 1})).status == "ok"
