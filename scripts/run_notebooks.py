"""Run the notebooks of the examples and write their outputs: `python -m scripts.run_notebooks [NAME …]`.

The notebooks run in a copy of their folder outside the checkout. The files contain no times, versions or
paths of a machine. `tests/test_notebooks.py` compares the outputs of a new run with those of the files.
"""

import base64
import io
import re
import shutil
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import nbformat
import numpy as np
from nbclient import NotebookClient
from nbformat import NotebookNode
from PIL import Image

EXAMPLES = Path(__file__).parents[1] / "examples"
NOTEBOOKS = EXAMPLES / "notebooks"
METADATA = {
    "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
    "language_info": {"name": "python"},
}
CELL_PATIENCE_S = 1800
COLOURS = (128, 64, 32, 24, 16)
"""Sizes of the palette of a picture; the largest is used with which its file is small enough."""
LARGEST_PICTURE = 60_000
"""Bytes of a PNG."""
NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?")
RELATIVE, LAST_DIGITS = 0.1, 2.0
"""Numbers agree within the larger of a tenth of the kept one and two units of its last digit."""
SAME_SIZE, LEAST_CORRELATION = 0.05, 0.9
"""Pictures agree if their sides do within 5 %, and their grey values on a small grid correlate."""
SMALL = (80, 60)


def names() -> list[str]:
    """The notebooks by name, without suffix."""
    return sorted(path.stem for path in NOTEBOOKS.glob("*.ipynb"))


def read(name: str) -> NotebookNode:
    """A notebook with the outputs that are kept."""
    return nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)


def copy_examples(folder: Path) -> Path:
    """Copy what the notebooks need into a folder; returns the folder in which they run."""
    work = folder / "examples" / "notebooks"
    work.mkdir(parents=True)
    shutil.copy(EXAMPLES / "simulated_images.py", work.parent)
    for path in NOTEBOOKS.glob("*.py"):
        shutil.copy(path, work)
    return work


def run(name: str, work: Path) -> NotebookNode:
    """A notebook with the outputs of a new run in a folder, without what differs between runs.

    Raises:
        CellExecutionError: a cell raises an error.
    """
    notebook = read(name)
    client = NotebookClient(
        notebook,
        timeout=CELL_PATIENCE_S,
        kernel_name="python3",
        resources={"metadata": {"path": str(work)}},
        record_timing=False,
    )
    client.execute()
    return tidied(notebook)


def tidied(notebook: NotebookNode) -> NotebookNode:
    """The notebook with numbered cells, without metadata of a run, with small pictures."""
    notebook.metadata = nbformat.from_dict(METADATA)
    for number, cell in enumerate(notebook.cells, 1):
        cell.id, cell.metadata = f"cell-{number}", NotebookNode()
        for output in cell.get("outputs", []):
            output.metadata = NotebookNode()
            if "image/png" in output.get("data", {}):
                output.data["image/png"] = small_png(output.data["image/png"])
            if output.output_type == "stream":
                output.pop("metadata")
    return notebook


def small_png(text: str) -> str:
    """A picture with a palette and without metadata, as base64.

    Raises:
        ValueError: the picture is too large with every palette.
    """
    picture = Image.open(io.BytesIO(base64.b64decode(text))).convert("RGB")
    for colours in COLOURS:
        file = io.BytesIO()
        method = Image.Quantize.MAXCOVERAGE
        picture.quantize(colours, method, dither=Image.Dither.NONE).save(file, "PNG", optimize=True)
        if file.tell() < LARGEST_PICTURE:
            return base64.b64encode(file.getvalue()).decode()
    raise ValueError(f"picture of {file.tell()} bytes, less than {LARGEST_PICTURE} expected")


def outputs(cell: NotebookNode) -> tuple[str, list[bytes]]:
    """All text that a cell printed, and its pictures."""
    printed, pictures = "", []
    for output in cell.get("outputs", []):
        data = output.get("data", {})
        printed += output.get("text", "") if output.output_type == "stream" else ""
        if "image/png" in data:
            pictures.append(base64.b64decode(data["image/png"]))
        else:
            printed += data.get("text/plain", "")
    return printed, pictures


def differences(kept: NotebookNode, new: NotebookNode) -> list[str]:
    """How the outputs of two runs of a notebook differ by more than the tolerances."""
    different = []
    for number, (before, now) in enumerate(zip(kept.cells, new.cells, strict=True), 1):
        (text, pictures), (new_text, new_pictures) = outputs(before), outputs(now)
        if not same_text(text, new_text):
            different.append(f"cell {number}: printed {new_text!r}, {text!r} expected")
        if len(pictures) != len(new_pictures):
            different.append(f"cell {number}: {len(new_pictures)} pictures, {len(pictures)} expected")
        for picture, new_picture in zip(pictures, new_pictures, strict=False):
            if not same_picture(picture, new_picture):
                different.append(f"cell {number}: a picture differs")
    return different


def same_text(text: str, other: str) -> bool:
    """Whether the words of two texts are equal, and their numbers within the tolerance."""
    words, other_words = (" ".join(NUMBER.sub("0", one).split()) for one in (text, other))
    if words != other_words:
        return False
    pairs = zip(NUMBER.findall(text), NUMBER.findall(other), strict=True)
    return all(abs(float(b) - float(a)) <= tolerance(a) for a, b in pairs)


def tolerance(number: str) -> float:
    """The largest difference from a printed number."""
    decimals = len(number.partition(".")[2])
    return max(RELATIVE * abs(float(number)), LAST_DIGITS * 10.0**-decimals) + 1e-9


def same_picture(png: bytes, other: bytes) -> bool:
    """Whether two pictures have almost the same size, and show the same on a small grid."""
    one, two = (Image.open(io.BytesIO(file)).convert("L") for file in (png, other))
    if any(abs(a - b) > SAME_SIZE * a for a, b in zip(one.size, two.size, strict=True)):
        return False
    grey, other_grey = (np.asarray(picture.resize(SMALL), dtype=np.float64) for picture in (one, two))
    return bool(np.corrcoef(grey.ravel(), other_grey.ravel())[0, 1] >= LEAST_CORRELATION)


def main(wanted: list[str]) -> None:
    """Run the named notebooks, or all, and write them with their new outputs."""
    with TemporaryDirectory() as folder:
        work = copy_examples(Path(folder))
        for name in wanted or names():
            nbformat.write(run(name, work), NOTEBOOKS / f"{name}.ipynb")
            print(name, flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
