"""Lines of the log and of commands: no text of callers or files controls a terminal."""

import json
import logging
import sys
import unicodedata
from typing import Literal

import pytest
from fastapi.testclient import TestClient
from hypothesis import given
from hypothesis import strategies as st

from amers.app import logs
from amers.app.cli.failures import failure
from amers.app.errors import InputError
from amers.app.printable import printable

HOSTILE = [
    "\x1b[2Jcleared",
    "\x9b31mC1",
    "bell\x07",
    "deleted\x7f",
    "line\nforged",
    "line\r\nforged",
    "vertical\x0btab\x0cpage",
    "next\x85line",
    "separated\u2028lines\u2029",
    "turned\u202eround\u2066",
    "no\u200bwidth\ufeff",
    "half\ud800",
    "null\x00",
    "tagged\U000e0041",
]
FORMS: list[Literal["text", "json"]] = ["text", "json"]


def logged(form: Literal["text", "json"], message: str, *arguments: object, **extra: object) -> str:
    record = logging.LogRecord("amers", logging.INFO, __file__, 1, message, arguments, None)
    vars(record).update(extra)
    return logs.Lines(form).format(record)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("text", HOSTILE, ids=ascii)
def test_no_text_puts_a_control_character_into_a_line(form: Literal["text", "json"], text: str) -> None:
    assert logged(form, "GET %s", text, agent=text).isprintable()
    assert logged(form, text).isprintable()


@given(st.text(st.characters(codec=None)))
def test_a_line_of_json_keeps_the_text(text: str) -> None:
    line = logged("json", "%s", text, agent=text)
    assert line.isprintable()
    assert json.loads(line)["message"] == text
    assert json.loads(line)["agent"] == text


@given(st.text(st.characters(codec=None)))
def test_a_line_for_people_has_letters_of_all_writings_as_they_are(text: str) -> None:
    shown = printable(text)
    assert shown.isprintable()
    letters = [character for character in text if unicodedata.category(character)[0] in "LMNPS"]
    assert [character for character in letters if character not in shown] == []


@pytest.mark.parametrize("form", FORMS)
def test_an_error_that_quotes_a_caller_forges_no_line(form: Literal["text", "json"]) -> None:
    try:
        raise ValueError("\x1b[2J\n2026-01-01T00:00:00.000Z INFO amers: forged")
    except ValueError:
        record = logging.LogRecord("amers", logging.ERROR, __file__, 1, "failed", (), sys.exc_info())
    lines = logs.Lines(form).format(record).split("\n")
    assert all(line.isprintable() for line in lines)
    assert [line for line in lines[1:] if not line.startswith("    ")] == []


def test_the_path_of_a_request_controls_no_terminal(
    client: TestClient, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO, logger="amers.requests"):
        client.get("/points/%1b%5b2J%0aforged%c2%9b%e2%80%ae", headers={"User-Agent": "\x1b[31m"})
    assert any("\x1b" in record.getMessage() for record in caplog.records)
    for record in caplog.records:
        assert logs.Lines("text").format(record).isprintable()


@pytest.mark.parametrize("text", HOSTILE, ids=ascii)
def test_the_sentence_of_a_command_that_fails_controls_no_terminal(text: str) -> None:
    assert failure(InputError(f"{text}.tif: not an image"))[0].isprintable()
    assert failure(FileNotFoundError(2, "No such file", f"{text}.tif"))[0].isprintable()
