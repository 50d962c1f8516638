"""Settings of the installation, from environment variables with the prefix `AMERS_`.

No other module reads the environment.
"""

import os
import re
from ipaddress import ip_network
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, SecretStr, ValidationError, field_validator, model_validator
from pydantic_core import PydanticCustomError
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict, SettingsError

from amers.app.errors import InputError
from amers.app.public_url import normal_public_url

GIBIBYTE = 1 << 30
MEBIBYTE = 1 << 20
RENAMED = {"AMERS_QUOTA_UPLOAD_BYTES": "AMERS_QUOTA_STORAGE_BYTES"}
"""Former names of settings: a limit that somebody has set must not be ignored."""
TRASH_DAYS = 7.0
MAP_BACKGROUND = (
    r"^(https://[A-Za-z0-9.-]+(:[0-9]+)?)?/([A-Za-z0-9._~%?&=@:+-]|\{[zxy]\})"
    r"([A-Za-z0-9._~%?&=@:+/-]|\{[zxy]\})*$"
)
"""Addresses of tiles: https, or a path of the same site.

No character is allowed that ends a source of the content security policy.
"""


SECRET_PARTS = re.compile(r"^.*(?=@)|(?<=[?#]).*$", re.DOTALL)
"""Of a wrong address in a message: what stands before its host, and its query."""


def default_data_folder() -> Path:
    """The default of `AMERS_DATA_FOLDER`."""
    if os.geteuid() == 0:
        return Path("/var/lib/amers")
    base = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(base) / "amers"


class Settings(BaseSettings):
    """Infrastructure of one installation; options of algorithms are defined beside the algorithms.

    Attributes:
        database_url: PostgreSQL with PostGIS, `postgresql://user:password@host/name`; None runs a
            private cluster in the data folder.
        database_password_file: file with the password of its user, as it is; None: the address has it.
        data_folder: for the private cluster and the stored files.
        host, port: that the API listens on.
        upload_limit_bytes: largest upload of an image or a block.
        body_limit_bytes: largest body of all other requests.
        head_seconds: longest time in which the head of a request arrives.
        body_seconds: longest time in which such a body arrives.
        rate_seconds, least_rate_bytes: an upload or a reply that moves fewer bytes per second, on the
            average over so many seconds, is given up.
        connections, connections_per_address: largest number of open connections of one API process, in
            all and from one address.
        trusted_proxies: addresses and networks of proxies that state the caller's address in
            `X-Forwarded-For`.
        public_points: whether points and chips can be read without a token.
        pool_size: largest number of connections of one API process, for reading and again for writing.
        read_timeout_seconds: time limit of the database for one statement of a reading request.
        job_memory_bytes, job_seconds: limits of one job on memory and time.
        job_file_bytes: largest file that a job may write.
        result_days: days until the result files of a job are removed; None keeps them.
        min_free_bytes: free bytes on the disk of the data folder below which `/readyz` says so.
        trash_days: days until files that the sweep removed are deleted; 0 deletes them at once.
        job_record_days: days until an ended job without files is removed; None keeps it.
        audit_days: days until rows of the audit are removed; None keeps them.
        lease_seconds: time after which another worker takes over the job of a silent worker.
        storage_url: S3-compatible bucket for the files, `s3://BUCKET/PREFIX`; None for the data folder.
        scene_folder: scenes below it can be registered without an upload; None allows none.
        reference_folder: reference images and terrains below it can be added; None allows none.
        ingest_folder: block folders below it can be ingested through the API; None allows none.
        catalogues: STAC catalogues that bases are made from through the API; none: no bases are made.
        quota_storage_bytes: largest total size of all that one token has in the storage.
        quota_open_uploads: largest number of resumable uploads of one token that are not complete.
        quota_jobs: largest number of open jobs of one token.
        quota_cpu_seconds: CPU that the jobs of one token may take in a day.
        jobs_running_per_owner: largest number of running jobs of one token; None: no limit.
        quota_kept_jobs: largest number of jobs of one token, those that have ended included.
        public_metrics: whether metrics can be read without a token.
        cors_origins: web sites whose pages may call the API from a browser, `https://host`; `*` for all.
        map_background: address of the tiles of the background of the map, `https://host/{z}/{x}/{y}.png`,
            or a path of this site; None draws land only.
        map_background_attribution: who made them; shown on the map.
        public_url: address that callers use, where it is not the one in their header `Host`:
            `https://host/path/`; links, redirects and cookies follow it.
        trusted_hosts: further names in the header `Host` that the API answers to; `*` for all.
        oidc_issuer: OpenID Connect issuer whose tokens are accepted too; None accepts none.
        oidc_audience: required audience of such a token.
        oidc_keys_url: address of the issuer's keys; None takes it from the discovery document.
        oidc_claim: claim with the permissions of a token.
        oidc_scopes: values of that claim, each with the scope of Amers that it grants.
        log_format: `text` for people or `json` for programs.
        log_level: least severe level that is logged.
    """

    model_config = SettingsConfigDict(env_prefix="AMERS_", frozen=True)

    database_url: SecretStr | None = None
    database_password_file: Path | None = None
    data_folder: Path = Field(default_factory=default_data_folder)
    host: str = "127.0.0.1"
    port: int = Field(default=8000, ge=1, le=65535)
    upload_limit_bytes: int = Field(default=32 * GIBIBYTE, ge=1)
    body_limit_bytes: int = Field(default=MEBIBYTE, ge=1)
    head_seconds: float = Field(default=10.0, gt=0)
    body_seconds: float = Field(default=30.0, gt=0)
    rate_seconds: float = Field(default=30.0, gt=0)
    least_rate_bytes: int = Field(default=4096, ge=1)
    connections: int = Field(default=1000, ge=1)
    connections_per_address: int = Field(default=100, ge=1)
    trusted_proxies: Annotated[tuple[str, ...], NoDecode] = ()
    public_points: bool = False
    pool_size: int = Field(default=8, ge=1, le=100)
    read_timeout_seconds: float = Field(default=10.0, gt=0)
    job_memory_bytes: int = Field(default=8 * GIBIBYTE, ge=64 * MEBIBYTE)
    job_seconds: float = Field(default=3600.0, gt=0)
    min_free_bytes: int = Field(default=2 * GIBIBYTE, ge=0)
    trash_days: float = Field(default=TRASH_DAYS, ge=0)
    job_file_bytes: int = Field(default=128 * GIBIBYTE, ge=MEBIBYTE)
    result_days: float | None = Field(default=90.0, gt=0)
    job_record_days: float | None = Field(default=365.0, gt=0)
    audit_days: float | None = Field(default=730.0, ge=30)
    lease_seconds: float = Field(default=30.0, gt=0)
    storage_url: str | None = Field(default=None, pattern=r"^s3://[a-z0-9][a-z0-9.-]+(/[\w.-]+)*/?$")
    scene_folder: Path | None = None
    reference_folder: Path | None = None
    ingest_folder: Path | None = None
    catalogues: Annotated[tuple[str, ...], NoDecode] = ()
    quota_storage_bytes: int = Field(default=1024 * GIBIBYTE, ge=0)
    quota_open_uploads: int = Field(default=100, ge=0)
    quota_jobs: int = Field(default=100, ge=0)
    quota_cpu_seconds: float = Field(default=864_000.0, gt=0)
    jobs_running_per_owner: int | None = Field(default=None, ge=1)
    quota_kept_jobs: int = Field(default=10_000, ge=0)
    public_metrics: bool = False
    cors_origins: Annotated[tuple[str, ...], NoDecode] = ()
    map_background: str | None = Field(default=None, pattern=MAP_BACKGROUND)
    map_background_attribution: str | None = Field(default=None, max_length=200, pattern=r"\S")
    public_url: str | None = None
    trusted_hosts: Annotated[tuple[str, ...], NoDecode] = ()
    oidc_issuer: str | None = None
    oidc_audience: str = "amers"
    oidc_keys_url: str | None = None
    oidc_claim: str = "scope"
    oidc_scopes: dict[str, Literal["read", "register", "monitor", "admin"]] = Field(
        default={
            "amers:read": "read",
            "amers:register": "register",
            "amers:monitor": "monitor",
            "amers:admin": "admin",
        }
    )
    log_format: Literal["text", "json"] = "text"
    log_level: Literal["debug", "info", "warning", "error"] = "info"

    @field_validator("catalogues", "cors_origins", "trusted_hosts", "trusted_proxies", mode="before")
    @classmethod
    def _split(cls, value: object) -> object:
        return (
            [part.strip() for part in value.split(",") if part.strip()]
            if isinstance(value, str)
            else value
        )

    @field_validator("trusted_proxies")
    @classmethod
    def _networks(cls, proxies: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(str(ip_network(proxy)) for proxy in proxies)

    @field_validator("public_url")
    @classmethod
    def _public(cls, url: str | None) -> str | None:
        try:
            return normal_public_url(url) if url and url.strip() else None
        except ValueError as fault:
            raise PydanticCustomError("address", "{fault}", {"fault": str(fault)}) from None

    @field_validator("map_background")
    @classmethod
    def _whole_tile_address(cls, address: str | None) -> str | None:
        missing = [place for place in ("{z}", "{x}", "{y}") if address and place not in address]
        if missing:
            raise PydanticCustomError("places", "the address needs {missing}", {"missing": missing})
        return address

    @model_validator(mode="after")
    def _attributed(self) -> "Settings":
        if self.map_background and self.map_background_attribution is None:
            raise PydanticCustomError(
                "attribution",
                "AMERS_MAP_BACKGROUND needs AMERS_MAP_BACKGROUND_ATTRIBUTION: who made the background",
            )
        return self

    @field_validator("result_days", "job_record_days", "audit_days", mode="before")
    @classmethod
    def _never(cls, value: object) -> object:
        return None if isinstance(value, str) and value.strip().lower() == "never" else value

    @field_validator("data_folder")
    @classmethod
    def _absolute(cls, folder: Path) -> Path:
        return folder.expanduser().absolute()


def read_settings() -> Settings:
    """The settings of this process.

    Raises:
        InputError: variables have unusable values or former names; the message names them.
    """
    for former, present in RENAMED.items():
        if former in os.environ:
            raise InputError(f"environment: {former} is now {present}; set it under this name")
    try:
        return Settings()
    except ValidationError as error:
        problems = "; ".join(
            f"AMERS_{'_'.join(str(part) for part in item['loc']).upper()}: "
            f"{_shown(item['input'])} found; {item['msg']}"
            for item in error.errors()
        )
        raise InputError(f"environment: {problems}") from None
    except SettingsError:
        raise InputError(
            "environment: AMERS_OIDC_SCOPES: it cannot be read; expected a JSON object such as "
            '{"amers:read": "read"}'
        ) from None


def _shown(value: object) -> str:
    """The beginning of a value, without what may be a secret: a user with a password, a query."""
    if not isinstance(value, str):
        return f"{value!r:.60}"
    return f"{SECRET_PARTS.sub('…', value)!r:.60}"


def use_folder(folder: Path) -> None:
    """Let this process and its children use the private database and the files of a data folder."""
    for name in ("AMERS_DATABASE_URL", "AMERS_STORAGE_URL"):
        os.environ.pop(name, None)
    os.environ["AMERS_DATA_FOLDER"] = str(folder)
