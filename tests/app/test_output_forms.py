"""The forms of values and records: for people, on pipes, and in JSON."""

import json
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from uuid import UUID

import pytest

from amers.app.cli import output

MOMENT = datetime(2026, 3, 4, 5, 6, 7, 891000, UTC)
ROWS = [
    {"name": "a", "CE90 (m)": 1.5, "ends at": None},
    {"name": "b\tc\nd", "CE90 (m)": (2, "x"), "ends at": MOMENT},
]


@dataclass
class Record:
    """Two fields."""

    first: int
    second: Path


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "-"),
        (0, "0"),
        (False, "False"),
        ("", ""),
        (MOMENT, "2026-03-04 05:06:07+00:00"),
        ([1, None, "x"], "1, -, x"),
        ((MOMENT, [2, 3]), "2026-03-04 05:06:07+00:00; 2, 3"),
        ({"only"}, "only"),
        (frozenset(("only",)), "only"),
        ((), ""),
        (Path("a/b"), "a/b"),
    ],
)
def test_a_value_has_a_text_for_people(value: object, text: str) -> None:
    assert output.as_text(value) == text


@pytest.mark.parametrize(
    ("size_bytes", "text"),
    [
        (0, "0 B"),
        (1023, "1023 B"),
        (1024, "1.0 KiB"),
        (1536, "1.5 KiB"),
        (2**20 - 1024, "1023.0 KiB"),
        (2**20, "1.0 MiB"),
        (2**30, "1.0 GiB"),
        (5 * 2**39, "2.5 TiB"),
        (2**51, "2048.0 TiB"),
    ],
)
def test_a_size_is_told_in_the_largest_unit_of_which_it_has_one(size_bytes: int, text: str) -> None:
    assert output.as_size(size_bytes) == text


@pytest.mark.parametrize(
    ("value", "document"),
    [
        (Record(1, Path("a/b")), {"first": 1, "second": "a/b"}),
        (MOMENT, "2026-03-04T05:06:07.891000+00:00"),
        (UUID(int=1), "00000000-0000-0000-0000-000000000001"),
        ({"c", "a", "b"}, ["a", "b", "c"]),
        (frozenset((3, 1, 2)), [1, 2, 3]),
        ([None, 1.5, {"a": True}], [None, 1.5, {"a": True}]),
    ],
)
def test_a_value_has_a_form_in_json(
    value: object, document: object, capsys: pytest.CaptureFixture[str]
) -> None:
    output.print_json({"member": value})
    printed = capsys.readouterr().out
    assert json.loads(printed) == {"member": document}
    assert printed.startswith('{\n  "member": ')


@pytest.mark.parametrize(
    ("value", "kind"), [(float("nan"), ValueError), (timedelta(1), TypeError), (Record, TypeError)]
)
def test_what_has_no_form_in_json_is_refused(value: object, kind: type[Exception]) -> None:
    with pytest.raises(kind):
        output.print_json([value])


def shown(rows: list[output.Row], capsys: pytest.CaptureFixture[str]) -> list[str]:
    output.show(rows, as_json=False)
    return capsys.readouterr().out.splitlines()


def test_records_on_a_pipe_are_lines_of_fields_and_none_are_nothing(
    capsys: pytest.CaptureFixture[str],
) -> None:
    head, first, second = shown(ROWS, capsys)
    assert head == "name\tce90_m\tends_at"
    assert first == "a\t1.5\t-"
    assert second.split("\t")[1:] == ["2, x", "2026-03-04 05:06:07+00:00"]
    assert shown([], capsys) == []


def test_records_on_a_terminal_are_a_table_and_none_are_said_to_be_none(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "100")
    lines = shown(ROWS, capsys)
    assert all(name in lines[1] for name in ROWS[0])
    assert [cell.strip() for cell in lines[3].strip("│").split("│")] == ["a", "1.5", "-"]
    assert "2026-03-04 05:06:07+00:00" in lines[4]
    assert shown([], capsys) == ["none"]


def test_the_fields_of_a_record_are_lines_with_their_values_below_each_other(
    capsys: pytest.CaptureFixture[str],
) -> None:
    statement = {"file": "a.tif", "what": "height", "words": "assumed"}
    output.show_one({"a": 1, "longer": None}, as_json=False)
    assert capsys.readouterr().out == "a       1\nlonger  -\n"
    output.show_one({}, as_json=False)
    assert capsys.readouterr().out == ""
    output.show_one({"a": 1, "statements": [statement]}, as_json=True)
    assert json.loads(capsys.readouterr().out) == {"a": 1, "statements": [statement]}
