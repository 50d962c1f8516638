"""The notebooks of the examples: what the files contain, and the outputs of a new run.

`make notebooks` writes the outputs.
"""

import ast
import base64
import io
import re
from pathlib import Path

import nbformat
import numpy as np
import pytest
from nbformat.v4 import new_code_cell, new_notebook, new_output
from PIL import Image

import amers
from scripts.run_notebooks import (
    EXAMPLES,
    LARGEST_PICTURE,
    METADATA,
    copy_examples,
    differences,
    names,
    outputs,
    read,
    run,
    same_picture,
    same_text,
    small_png,
)

NAMES = names()
MODULES = {"amers", "gallery_files", "geopandas", "json", "matplotlib", "numpy", "rasterio", "shutil"}


def png(grey: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(grey.astype(np.uint8)).save(file, "PNG")
    return file.getvalue()


def a_notebook(text: str, grey: np.ndarray) -> nbformat.NotebookNode:
    """A notebook that has printed a text and drawn a picture."""
    picture = base64.b64encode(png(grey)).decode()
    shown = [
        new_output("stream", text=text),
        new_output("display_data", {"image/png": picture, "text/plain": "<Figure>"}),
    ]
    return new_notebook(cells=[new_code_cell("1", outputs=shown)])


def test_there_are_five_notebooks_and_the_page_of_the_examples_lists_them():
    page = (EXAMPLES / "README.md").read_text()
    listed = re.findall(r"\(notebooks/(\w+)\.ipynb\)", page)
    assert sorted(listed) == NAMES
    assert len(NAMES) == 5


@pytest.mark.parametrize("name", NAMES)
def test_a_notebook_is_short_and_uses_public_names(name: str):
    cells = read(name).cells
    assert 8 <= len(cells) <= 15
    assert cells[0].cell_type == "markdown"
    program = ast.parse("\n".join(cell.source for cell in cells if cell.cell_type == "code"))
    imports = [node for node in ast.walk(program) if isinstance(node, ast.Import | ast.ImportFrom)]
    imported = {
        module.partition(".")[0]
        for node in imports
        for module in (
            [node.module or ""] if isinstance(node, ast.ImportFrom) else [one.name for one in node.names]
        )
    }
    assert imported <= MODULES
    used = {
        node.attr
        for node in ast.walk(program)
        if isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and node.value.id == "amers"
    }
    assert used <= set(amers.__all__)


@pytest.mark.parametrize("name", NAMES)
def test_a_file_has_outputs_and_nothing_of_a_machine_or_of_a_time(name: str):
    notebook = read(name)
    assert notebook.metadata == METADATA
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    assert [cell.metadata for cell in notebook.cells] == [{}] * len(notebook.cells)
    kinds = {(one.output_type, one.get("name")) for cell in code for one in cell.outputs}
    assert kinds == {("stream", "stdout"), ("display_data", None)}
    printed, pictures = zip(*map(outputs, code), strict=True)
    assert not re.search(r"(?<![\w.])/(home|root|tmp|work|usr)\b", "".join(printed))
    assert all(len(text.splitlines()) <= 15 for text in printed)
    sizes = [len(picture) for cell in pictures for picture in cell]
    assert len(sizes) >= 2
    assert max(sizes) < LARGEST_PICTURE


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which the notebooks run; they share its images and its block."""
    return copy_examples(tmp_path_factory.mktemp("notebooks"))


@pytest.mark.long
@pytest.mark.thorough
@pytest.mark.parametrize("name", NAMES)
def test_a_new_run_prints_and_draws_what_the_file_has(name: str, work: Path):
    kept = read(name)
    assert differences(kept, run(name, work)) == []


@pytest.mark.parametrize(
    ("text", "other", "is_same"),
    [
        ("CE90 0.32 m", "CE90 0.34 m", True),
        ("CE90 0.32 m", "CE90 0.36 m", False),
        ("CE90 7.12 m", "CE90 7.80 m", True),
        ("CE90 7.12 m", "CE90 7.90 m", False),
        ("53 of 57 points", "51 of 57 points", True),
        ("53 of 57 points", "43 of 57 points", False),
        ("53 of 57  points", "53 of 57 points", True),
        ("good; 0.32 m", "usable; 0.32 m", False),
        ("-0.32", "0.32", False),
        ("view_01", "view_02", False),
        ("1 2", "1", False),
    ],
)
def test_numbers_may_differ_by_a_tenth_and_words_not_at_all(text: str, other: str, is_same: bool):
    assert same_text(text, other) == is_same


def test_pictures_may_differ_a_little_in_size_and_content():
    rng = np.random.default_rng(4)
    grey = np.kron(rng.uniform(0.0, 255.0, (12, 16)), np.ones((25, 25)))
    noisy = np.clip(grey + rng.normal(0.0, 10.0, grey.shape), 0.0, 255.0)
    assert same_picture(png(grey), png(noisy))
    assert same_picture(png(grey), png(grey[:295]))
    assert not same_picture(png(grey), png(grey[:250]))
    assert not same_picture(png(grey), png(grey[::-1]))


def test_each_difference_is_named_with_its_cell():
    grey = np.kron(np.random.default_rng(5).uniform(0.0, 255.0, (6, 8)), np.ones((40, 40)))
    kept, other = a_notebook("3 points\n", grey), a_notebook("9 points\n", grey[:, ::-1])
    assert differences(kept, kept) == []
    assert differences(kept, other) == [
        "cell 1: printed '9 points\\n', '3 points\\n' expected",
        "cell 1: a picture differs",
    ]
    other.cells[0].outputs.pop()
    assert differences(kept, other)[1:] == ["cell 1: 0 pictures, 1 expected"]


def test_a_picture_becomes_small_and_keeps_its_content():
    grey = np.kron(np.random.default_rng(6).uniform(0.0, 255.0, (200, 300)), np.ones((2, 2)))
    large = png(grey)
    assert len(large) > LARGEST_PICTURE
    small = base64.b64decode(small_png(base64.b64encode(large).decode()))
    assert len(small) < LARGEST_PICTURE
    assert same_picture(large, small)
