"""Tokens: administrators create, list and revoke them; callers see their own."""

from fastapi import APIRouter, Request, Response
from pydantic import BaseModel, ConfigDict, Field

from amers.app.api.deps import Admin, DatabaseDep, SettingsDep, TokenHolder
from amers.app.api.models.administration import (
    NewTokenRecord,
    OwnersUsage,
    OwnerUsage,
    TokenRecord,
    TokenRecords,
)
from amers.app.api.routes import CallerRoute
from amers.app.auth import Scope
from amers.app.usecases import tokens, usage

router = APIRouter(prefix="/tokens", tags=["tokens"], route_class=CallerRoute)


class TokenToMake(BaseModel):
    """A token to create."""

    model_config = ConfigDict(extra="forbid")

    name: str = Field(description="Name of the token, for people.")
    scopes: list[Scope] = Field(description="What the token allows.")
    days: int | None = Field(default=None, description="Days until it expires; null: never.")
    storage_quota_bytes: int | None = Field(
        default=None,
        description="Bytes that all its files may take in the storage; null: as the settings have it.",
    )
    job_quota: int | None = Field(
        default=None, description="Jobs that may wait or run at once; null: as the settings have it."
    )


@router.post("", status_code=201)
def create(
    *, body: TokenToMake, request: Request, response: Response, database: DatabaseDep, caller: Admin
) -> NewTokenRecord:
    """Create a token; only this reply has its secret."""
    with database.transaction() as connection:
        new = tokens.create_token(
            connection,
            body.name,
            body.scopes,
            body.days,
            storage_quota_bytes=body.storage_quota_bytes,
            job_quota=body.job_quota,
        )
    response.headers["Location"] = f"{request.base_url}tokens/{new.token.id}"
    response.headers["Cache-Control"] = "no-store"
    return NewTokenRecord(**TokenRecord.model_validate(new.token).model_dump(), secret=new.secret)


@router.get("")
def list_tokens(*, database: DatabaseDep, caller: Admin) -> TokenRecords:
    """List all tokens without their secrets, newest first, revoked and expired ones included."""
    with database.reading() as connection:
        listed = tokens.list_tokens(connection)
    return TokenRecords(tokens=[TokenRecord.model_validate(token) for token in listed])


@router.get("/usage")
def all_usage(*, database: DatabaseDep, settings: SettingsDep, caller: Admin) -> OwnersUsage:
    """List what every owner keeps in storage and queue, largest first."""
    with database.reading() as connection:
        owners = usage.read_all_usage(connection, settings)
    return OwnersUsage(owners=[OwnerUsage.model_validate(owner) for owner in owners])


@router.get("/self")
def own_token(*, caller: TokenHolder) -> TokenRecord:
    """Return the token of this request."""
    return TokenRecord.model_validate(caller)


@router.get("/self/usage")
def own_usage(*, database: DatabaseDep, settings: SettingsDep, caller: TokenHolder) -> OwnerUsage:
    """Return what the token of this request keeps in storage and queue, and its storage quota."""
    with database.reading() as connection:
        return OwnerUsage.model_validate(usage.read_usage(connection, settings, caller))


@router.delete("/{token_id}")
def revoke(*, token_id: str, database: DatabaseDep, caller: Admin) -> TokenRecord:
    """Revoke a token by its id or its name; requests with it are refused from now on."""
    with database.transaction() as connection:
        return TokenRecord.model_validate(tokens.revoke_token(connection, token_id))
