"""What people read of a record: few digits, names with axes and units, no rows without a value."""

import json
import math

import pytest

from amers.app.cli.output import as_text, show, show_one
from amers.app.cli.row_labels import label

MOSAIC = {
    "path": "mosaic.tif",
    "gsd_m": 0.49845472078302133,
    "seen": 0.8133333333333334,
    "left_out": [],
    "pairs": (),
    "renamed": {},
    "vertical": "",
    "seam_step": None,
    "moved_east_north_up_m": [1.25, -0.0004321, None],
    "date_errors_east_north_m": [[0.5, 1.0], [2.0, 0.1]],
}


def lines_of(printed: str) -> dict[str, str]:
    return dict(line.split("  ", 1) for line in printed.splitlines())


def test_a_record_for_people_has_few_digits_units_and_no_empty_rows(
    capsys: pytest.CaptureFixture[str],
) -> None:
    show_one(MOSAIC, as_json=False)
    shown = {name: text.strip() for name, text in lines_of(capsys.readouterr().out).items()}
    assert shown == {
        "path": "mosaic.tif",
        "pixel size (m)": "0.498",
        "pixels with data (%)": "81.3",
        "seam step": "-",
        "moved in east, north, up (m)": "1.25, -0.000432, -",
        "date errors in east, north (m)": "0.5, 1.0; 2.0, 0.1",
    }


def test_json_keeps_every_digit_and_every_row(capsys: pytest.CaptureFixture[str]) -> None:
    show_one(MOSAIC, as_json=True)
    assert json.loads(capsys.readouterr().out) == MOSAIC | {"pairs": []}


def test_a_backup_without_problems_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    show_one({"files": 3, "damaged": [], "problems": []}, as_json=False)
    shown = lines_of(capsys.readouterr().out)
    assert {name: text.strip() for name, text in shown.items()} == {
        "files": "3",
        "damaged": "none",
        "problems": "none",
    }


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0.0"),
        (8.5, "8.5"),
        (1234.56789, "1234.568"),
        (-0.012345, "-0.0123"),
        (2.5e-7, "0.00000025"),
        (1e-30, "0.0"),
        (math.nan, "-"),
        (math.inf, "-"),
        ({"a": 1.0, "b": [2.0]}, "a: 1.0; b: 2.0"),
    ],
)
def test_numbers_have_the_digits_that_people_read(value: object, text: str) -> None:
    assert as_text(value) == text


def test_lists_on_a_pipe_keep_the_names_of_json(capsys: pytest.CaptureFixture[str]) -> None:
    show([{"gsd_m": 0.49845472, "left_out": []}], as_json=False)
    assert capsys.readouterr().out == "gsd_m\tleft_out\n0.498\t\n"


def test_texts_that_are_no_names_stay_as_they_are() -> None:
    for text in ("On the Earth", "B/H", "image scene_1.tif", "left out: edge_m", "m"):
        assert label(text) == text
    assert label("tie_points") == "tie points"
    assert label("area_km2") == "area (km2)"
