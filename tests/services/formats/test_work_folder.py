"""The folder of intermediate results: whole results or none, of the same inputs."""

from pathlib import Path

import numpy as np
import pytest

from amers.services.errors import FormatError, InputError
from amers.services.formats.work_folder import WorkFolder

INPUTS = {"images": ["a.tif", "b.tif"], "version": "1"}


def test_a_result_is_read_as_it_was_written(tmp_path: Path) -> None:
    folder = WorkFolder(tmp_path / "work", INPUTS)
    folder["features/000001"] = {"row": np.arange(5), "none": np.empty((0, 128), np.uint8)}
    again = WorkFolder(tmp_path / "work", INPUTS)
    assert list(again) == ["features/000001"]
    np.testing.assert_array_equal(again["features/000001"]["row"], np.arange(5))
    assert again["features/000001"]["none"].shape == (0, 128)
    assert "features/000002" not in again


def test_a_result_that_was_not_finished_is_not_there(tmp_path: Path) -> None:
    folder = WorkFolder(tmp_path / "work", INPUTS)
    with pytest.raises(ValueError, match="Object arrays"):
        folder["cut/1"] = {"first": np.arange(3), "second": np.array([object()])}
    assert "cut/1" not in folder
    assert list(folder) == []
    assert list((tmp_path / "work" / "cut").iterdir()) == []


def test_results_of_other_inputs_are_refused_by_name(tmp_path: Path) -> None:
    WorkFolder(tmp_path / "work", INPUTS)
    with pytest.raises(InputError, match=r"b\.tif.* there, .*c\.tif.* now.*--work"):
        WorkFolder(tmp_path / "work", {**INPUTS, "images": ["a.tif", "c.tif"]})


def test_results_take_no_more_than_they_may_with_those_that_are_there(tmp_path: Path) -> None:
    WorkFolder(tmp_path / "work", INPUTS)["pairs/1"] = {"first": np.zeros(1000)}
    again = WorkFolder(tmp_path / "work", INPUTS, most_bytes=20_000)
    again["pairs/2"] = {"first": np.zeros(1000)}
    with pytest.raises(InputError, match=r"more than the 20,000 bytes"):
        again["pairs/3"] = {"first": np.zeros(1000)}
    assert list(again) == ["pairs/1", "pairs/2"]


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "letter.txt").write_text("dear")
    with pytest.raises(InputError, match=r"not a work folder"):
        WorkFolder(tmp_path, INPUTS)
    assert [file.name for file in tmp_path.iterdir()] == ["letter.txt"]


def test_a_damaged_result_names_its_file(tmp_path: Path) -> None:
    folder = WorkFolder(tmp_path / "work", INPUTS)
    folder["features/1"] = {"row": np.arange(5)}
    file = tmp_path / "work" / "features" / "1" / "row.npy"
    file.write_bytes(file.read_bytes()[:40])
    with pytest.raises(FormatError, match=r"row\.npy: damaged"):
        folder["features/1"]
