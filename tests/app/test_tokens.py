"""Tokens: creation, secrets, scopes, revocation."""

import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor, wait
from datetime import UTC, datetime, timedelta
from uuid import uuid4

import pytest

from amers.app.auth import (
    Scope,
    allows,
    authenticate,
    authenticate_session,
    is_administrator,
    may_access,
    owner_filter,
    require,
)
from amers.app.db import engine, tokens
from amers.app.db.jobs import jobs
from amers.app.errors import Conflict, InputError, NotAllowed, NotFound
from amers.app.usecases.tokens import create_token, list_tokens, revoke_token
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
    other = create_token(connection, "mapping office", ["read"]).token
    revoke_token(connection, "survey office")
    assert [tokens.is_valid(connection, one.id) for one in (new.token, other)] == [False, True]
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


def test_a_name_of_a_valid_token_is_refused_over_the_api(admin):
    body = {"name": "survey office", "scopes": ["read"]}
    made = admin.post("/tokens", json=body)
    again = admin.post("/tokens", json=body)
    assert (made.status_code, again.status_code) == (201, 409)
    assert f"{made.json()['id']} is named 'survey office' already" in again.json()["detail"]
    admin.delete(f"/tokens/{made.json()['id']}")
    assert admin.post("/tokens", json=body).status_code == 201


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


@pytest.mark.parametrize(
    ("changes", "beyond"),
    [
        ({"name": "x"}, {"name": " "}),
        ({"name": "x" * 200}, {"name": "x" * 201}),
        ({"days": 1}, {"days": 0}),
        ({"days": 36_500}, {"days": 36_501}),
        ({"storage_quota_bytes": 0}, {"storage_quota_bytes": -1}),
        ({"storage_quota_bytes": 2**62}, {"storage_quota_bytes": 2**62 + 1}),
        ({"job_quota": 0}, {"job_quota": -1}),
        ({"job_quota": 1_000_000}, {"job_quota": 1_000_001}),
    ],
)
def test_a_token_may_have_what_is_in_range_and_nothing_beyond(connection, changes, beyond):
    usual = {"name": "survey office", "scopes": ["read"]}
    with pytest.raises(InputError):
        create_token(connection, **usual | beyond)
    token = create_token(connection, **usual | changes).token
    kept = {"days": None if token.expires_at is None else (token.expires_at - token.created_at).days}
    assert all((vars(token) | kept)[name] == value for name, value in changes.items())
    assert authenticate(connection, create_token(connection, "other", ["read"]).secret) != token


def test_scopes_are_kept_once_each_in_the_order_of_their_power(connection):
    token = create_token(connection, " survey office ", ["admin", "read", "admin"]).token
    assert (token.name, token.scopes) == ("survey office", ("read", "admin"))


def test_all_scopes_are_listed_the_lesser_ones_first_however_they_were_given(connection):
    ordered = ("read", "register", "monitor", "admin")
    for number, given in enumerate((ordered, ordered[::-1], ("admin", "monitor", "read", "register"))):
        token = create_token(connection, f"survey office {number}", given).token
        assert token.scopes == ordered


@pytest.mark.parametrize("end", ["revoked_at = now()", "expires_at = now() - interval '1 s'"])
def test_a_name_is_taken_as_long_as_its_token_is_valid(connection, end):
    first = create_token(connection, "survey office", ["read"], days=1)
    with pytest.raises(Conflict, match=str(first.token.id)):
        create_token(connection, " survey office", ["read"])
    run_sql(connection, f"update token set {end}")
    second = create_token(connection, "survey office", ["read"])
    assert authenticate(connection, second.secret) == second.token


def test_a_name_that_two_administrators_give_at_once_is_that_of_one_token(database):
    with database.transaction() as first, ThreadPoolExecutor(1) as threads:
        create_token(first, "office", ["read"])

        def create_too() -> None:
            with database.transaction() as second:
                create_token(second, "office", ["admin"])

        other = threads.submit(create_too)
        wait([other], timeout=0.5)
        first.commit()
        with pytest.raises(Conflict, match="named 'office' already"):
            other.result()


@pytest.mark.parametrize(
    ("change", "valid"),
    [
        ("expires_at = now() + interval '1 hour'", True),
        ("expires_at = now()", False),
        ("expires_at = now() + interval '1 hour', revoked_at = now() - interval '1 hour'", False),
        ("subject = 'somebody', secret_hash = null", None),
    ],
)
def test_a_secret_and_a_session_open_a_valid_token_of_a_secret_alone(connection, change, valid):
    new = create_token(connection, "survey office", ["read"])
    run_sql(connection, f"update token set {change}")
    for opened in (
        lambda: authenticate(connection, new.secret),
        lambda: authenticate_session(connection, new.token.id, uuid4()),
    ):
        if valid:
            assert opened().id == new.token.id
        else:
            with pytest.raises(NotAllowed) as refused:
                opened()
            assert not refused.value.authenticated


def test_open_jobs_are_the_own_ones_that_have_not_ended(connection):
    mine, yours = (create_token(connection, name, ["register"]).token for name in ("mine", "yours"))
    states = ("accepted", "running", "successful", "failed", "dismissed")
    for owner in (mine, mine, yours):
        for state in states:
            job = jobs.create(connection, "register-scene", {}, owner=owner.id)
            run_sql(connection, "update job set state = %s where id = %s", [state, job.id])
    assert [tokens.open_jobs(connection, owner.id) for owner in (mine, yours)] == [4, 2]


def test_an_identity_is_kept_once_as_it_first_came_and_takes_no_name(connection):
    first = tokens.keep_subject(connection, "issuer|1", "survey office", ("read", "register"))
    other = tokens.keep_subject(connection, "issuer|2", "survey office", ("read",))
    again = tokens.keep_subject(connection, "issuer|1", "a new name", ("admin",))
    assert (first.subject, first.name, first.scopes) == (
        "issuer|1",
        "survey office",
        ("read", "register"),
    )
    assert again == first != other
    found = [
        tokens.find_subject(connection, subject) for subject in ("issuer|1", "issuer|2", "issuer|3")
    ]
    assert found == [first, other, None]
    assert create_token(connection, "survey office", ["read"]).token.subject is None


def test_owners_and_administrators_alone_may_access_and_list_what_is_owned(connection):
    callers = {
        scope: create_token(connection, f"a token to {scope}", [scope]).token for scope in ALLOWED
    }
    for scope, caller in callers.items():
        assert may_access(caller, caller.id)
        assert may_access(caller, None) == (scope == "admin")
        assert owner_filter(caller) == (None if scope == "admin" else caller.id)
        assert is_administrator(caller) == (scope == "admin")
        for other in callers.values():
            assert may_access(caller, other.id) == (scope == "admin" or other is caller)
    assert not is_administrator(None)


@pytest.mark.parametrize("own", ALLOWED)
def test_a_scope_that_is_missing_is_named_to_the_caller_who_lacks_it(connection, own):
    token = create_token(connection, "survey office", [own]).token
    for scope in Scope:
        if scope in ALLOWED[own]:
            assert require(token, scope) is token
        else:
            with pytest.raises(NotAllowed, match=f"needs scope {scope}") as refused:
                require(token, scope)
            assert refused.value.authenticated


def test_a_request_without_a_token_is_refused(connection):
    with pytest.raises(NotAllowed) as refused:
        require(None, Scope.READ)
    assert not refused.value.authenticated


@pytest.mark.thorough
def test_the_command_line_makes_lists_and_revokes(dsn):
    made = amers(dsn, "token", "create", "survey office", "--scope", "read", "--days", "7", "--json")
    assert made.returncode == 0, made.stderr
    record = json.loads(made.stdout)
    with engine.connect(dsn) as connection:
        assert authenticate(connection, record["secret"]).name == "survey office"
    left = datetime.fromisoformat(record["expires_at"]) - datetime.now(UTC)
    assert timedelta(days=6, hours=23) < left <= timedelta(days=7)

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
    command = [sys.executable, "-m", "amers", *arguments]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
