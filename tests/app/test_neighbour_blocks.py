"""A block made beside another from some of the same images: files, command, refusals, one seam."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from amers.app.errors import InputError
from amers.app.usecases.control_files import IMAGES_NPZ, ControlFiles, control_inputs
from amers.app.usecases.image_production import ProductionImages, run_image_production
from amers.app.usecases.new_block import BlockIdentity
from amers.app.usecases.registration.joined_scenes import SCENES_JSON, Member, format_scenes, read_joined
from amers.app.usecases.registration.register import SceneFiles
from amers.services.adjustment.known_images import KnownImages
from amers.services.errors import FormatError
from amers.services.formats.adjusted_images import read_adjusted_images, write_adjusted_images
from amers.services.formats.images.raster import write_raster
from amers.services.production.image_production import Production
from amers.services.sensors.displacement import DisplacementGrid
from amers.services.types import Array, Frame
from tests.command_line import amers_here
from tests.services.simulated import BLOCK_SIGMA_M, OPTIONS, block_views
from tests.services.ties import difference_m

NO_CONTROL = ControlFiles()
MOVED = DisplacementGrid(np.arange(5.0), np.array([0.0, 9.0]), np.ones((5, 2, 2)), np.ones((5, 2, 2)))
KNOWN = KnownImages(
    ("a", "b é"),
    (("line shift", "sample shift"), ("roll", "pitch", "yaw", "roll drift", "radial", "focal length")),
    np.arange(12.0).reshape(2, 6),
    np.eye(12) * 0.01,
    Frame.from_sigmas(0.5, 1.0),
    np.ones((2, 18, 3)),
    np.ones((2, 18, 2)),
    (None, MOVED),
)


def test_adjusted_images_come_back_as_they_were_written(tmp_path) -> None:
    write_adjusted_images(tmp_path / IMAGES_NPZ, "block", KNOWN)
    block, known = read_adjusted_images(tmp_path / IMAGES_NPZ)
    assert (block, known.names, known.parameters) == ("block", KNOWN.names, KNOWN.parameters)
    for name in ("values", "relative", "ground", "line_sample"):
        np.testing.assert_array_equal(getattr(known, name), getattr(KNOWN, name))
    np.testing.assert_array_equal(known.frame.covariance_m2, KNOWN.frame.covariance_m2)
    place = np.random.default_rng(0).uniform(0.0, 9.0, (5, 2))
    moved, expected = known.displacement("b é"), KNOWN.displacements[1]
    assert known.displacement("a") is None
    assert moved is not None
    assert expected is not None
    np.testing.assert_array_equal(moved.at(place), expected.at(place))
    np.testing.assert_array_equal(moved.variance_at(place), expected.variance_at(place))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"relative": np.eye(11)}, "do not fit each other"),
        ({"parameters": (("roll",), ("roll", "pitch"))}, "do not fit each other"),
        ({"relative": np.eye(12) * np.nan}, "finite ones expected"),
        ({"displacements": (None, replace(MOVED, line=np.arange(4.0)))}, "does not fit its nodes"),
        ({"displacements": (None, replace(MOVED, line=np.full(5, np.nan)))}, "finite ones expected"),
        ({"frame": Frame.from_sigmas(0.5, np.nan)}, "finite ones expected"),
        ({"values": np.array([[object()] * 6] * 2)}, "adjusted images of a block expected"),
    ],
)
def test_damaged_images_are_refused(tmp_path, change, message) -> None:
    write_adjusted_images(tmp_path / IMAGES_NPZ, "block", replace(KNOWN, **change))
    with pytest.raises(FormatError, match=message):
        read_adjusted_images(tmp_path / IMAGES_NPZ)


def test_a_folder_without_images_is_named(tmp_path) -> None:
    with pytest.raises(FormatError, match=r"images\.npz: the adjusted images .*`amers production run`"):
        read_adjusted_images(tmp_path / IMAGES_NPZ)
    (tmp_path / IMAGES_NPZ).write_bytes(b"PK no archive")
    with pytest.raises(FormatError, match=r"images\.npz: the adjusted images of a block expected"):
        read_adjusted_images(tmp_path / IMAGES_NPZ)


def test_scenes_that_others_join_come_back_as_they_were_written(tmp_path) -> None:
    """With all that reads them again, but for those that their adjustment does not know."""
    files = SceneFiles(
        tmp_path / "a.tif",
        model=tmp_path / "a.xml",
        sigma_m=3.5,
        bands="4,3,2",
        mask=tmp_path / "clouds.tif",
        rigorous="attitude",
    )
    known = (
        Member("a", str(files.image), files, (-12.5, 410.0)),
        Member("b é", "5f0c", SceneFiles(Path("5f0c")), (0.0, 1.0)),
    )
    unknown = replace(known[1], name="c")
    write_adjusted_images(tmp_path / IMAGES_NPZ, "block", KNOWN)
    (tmp_path / SCENES_JSON).write_text(format_scenes([*known, unknown]))
    joined = read_joined(tmp_path)
    assert joined.members == known
    assert joined.known.names == KNOWN.names


def in_image(production: Production, name: str, line_sample: Array) -> Array:
    """Where (n, 3) an adjusted image of a block places some of its pixels."""
    names = [fit.name for fit in production.image_fits]
    return production.adjustment.models[names.index(name)].locate(line_sample, np.full(9, 100.0))


@pytest.mark.long
@pytest.mark.endurance
def test_a_block_beside_another_continues_it(tmp_path) -> None:
    """Each of two images, one of them common: it lies in both blocks in one place."""
    files = []
    for view in block_views():
        files.append(tmp_path / f"{view.geometry.acquisition.image_id}.tif")
        write_raster(files[-1], view.pixels, view.geometry.delivered)

    def made(name: str, images: list[Path], control: ControlFiles = NO_CONTROL) -> Production:
        given = ProductionImages(tuple(images), sigma_m=BLOCK_SIGMA_M, control=control)
        return run_image_production(given, tmp_path / name, BlockIdentity(name), OPTIONS)

    one = made("one", files[:2])
    tied = made("tied", files[1:], ControlFiles(neighbour=tmp_path / "one.adjustment"))
    free = made("free", files[1:])
    side = np.linspace(50.0, 650.0, 3)
    pixels = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    common = files[1].stem
    places = [in_image(made_of, common, pixels) for made_of in (one, tied, free)]
    step, free_step = (np.abs(difference_m(place, places[0])).max() for place in places[1:])
    print(f"the common image lies {step:.2f} m apart, without the tie {free_step:.2f} m")
    frames = [made_of.adjustment.frames[0] for made_of in (one, tied, free)]
    assert step < 0.5 * free_step
    print([np.sqrt(np.diagonal(frame.covariance_m2)).round(2).tolist() for frame in frames])
    # All may be of one pass, and share their errors: together they place the ground no better.
    assert 0.9 * frames[0].sigma_m < frames[1].sigma_m < 1.25 * frames[0].sigma_m
    document = (tmp_path / "tied" / "block.json").read_text()
    assert "1 images of a neighbouring block" in document
    both = ControlFiles((tmp_path / "one",), neighbour=tmp_path / "one.adjustment")
    with pytest.raises(InputError, match=r"one: given as control and as neighbour.*--neighbour"):
        made("twice", files[1:], both)
    assert control_inputs(both)["neighbour"] != control_inputs(ControlFiles())["neighbour"]


def test_the_command_names_a_neighbour_that_is_none(tmp_path) -> None:
    view = block_views()[0]
    images = [tmp_path / "a.tif", tmp_path / "b.tif"]
    for image in images:
        write_raster(image, view.pixels, view.geometry.delivered)
    given = [word for image in images for word in ("--images", image)]
    words = ["production", "run", *given, "--neighbour", tmp_path, "-o", tmp_path / "block"]
    ended = amers_here(words, os.environ)
    assert ended.returncode != 0
    assert "adjusted images of a block expected" in " ".join(ended.stderr.split())
