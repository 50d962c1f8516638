"""Settings come from the environment, and the error of a wrong value names its variable."""

import json
import re
from pathlib import Path

import pytest

from amers.app.config import Settings, read_settings
from amers.app.errors import InputError


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


DOCUMENTED = dict(
    re.findall(
        r"^\| `AMERS_(\w+)` \| ([^|]+) \|",
        (Path(__file__).parents[2] / "docs" / "operations.md").read_text(),
        re.MULTILINE,
    )
)
"""What the page of operations gives as the default of each setting."""
TOLD_IN_WORDS = {"data_folder", "oidc_scopes"}


def told(default: object) -> str:
    """A default as the page writes it."""
    if default is None or default == ():
        return "none"
    if isinstance(default, bool):
        return f"`{str(default).lower()}`"
    return f"`{default}`" if isinstance(default, str) else f"{default:.15g}"


@pytest.mark.parametrize("name", sorted(set(Settings.model_fields) - TOLD_IN_WORDS))
def test_a_setting_has_the_default_that_operators_read(name):
    documented = re.sub(r" \(.*\)", "", DOCUMENTED[name.upper()].strip())
    assert told(getattr(read_settings(), name)) in (documented, documented.strip("`"))


def test_a_default_in_bytes_is_the_round_number_beside_it():
    units = {"MiB": 2**20, "GiB": 2**30, "TiB": 2**40}
    written = [re.fullmatch(r"(\d+) \((\d+) (\w+)\)", text.strip()) for text in DOCUMENTED.values()]
    found = [match for match in written if match]
    assert len(found) >= 6
    assert all(int(m[1]) == int(m[2]) * units[m[3]] for m in found)


def test_rights_of_an_issuer_have_the_names_of_the_scopes_that_they_grant():
    granted = read_settings().oidc_scopes
    assert {f"amers:{scope}": scope for scope in granted.values()} == granted
    assert set(granted.values()) == {"read", "register", "monitor", "admin"}


@pytest.mark.parametrize(
    ("name", "accepted", "refused"),
    [
        ("PORT", ("1", "65535"), ("0", "65536")),
        ("POOL_SIZE", ("1", "100"), ("0", "101")),
        ("UPLOAD_LIMIT_BYTES", ("1",), ("0", "1.5")),
        ("BODY_LIMIT_BYTES", ("1",), ("0",)),
        ("HEAD_SECONDS", ("0.001",), ("0", "-1")),
        ("BODY_SECONDS", ("0.001",), ("0",)),
        ("RATE_SECONDS", ("0.001",), ("0",)),
        ("READ_TIMEOUT_SECONDS", ("0.001",), ("0",)),
        ("LEASE_SECONDS", ("0.001",), ("0",)),
        ("JOB_SECONDS", ("0.001",), ("0",)),
        ("LEAST_RATE_BYTES", ("1",), ("0",)),
        ("CONNECTIONS", ("1",), ("0",)),
        ("CONNECTIONS_PER_ADDRESS", ("1",), ("0",)),
        ("JOB_MEMORY_BYTES", (str(2**26),), (str(2**26 - 1),)),
        ("JOB_FILE_BYTES", (str(2**20),), (str(2**20 - 1),)),
        ("MIN_FREE_BYTES", ("0",), ("-1",)),
        ("TRASH_DAYS", ("0",), ("-0.1",)),
        ("RESULT_DAYS", ("0.1", "never"), ("0", "ever")),
        ("JOB_RECORD_DAYS", ("0.1", " Never "), ("0",)),
        ("AUDIT_DAYS", ("30", "never"), ("29.9",)),
        ("QUOTA_STORAGE_BYTES", ("0",), ("-1",)),
        ("QUOTA_OPEN_UPLOADS", ("0",), ("-1",)),
        ("QUOTA_JOBS", ("0",), ("-1",)),
        ("QUOTA_KEPT_JOBS", ("0",), ("-1",)),
        ("JOBS_RUNNING_PER_OWNER", ("1",), ("0",)),
        (
            "STORAGE_URL",
            ("s3://chips", "s3://chips/of/amers/"),
            ("s3://", "https://chips", "s3://a/../b c"),
        ),
        ("TRUSTED_PROXIES", ("10.0.0.5,10.1.0.0/24", ""), ("10.1.0.1/24", "proxy")),
        ("LOG_FORMAT", ("text", "json"), ("xml",)),
        ("LOG_LEVEL", ("debug", "error"), ("loud",)),
    ],
)
def test_a_setting_is_accepted_up_to_its_limits_and_refused_beyond(monkeypatch, name, accepted, refused):
    for value in accepted:
        monkeypatch.setenv(f"AMERS_{name}", value)
        read_settings()
    for value in refused:
        monkeypatch.setenv(f"AMERS_{name}", value)
        with pytest.raises(InputError, match=f"AMERS_{name}"):
            read_settings()


@pytest.mark.parametrize(
    "address",
    [
        "https://tiles.example/{z}/{x}/{y}.png",
        "https://tiles.example:8443/wmts?layer=a&TileMatrix={z}&TileCol={x}&TileRow={y}",
        "/tiles/{z}/{y}/{x}.jpg",
    ],
)
def test_a_background_lies_on_a_site_with_encryption_or_on_this_one(monkeypatch, address):
    monkeypatch.setenv("AMERS_MAP_BACKGROUND", address)
    monkeypatch.setenv("AMERS_MAP_BACKGROUND_ATTRIBUTION", "its makers")
    assert read_settings().map_background == address


@pytest.mark.parametrize(
    "address",
    [
        "",
        "http://tiles.example/{z}/{x}/{y}.png",
        "//tiles.example/{z}/{x}/{y}.png",
        "https://tiles.example/{z}/{x}.png",
        "https://tiles.example/{z}/{x}/{y}/{token}",
        "https://tiles.example; script-src */{z}/{x}/{y}",
        "https://tiles.example/{z}/{x}/{y}.png; script-src *",
        "https://user@tiles.example/{z}/{x}/{y}",
        "javascript:alert(1)//{z}/{x}/{y}",
    ],
)
def test_a_background_elsewhere_or_with_anything_else_in_its_address_is_refused(monkeypatch, address):
    monkeypatch.setenv("AMERS_MAP_BACKGROUND", address)
    monkeypatch.setenv("AMERS_MAP_BACKGROUND_ATTRIBUTION", "its makers")
    with pytest.raises(InputError, match="AMERS_MAP_BACKGROUND"):
        read_settings()


def test_a_background_without_the_name_of_its_makers_is_refused(monkeypatch):
    monkeypatch.setenv("AMERS_MAP_BACKGROUND", "https://tiles.example/{z}/{x}/{y}.png")
    with pytest.raises(InputError, match="needs AMERS_MAP_BACKGROUND_ATTRIBUTION"):
        read_settings()
    monkeypatch.setenv("AMERS_MAP_BACKGROUND_ATTRIBUTION", " ")
    with pytest.raises(InputError, match="AMERS_MAP_BACKGROUND_ATTRIBUTION"):
        read_settings()


@pytest.mark.parametrize("name", ["RESULT_DAYS", "JOB_RECORD_DAYS", "AUDIT_DAYS"])
def test_what_is_never_removed_has_no_number_of_days(monkeypatch, name):
    monkeypatch.setenv(f"AMERS_{name}", "Never")
    assert getattr(read_settings(), name.lower()) is None


@pytest.mark.parametrize("name", ["CORS_ORIGINS", "TRUSTED_HOSTS"])
def test_lists_are_separated_by_commas_and_blanks_do_not_count(monkeypatch, name):
    monkeypatch.setenv(f"AMERS_{name}", " https://a.example , ,https://b.example,")
    assert getattr(read_settings(), name.lower()) == ("https://a.example", "https://b.example")


def test_a_right_that_grants_no_scope_is_refused(monkeypatch):
    monkeypatch.setenv("AMERS_OIDC_SCOPES", json.dumps({"gcp:all": "admin"}))
    assert read_settings().oidc_scopes == {"gcp:all": "admin"}
    for value in ('{"gcp:all": "root"}', "{"):
        monkeypatch.setenv("AMERS_OIDC_SCOPES", value)
        with pytest.raises(InputError, match="AMERS_OIDC_SCOPES"):
            read_settings()
