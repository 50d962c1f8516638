"""Settings come from the environment, and the error of a wrong value names its variable."""

import json
import re
from pathlib import Path

import pytest

from amers.app.config import RENAMED, Settings, read_settings, use_folder
from amers.app.errors import InputError


@pytest.fixture(autouse=True)
def _no_settings(monkeypatch):
    for name in Settings.model_fields:
        monkeypatch.delenv(f"AMERS_{name.upper()}", raising=False)


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


LIMITS = [
    ("PORT", ("1", "65535"), ("0", "65536", "no")),
    ("PUBLIC_POINTS", ("true", "false"), ("perhaps",)),
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
    ("QUOTA_CPU_SECONDS", ("0.001",), ("0",)),
    (
        "MAP_BACKGROUND",
        (
            "/{z}/{x}/{y}",
            "https://tiles.example/{z}/{x}/{y}.png",
            "https://tiles.example:8443/wmts?layer=a&TileMatrix={z}&TileCol={x}&TileRow={y}",
            "/tiles/{z}/{y}/{x}.jpg",
        ),
        (
            "",
            "http://a.example/{z}/{x}/{y}",
            "https:/{z}/{x}/{y}",
            "//tiles.example/{z}/{x}/{y}.png",
            "https://tiles.example/{z}/{x}.png",
            "https://tiles.example/{z}/{x}/{y}/{token}",
            "https://tiles.example; script-src */{z}/{x}/{y}",
            "https://tiles.example/{z}/{x}/{y}.png; script-src *",
            "https://user@tiles.example/{z}/{x}/{y}",
            "javascript:alert(1)//{z}/{x}/{y}",
        ),
    ),
    ("MAP_BACKGROUND_ATTRIBUTION", ("x", "x" * 200), ("", " ", "x" * 201)),
    ("OIDC_SCOPES", ('{"all": "admin"}', "{}"), ('{"all": "root"}', "{")),
    ("LOG_FORMAT", ("text", "json"), ("xml", "")),
    ("LOG_LEVEL", ("debug", "info", "warning", "error"), ("loud", "")),
]
"""What each setting with limits accepts, at these, and what it refuses, just beyond."""
CONSTRAINTS = ("inimum", "aximum", "maxLength", "pattern", "enum")
"""Parts of the names that JSON Schema has for limits."""


def test_both_sides_of_the_limits_of_every_setting_are_tried():
    declared = {
        name.upper()
        for name, schema in Settings.model_json_schema()["properties"].items()
        if any(constraint in json.dumps(schema) for constraint in CONSTRAINTS)
    }
    assert declared <= {name for name, *_ in LIMITS}


@pytest.mark.parametrize(("name", "accepted", "refused"), LIMITS)
def test_a_setting_is_accepted_up_to_its_limits_and_refused_beyond(monkeypatch, name, accepted, refused):
    monkeypatch.setenv("AMERS_MAP_BACKGROUND_ATTRIBUTION", "its makers")
    for value in accepted:
        monkeypatch.setenv(f"AMERS_{name}", value)
        read_settings()
    for value in refused:
        monkeypatch.setenv(f"AMERS_{name}", value)
        with pytest.raises(InputError, match=f"AMERS_{name}"):
            read_settings()


def test_a_background_without_the_name_of_its_makers_is_refused(monkeypatch):
    monkeypatch.setenv("AMERS_MAP_BACKGROUND", "https://tiles.example/{z}/{x}/{y}.png")
    with pytest.raises(InputError, match="needs AMERS_MAP_BACKGROUND_ATTRIBUTION"):
        read_settings()


SITES = (" https://a.example , ,https://b.example,", ("https://a.example", "https://b.example"))


@pytest.mark.parametrize(
    ("name", "value", "read"),
    [
        ("RESULT_DAYS", "Never", None),
        ("RESULT_DAYS", "2.5", 2.5),
        ("JOB_RECORD_DAYS", "Never", None),
        ("JOB_RECORD_DAYS", "1", 1.0),
        ("AUDIT_DAYS", "Never", None),
        ("AUDIT_DAYS", " NEVER ", None),
        ("AUDIT_DAYS", "365", 365.0),
        ("CORS_ORIGINS", *SITES),
        ("TRUSTED_HOSTS", *SITES),
        ("CATALOGUES", *SITES),
        ("TRUSTED_PROXIES", " 10.0.0.5 ,,10.1.0.0/24,", ("10.0.0.5/32", "10.1.0.0/24")),
        ("OIDC_SCOPES", '{"gcp:all": "admin"}', {"gcp:all": "admin"}),
        ("PUBLIC_URL", " ", None),
        ("PUBLIC_POINTS", "true", True),
        ("PORT", "8123", 8123),
    ],
)
def test_a_value_is_read_as_what_it_stands_for(monkeypatch, name, value, read):
    monkeypatch.setenv(f"AMERS_{name}", value)
    assert getattr(read_settings(), name.lower()) == read


@pytest.mark.parametrize(("former", "present"), [("QUOTA_UPLOAD_BYTES", "QUOTA_STORAGE_BYTES")])
def test_the_former_name_of_a_setting_is_refused_with_the_present_one(monkeypatch, former, present):
    assert list(RENAMED) == [f"AMERS_{former}"]
    monkeypatch.setenv(f"AMERS_{former}", "1")
    with pytest.raises(InputError, match=f"AMERS_{former} is now AMERS_{present};"):
        read_settings()


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        ("postgresql://amers:hush@db/amers", "'…@db/amers'"),
        ("https://db.example/?password=hush", "'https://db.example/?…'"),
        ("https://db.example/#hush", "'https://db.example/#…'"),
        ("x" * 59, f"'{'x' * 59}"),
        ("x" * 60, f"'{'x' * 59}"),
    ],
)
def test_of_a_wrong_value_its_beginning_is_shown_without_what_may_be_secret(monkeypatch, value, shown):
    monkeypatch.setenv("AMERS_PORT", value)
    with pytest.raises(InputError) as refusal:
        read_settings()
    assert f"AMERS_PORT: {shown} found; " in str(refusal.value)


def test_a_process_can_be_bound_to_a_folder_whatever_the_environment_says(monkeypatch, tmp_path):
    monkeypatch.setenv("AMERS_DATABASE_URL", "postgresql://amers@db/amers")
    monkeypatch.setenv("AMERS_STORAGE_URL", "s3://chips")
    monkeypatch.setenv("AMERS_DATA_FOLDER", "/elsewhere")
    use_folder(tmp_path)
    settings = read_settings()
    assert (settings.database_url, settings.storage_url) == (None, None)
    assert settings.data_folder == tmp_path
