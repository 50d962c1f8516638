"""Models and places that options name for one of several images."""

import os
from pathlib import Path

import pytest

from amers.app.cli.scene_registration import images_of
from amers.app.errors import InputError
from amers.app.usecases.model_choice import ModelChoice
from tests.command_line import amers_here
from tests.services.formats.statements.scene_files import (
    SHAPE,
    dim,
    write,
    write_image,
)


def test_one_image_takes_a_file_and_one_of_several_by_its_name(tmp_path: Path) -> None:
    first, second = tmp_path / "a.tif", tmp_path / "b=1.tif"
    model = write(tmp_path / "m=1.txt", "x")
    assert ModelChoice((str(model),), ("8192,0",)).of([first]) == {first: (model, (8192.0, 0.0))}
    for name in ("a", "a.tif", str(first)):
        chosen = ModelChoice((f"{name}={model}",), (f"{name}=0,0",)).of([first, second])
        assert chosen == {first: (model, (0.0, 0.0)), second: (None, None)}


@pytest.mark.parametrize(
    ("model", "origin", "message"),
    [
        (("m.txt",), (), "belongs to 0 of 2 images: name the image"),
        (("c=m.txt",), (), "belongs to 0 of 2 images"),
        (("a=none.txt",), (), "none.txt: no such file"),
        ((), ("a=8192",), "'8192' found, LINE,SAMPLE expected, such as 8192,0"),
        ((), ("a=1,2", "a.tif=1,2"), "given twice for a.tif"),
    ],
)
def test_what_belongs_to_no_image_is_refused(
    tmp_path: Path, model: tuple[str, ...], origin: tuple[str, ...], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        ModelChoice(model, origin).of([tmp_path / "a.tif", tmp_path / "b.tif"])


def test_a_folder_of_a_product_in_tiles_is_one_scene(tmp_path: Path) -> None:
    files = [(f"IMG_a_R{row}C1.TIF", row, 1) for row in (1, 2)]
    for name, _, _ in files:
        write_image(tmp_path / name)
    document = write(tmp_path / "DIM_a.XML", dim(files, (120, 80), SHAPE))
    other = write_image(tmp_path / "b.tif")
    assert images_of([tmp_path]) == [document, other]


@pytest.mark.parametrize(
    "command",
    [
        "scene register",
        "scene register-many",
        "points experiment",
        "points intersect",
        "scene ortho",
        "vectors correct",
        "vectors project",
        "production run",
        "production points",
        "block frame",
    ],
)
def test_every_command_that_reads_images_names_models_alike(command: str) -> None:
    help_text = amers_here([*command.split(), "--help"], os.environ).stdout
    assert "--model" in help_text
    assert "--crop-origin" in help_text
