"""Settings of the installation, from the environment (prefix `AMERS_`), which nothing else reads."""

import os
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, SecretStr, ValidationError, field_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

from app.errors import InputError

GIBIBYTE = 1 << 30
MEBIBYTE = 1 << 20


def default_data_folder() -> Path:
    """Where Amers keeps its data when nobody says otherwise."""
    if os.geteuid() == 0:
        return Path("/var/lib/amers")
    base = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(base) / "amers"


class Settings(BaseSettings):
    """Infrastructure of one installation; options of algorithms live beside the algorithms.

    Attributes:
        database_url: PostgreSQL with PostGIS, `postgresql://user:password@host/name`; none means a
            private cluster in the data folder.
        data_folder: the private cluster and the stored files.
        host, port: where the API listens.
        upload_limit_bytes: largest scene that can be uploaded.
        body_limit_bytes: largest body of every other request.
        public_points: points and chips can be read without a token.
        pool_size: most connections one API process opens for reading, and again for writing.
        read_timeout_seconds: longest time the database may spend on one statement of a reading request.
        job_memory_bytes, job_seconds: what one job may use before it is stopped.
        result_days: how long the files that jobs made are kept; none: for ever.
        lease_seconds: how long a job waits for a silent worker before another takes it over.
        storage_url: a bucket of S3-compatible storage for the files, `s3://BUCKET/PREFIX`; none: the
            data folder.
        scene_folder: holds scenes that may be registered where they lie; none: not at all.
        reference_folder: holds the reference images and terrains that scenes may be registered on; none:
            there are none.
        ingest_folder: holds the block folders that may be ingested through the API; none: not at all.
        quota_upload_bytes: what the scenes of one token may take in the storage at once.
        quota_jobs: how many jobs of one token may wait or run at once.
        public_metrics: metrics can be read without a token.
        cors_origins: web sites whose pages may call the API from a browser, `https://host`; `*`: all.
        oidc_issuer: an OpenID Connect issuer whose tokens are accepted beside our own; none: none are.
        oidc_audience: whom such a token must be for.
        oidc_keys_url: where the issuer's keys are; none: where its discovery document says.
        oidc_claim: the claim that says what a token allows.
        oidc_scopes: values of that claim, each with the scope of ours that it stands for.
        log_format: lines for people (`text`) or for programs (`json`).
        log_level: the least grave events that are logged.
    """

    model_config = SettingsConfigDict(env_prefix="AMERS_", frozen=True)

    database_url: SecretStr | None = None
    data_folder: Path = Field(default_factory=default_data_folder)
    host: str = "127.0.0.1"
    port: int = Field(default=8000, ge=1, le=65535)
    upload_limit_bytes: int = Field(default=32 * GIBIBYTE, ge=1)
    body_limit_bytes: int = Field(default=MEBIBYTE, ge=1)
    public_points: bool = False
    pool_size: int = Field(default=8, ge=1, le=100)
    read_timeout_seconds: float = Field(default=10.0, gt=0)
    job_memory_bytes: int = Field(default=8 * GIBIBYTE, ge=64 * MEBIBYTE)
    job_seconds: float = Field(default=3600.0, gt=0)
    result_days: float | None = Field(default=None, gt=0)
    lease_seconds: float = Field(default=30.0, gt=0)
    storage_url: str | None = Field(default=None, pattern=r"^s3://[a-z0-9][a-z0-9.-]+(/[\w.-]+)*/?$")
    scene_folder: Path | None = None
    reference_folder: Path | None = None
    ingest_folder: Path | None = None
    quota_upload_bytes: int = Field(default=1024 * GIBIBYTE, ge=0)
    quota_jobs: int = Field(default=100, ge=0)
    public_metrics: bool = False
    cors_origins: Annotated[tuple[str, ...], NoDecode] = ()
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

    @field_validator("cors_origins", mode="before")
    @classmethod
    def _split(cls, value: object) -> object:
        return (
            [part.strip() for part in value.split(",") if part.strip()]
            if isinstance(value, str)
            else value
        )

    @field_validator("data_folder")
    @classmethod
    def _absolute(cls, folder: Path) -> Path:
        return folder.expanduser().absolute()


def read_settings() -> Settings:
    """The settings of this process.

    Raises:
        InputError: a variable does not hold what it should; the message names it.
    """
    try:
        return Settings()
    except ValidationError as error:
        wrong = "; ".join(
            f"AMERS_{'_'.join(str(part) for part in item['loc']).upper()}: {item['msg']}"
            for item in error.errors()
        )
        raise InputError(f"wrong setting: {wrong}") from None
