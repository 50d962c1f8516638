"""Settings come from the environment, and the error of a wrong value names its variable."""

from pathlib import Path

import pytest

from app.config import Settings, read_settings
from app.errors import InputError


@pytest.fixture(autouse=True)
def _no_settings(monkeypatch):
    for name in Settings.model_fields:
        monkeypatch.delenv(f"AMERS_{name.upper()}", raising=False)


def test_every_setting_has_a_default():
    settings = read_settings()
    assert settings.database_url is None
    assert not settings.public_points


def test_a_variable_sets_the_setting_of_its_name(monkeypatch):
    monkeypatch.setenv("AMERS_PUBLIC_POINTS", "true")
    monkeypatch.setenv("AMERS_PORT", "8123")
    settings = read_settings()
    assert settings.public_points
    assert settings.port == 8123


@pytest.mark.parametrize(
    ("name", "value"), [("PORT", "no"), ("JOB_SECONDS", "-1"), ("PUBLIC_POINTS", "perhaps")]
)
def test_a_wrong_value_is_refused_by_the_name_of_its_variable(monkeypatch, name, value):
    monkeypatch.setenv(f"AMERS_{name}", value)
    with pytest.raises(InputError, match=f"AMERS_{name}"):
        read_settings()


def test_the_password_of_the_database_is_not_shown():
    settings = Settings(database_url="postgresql://amers:hush@db/amers")
    assert "hush" not in repr(settings)


def test_the_data_folder_may_be_given_relative_to_home_or_here(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert Settings(data_folder=Path("data")).data_folder == tmp_path / "data"
    assert Settings(data_folder=Path("~/data")).data_folder == tmp_path / "data"


def test_an_ordinary_user_keeps_data_below_his_home_and_root_below_var(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("XDG_DATA_HOME", raising=False)
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    assert Settings().data_folder == tmp_path / ".local" / "share" / "amers"
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "xdg"))
    assert Settings().data_folder == tmp_path / "xdg" / "amers"
    monkeypatch.setattr("os.geteuid", lambda: 0)
    assert Settings().data_folder == Path("/var/lib/amers")
