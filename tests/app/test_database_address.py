"""The address of a database: no part of its password is ever shown, whatever the password is."""

from string import punctuation

import psycopg
import pytest
from psycopg.conninfo import conninfo_to_dict

from amers.app.cli.failures import failure
from amers.app.db import session
from amers.app.db.address import check_address, unreachable
from amers.app.errors import InputError

ODD = (
    *punctuation,
    " ",
    "é",
    "%41",
    "%2F",
    "%zz",
    "=x ",
    "' ",
    "\\'",
    "@/",
    "/@",
    "?a=",
    "&a=",
    ":1/",
    "[:",
)
PASSWORDS = [
    password
    for odd in ODD
    for password in (f"{odd}QzvKjw", f"QzvK{odd}jwXg", f"QzvKjw{odd}", f"Qzv{odd}Kjw{odd}Xgq")
]
FORMS = (
    "postgresql://app:{}@127.0.0.1:1/gcp",
    "postgres://app:{}@127.0.0.1:1/gcp?connect_timeout=2",
    "postgresql://app:{}@[::1]:1/gcp",
    "postgresql://127.0.0.1:1/gcp?user=app&password={}",
    "postgresql://127.0.0.1:1?user=app&password={}",
    "host=127.0.0.1 port=1 user=app password={} dbname=gcp",
    "host=127.0.0.1 port=1 user=app password='{}' dbname=gcp",
    "password={} host=127.0.0.1 port=1 user=app dbname=gcp",
    "postgresql://app:{}",
    "postgresql://{}@127.0.0.1:1/gcp?user=app",
    "{}",
)
SECRET = "QzvKjwXg"
"""Letters of the passwords: no piece of three of them is in any word of a message."""


def pieces(password: str) -> set[str]:
    """The pieces of three characters of a password that tell something of it."""
    found = {password[i : i + 3] for i in range(len(password) - 2)}
    return {piece for piece in found if set(piece) & set(SECRET)}


def said_of(address: str) -> str:
    """What a command says that cannot use an address."""
    try:
        check_address(address)
        session.connect(address).close()
    except InputError as error:
        return failure(error)[0]
    except psycopg.OperationalError as error:
        return failure(unreachable(error, address))[0] + failure(error)[0]
    raise AssertionError("nothing listens there")


@pytest.mark.parametrize("form", FORMS)
def test_no_piece_of_a_password_is_shown_wherever_an_odd_character_is(form: str):
    for password in PASSWORDS:
        address = form.format(password)
        if form.endswith(":{}") and "@" in password:
            continue  # in every respect an address with a shorter password
        if "127.0.0.1" not in address and "[::1]" not in address:
            with pytest.raises(InputError) as refused:
                check_address(address)
            said = str(refused.value)
        else:
            said = said_of(address)
        shown = {piece for piece in pieces(password) if piece in said}
        assert shown == set(), (address, said)


@pytest.mark.parametrize(
    "address",
    [
        "postgresql://app:secret@db.example:5432/gcp",
        "postgresql://app:p%40ss%2Fw@db.example/gcp?sslmode=verify-full",
        "postgresql://app:a?b#c:d@db.example/gcp",
        "postgresql://app@a.example:5432,b.example:5433/gcp?target_session_attrs=read-write",
        "postgresql://%2Fvar%2Frun%2Fpostgresql/gcp",
        "postgresql:///gcp?host=/tmp",
        "postgresql://[2001:db8::1]:5432/gcp",
        "host=a,b port=1,2 dbname=gcp password='a b'",
        "dbname=gcp",
        "",
    ],
)
def test_usual_addresses_are_read(address: str):
    check_address(address)
    conninfo_to_dict(address)


def test_an_address_that_takes_exponential_time_to_match_is_refused_at_once():
    with pytest.raises(InputError):
        check_address(f"postgresql://{'a' * 50_000}!/gcp")
