"""Tokens: who may call, kept by an administrator; and whose token this is."""

from dataclasses import asdict
from typing import Any

from fastapi import APIRouter, Request, Response
from fastapi.encoders import jsonable_encoder
from pydantic import BaseModel, ConfigDict

from app.api.deps import Admin, CallerDep, DatabaseDep
from app.auth import Scope, require_token
from app.db.tokens import Token
from app.usecases import tokens

router = APIRouter(prefix="/tokens", tags=["tokens"])


class TokenToMake(BaseModel):
    """A token as an administrator wants it.

    Attributes:
        name: for people.
        scopes: what it allows.
        days: how long it is valid; none: for ever.
        upload_quota_bytes, job_quota: what it may have at once; none: as the settings say.
    """

    model_config = ConfigDict(extra="forbid")

    name: str
    scopes: list[Scope]
    days: int | None = None
    upload_quota_bytes: int | None = None
    job_quota: int | None = None


@router.post("", status_code=201)
def create(
    body: TokenToMake, request: Request, response: Response, database: DatabaseDep, caller: Admin
) -> dict[str, Any]:
    """Make a token; the reply holds its secret, this once."""
    with database.transaction() as connection:
        new = tokens.create_token(
            connection,
            body.name,
            body.scopes,
            body.days,
            upload_quota_bytes=body.upload_quota_bytes,
            job_quota=body.job_quota,
        )
    response.headers["Location"] = f"{request.base_url}tokens/{new.token.id}"
    response.headers["Cache-Control"] = "no-store"
    return {**_record(new.token), "secret": new.secret}


@router.get("")
def list_tokens(database: DatabaseDep, caller: Admin) -> dict[str, Any]:
    """All tokens, the newest first, revoked and expired ones too; never a secret."""
    with database.reading() as connection:
        return {"tokens": [_record(token) for token in tokens.list_tokens(connection)]}


@router.get("/self")
def own_token(caller: CallerDep) -> dict[str, Any]:
    """Whose token this request carries, and what it allows."""
    return _record(require_token(caller))


@router.delete("/{token_id}")
def revoke(token_id: str, database: DatabaseDep, caller: Admin) -> dict[str, Any]:
    """Refuse a token from now on, by its id or its name."""
    with database.transaction() as connection:
        return _record(tokens.revoke_token(connection, token_id))


def _record(token: Token) -> dict[str, Any]:
    record: dict[str, Any] = jsonable_encoder(asdict(token))
    return record
