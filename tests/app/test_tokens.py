"""Tokens: creation, secrets, scopes, revocation."""

import json
import os
import subprocess
import sys

import pytest

from app.auth import Scope, allows, authenticate, require
from app.db import engine
from app.errors import Conflict, InputError, NotAllowed, NotFound
from app.usecases.tokens import create_token, list_tokens, revoke_token
from tests.statements import run_sql

pytestmark = pytest.mark.security

ALLOWED = {
    "read": {Scope.READ},
    "register": {Scope.READ, Scope.REGISTER},
    "monitor": {Scope.MONITOR},
    "admin": {Scope.READ, Scope.REGISTER, Scope.MONITOR, Scope.ADMIN},
}


def test_a_secret_opens_its_own_token(connection):
    new = create_token(connection, "survey office", ["read"], days=30)
    other = create_token(connection, "mapping office", ["read"])
    assert new.secret != other.secret
    assert authenticate(connection, new.secret) == new.token
    assert (new.token.expires_at - new.token.created_at).days == 30
    assert other.token.expires_at is None


def test_the_database_holds_no_secret(connection):
    new = create_token(connection, "survey office", ["read"])
    row = run_sql(connection, "select token::text as everything from token").fetchone()
    assert new.secret not in row["everything"]


@pytest.mark.parametrize("scope", ALLOWED)
def test_a_scope_includes_the_lesser_ones(connection, scope):
    token = create_token(connection, "survey office", [scope]).token
    assert {other for other in Scope if allows(token, other)} == ALLOWED[scope]


def test_a_revoked_token_is_refused_like_one_that_never_was(connection):
    new = create_token(connection, "survey office", ["read"])
    revoke_token(connection, "survey office")
    with pytest.raises(NotAllowed) as revoked:
        authenticate(connection, new.secret)
    with pytest.raises(NotAllowed) as unknown:
        authenticate(connection, "no such secret")
    assert str(revoked.value) == str(unknown.value)


def test_an_expired_token_is_refused(connection):
    new = create_token(connection, "survey office", ["read"], days=1)
    run_sql(connection, "update token set expires_at = now() - interval '1 second'")
    with pytest.raises(NotAllowed):
        authenticate(connection, new.secret)


def test_a_name_of_a_valid_token_is_refused_over_the_api(client, bearer):
    admin = bearer("admin")
    body = {"name": "survey office", "scopes": ["read"]}
    made = client.post("/tokens", json=body, headers=admin)
    again = client.post("/tokens", json=body, headers=admin)
    assert (made.status_code, again.status_code) == (201, 409)
    assert f"{made.json()['id']} is named 'survey office' already" in again.json()["detail"]
    client.delete(f"/tokens/{made.json()['id']}", headers=admin)
    assert client.post("/tokens", json=body, headers=admin).status_code == 201


def test_a_token_is_revoked_by_name_only_when_the_name_is_unique(connection):
    first = create_token(connection, "survey office", ["read"]).token
    create_token(connection, "mapping office", ["admin"])
    # As databases have them from before names were unique.
    run_sql(connection, "update token set name = 'survey office'")
    with pytest.raises(Conflict, match=str(first.id)):
        revoke_token(connection, "survey office")
    assert revoke_token(connection, str(first.id)).revoked_at is not None
    assert revoke_token(connection, "survey office").scopes == ("admin",)
    with pytest.raises(NotFound):
        revoke_token(connection, "survey office")
    assert len(list_tokens(connection)) == 2


@pytest.mark.parametrize(
    ("name", "scopes", "days"),
    [
        ("", ["read"], None),
        ("x" * 201, ["read"], None),
        ("x", [], None),
        ("x", ["write"], None),
        ("x", ["read"], 0),
    ],
)
def test_a_token_with_unusable_properties_is_refused(connection, name, scopes, days):
    with pytest.raises(InputError):
        create_token(connection, name, scopes, days)
    assert list_tokens(connection) == []


def test_a_request_without_a_token_is_refused(connection):
    with pytest.raises(NotAllowed) as refused:
        require(None, Scope.READ)
    assert not refused.value.authenticated


def test_the_command_line_makes_lists_and_revokes(dsn):
    made = amers(dsn, "token", "create", "survey office", "--scope", "read", "--days", "7", "--json")
    assert made.returncode == 0, made.stderr
    record = json.loads(made.stdout)
    with engine.connect(dsn) as connection:
        assert authenticate(connection, record["secret"]).name == "survey office"

    listed = json.loads(amers(dsn, "token", "list", "--json").stdout)
    assert [token["id"] for token in listed] == [record["id"]]
    assert "secret" not in listed[0]

    assert amers(dsn, "token", "revoke", record["id"]).returncode == 0
    again = amers(dsn, "token", "revoke", record["id"])
    assert (again.returncode, again.stdout) == (2, "")
    listed_by = "`amers token list` lists names and ids"
    assert again.stderr == f"amers: no valid token {record['id']}: {listed_by}\n"


def test_on_the_command_line_a_secret_stands_alone_on_its_line(dsn):
    made = amers(dsn, "token", "create", "survey office", "--scope", "admin")
    with engine.connect(dsn) as connection:
        assert authenticate(connection, made.stdout.strip()).scopes == ("admin",)


def amers(dsn: str, *arguments: str) -> "subprocess.CompletedProcess[str]":
    environment = {**os.environ, "AMERS_DATABASE_URL": dsn}
    command = [sys.executable, "-m", "app.cli.main", *arguments]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
