"""Files of marked points as control: matched to the images by name, or refused with the way out."""

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio

from amers.app.errors import InputError
from amers.app.usecases.control_files import ControlFiles, HeightFile, control_inputs, read_control
from amers.app.usecases.marked_files import PointStatements, read_marked
from amers.app.usecases.terrain_file import TerrainFile
from amers.services.errors import FormatError, VerticalDatumError
from amers.services.formats.gcp.reader import StatedByCaller
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage
from amers.services.production.control import Control
from amers.services.types import Acquisition
from tests.geotiffs import write_geotiff
from tests.services.simulated import ring_of_geometries

IMAGES = [Path("one.tif"), Path("two.tif")]
STATED = PointStatements(StatedByCaller("ellipsoid"), sigma_m=(0.5, 0.8), frame_sigma_m=(0.05, 0.1))
CSV = """# pixel-origin=corner
id,lon,lat,height_m,image,line,sample
A,10.001,45.001,120.5,one.tif,10.5,20.5
A,10.001,45.001,120.5,two,30,40
B,10.002,45.002,121,two,50,60
"""


def scenes() -> list[Scene]:
    pixels = np.zeros((100, 200), dtype=np.float32)
    return [
        Scene(ArrayImage(pixels), geometry.rpc, Acquisition(path.stem), 5.0)
        for path, geometry in zip(IMAGES, ring_of_geometries(2), strict=True)
    ]


def written(folder: Path, text: str, name: str = "survey.csv") -> list[Path]:
    path = folder / name
    path.write_text(text)
    return [path]


def test_marks_of_a_point_are_collected_over_the_images(tmp_path: Path) -> None:
    marked = read_marked(written(tmp_path, CSV), STATED, scenes(), IMAGES)
    assert marked.names == ("survey.csv:A", "survey.csv:B")
    assert marked.marks.point.tolist() == [0, 0, 1]
    assert marked.marks.image.tolist() == [0, 1, 1]
    # The corner of the first pixel is (0, 0) in the file, its centre inside.
    assert marked.marks.line_sample.tolist() == [[10.0, 20.0], [29.5, 39.5], [49.5, 59.5]]
    assert marked.marks.sigma_px.tolist() == [0.5] * 3
    assert marked.sigma_m.tolist() == [[0.5, 0.5, 0.8]] * 2
    assert np.sqrt(np.diagonal(marked.frame.covariance_m2)).tolist() == [0.05, 0.05, 0.1]


def test_a_line_without_a_mark_adds_nothing_to_a_point_with_another_mark(tmp_path: Path) -> None:
    marked = read_marked(written(tmp_path, CSV.replace("10.5,20.5", ",")), STATED, scenes(), IMAGES)
    assert marked.names == ("survey.csv:A", "survey.csv:B")
    assert marked.marks.image.tolist() == [1, 1]


def test_sigmas_of_the_file_win_over_those_of_the_command(tmp_path: Path) -> None:
    text = "\n".join(
        line + end
        for line, end in zip(
            CSV.splitlines(),
            ["", ",sigma_horizontal_m,sigma_px", ",0.2,0.1", ",0.2,0.1", ",,"],
            strict=True,
        )
    )
    marked = read_marked(written(tmp_path, text), STATED, scenes(), IMAGES)
    assert marked.sigma_m.tolist() == [[0.2, 0.2, 0.8], [0.5, 0.5, 0.8]]
    assert marked.marks.sigma_px.tolist() == [0.1, 0.1, 0.5]


def test_a_file_that_names_no_image_is_of_the_image_of_its_name(tmp_path: Path) -> None:
    text = "\n".join(",".join(line.split(",")[:4] + line.split(",")[5:]) for line in CSV.splitlines())
    text = text.replace("\nA,10.001,45.001,120.5,30,40", "")
    paths = written(tmp_path, text, "one.csv") + written(tmp_path, text, "two.tif.csv")
    marked = read_marked(paths, STATED, scenes(), IMAGES)
    assert marked.marks.point.tolist() == [0, 0, 1, 1]
    assert sorted(marked.marks.image.tolist()) == [0, 0, 1, 1]
    with pytest.raises(InputError, match=r"call it like its image, such as one\.csv"):
        read_marked(written(tmp_path, text), STATED, scenes(), IMAGES)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("one.tif", "three.tif", r"marks in three\.tif, expected names .* one, two"),
        ("50,60", ",", r"1 points have no position in any image: B\. .*amers production points"),
        ("50,60", "50,201", r"point B: line 49\.5, sample 200\.5 found, outside two with 100 lines"),
        ("B,10.002,45.002,121", "B,10.002,45.002,", r"no height .* survey\.csv:B"),
    ],
)
def test_what_cannot_be_control_is_refused_by_name(tmp_path, old, new, message) -> None:
    paths = written(tmp_path, CSV.replace(old, new))
    with pytest.raises(InputError, match=message):
        read_marked(paths, STATED, scenes(), IMAGES)


@pytest.mark.parametrize(
    ("unstated", "error", "message"),
    [
        ({"frame_sigma_m": None}, InputError, r"--control-frame-sigma-m HORIZONTAL,UP"),
        ({"sigma_m": None}, InputError, r"no sigma east, north, up .*--control-sigma-m HORIZONTAL,UP"),
        ({"stated": StatedByCaller()}, VerticalDatumError, r"datum of its heights"),
    ],
)
def test_accuracy_and_datum_are_never_invented(tmp_path, unstated, error, message) -> None:
    with pytest.raises(error, match=message):
        read_marked(written(tmp_path, CSV), replace(STATED, **unstated), scenes(), IMAGES)


def test_everything_that_nobody_states_is_named_at_once_in_the_order_of_the_options(tmp_path) -> None:
    text = CSV.replace("lon,lat", "x,y").replace("# pixel-origin=corner\n", "")
    nothing = PointStatements(StatedByCaller(options="--control-"))
    with pytest.raises(InputError) as refused:
        read_marked(written(tmp_path, text), nothing, scenes(), IMAGES)
    options = ["--control-vertical", "--control-crs", "pixel-origin"]
    places = [str(refused.value).find(option) for option in options]
    assert -1 < places[0] < places[1] < places[2]
    with pytest.raises(InputError) as refused:
        read_marked(written(tmp_path, CSV), nothing, scenes(), IMAGES)
    options = ["--control-sigma-m", "--control-frame-sigma-m", "--control-vertical"]
    places = [str(refused.value).find(option) for option in options]
    assert -1 < places[0] < places[1] < places[2]
    assert str(refused.value).startswith("3 statements are missing: (1) ")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("50,60", "5000,4500", r"1 of 3 marks lie outside\); these are coordinates of a map"),
        ("10.002,45.002", "43.621,5.382", r"seem exchanged: none of 3 points .* 1 do with both"),
    ],
)
def test_marks_and_points_of_elsewhere_are_refused_at_once(tmp_path, old, new, message) -> None:
    with pytest.raises(InputError, match=message):
        read_marked(written(tmp_path, CSV.replace(old, new)), STATED, scenes(), IMAGES)


def test_images_with_paths_are_matched_by_their_file_names(tmp_path: Path) -> None:
    text = CSV.replace("one.tif", "C:\\work\\ONE.TIF").replace("two", "/home/user/two.tif")
    marked = read_marked(written(tmp_path, text), STATED, scenes(), IMAGES)
    assert marked.marks.image.tolist() == [0, 1, 1]


def test_marks_without_an_origin_of_pixels_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="pixel-origin"):
        read_marked(
            written(tmp_path, CSV.replace("# pixel-origin=corner\n", "")), STATED, scenes(), IMAGES
        )


def test_statements_without_a_file_of_points_and_missing_paths_are_refused(tmp_path: Path) -> None:
    with ExitStack() as stack:
        with pytest.raises(InputError, match="no --control is a file of points"):
            read_control(ControlFiles((), STATED), scenes(), IMAGES, stack)
        with pytest.raises(
            InputError, match="does not exist; expected the folder of a block, or a file of points"
        ):
            read_control(ControlFiles((tmp_path / "x",), STATED), scenes(), IMAGES, stack)
        assert read_control(ControlFiles(), scenes(), IMAGES, stack).marked == ()


def map_file(folder: Path, name: str) -> Path:
    path = folder / name
    place = rasterio.Affine(10.0, 0.0, 500000.0, 0.0, -10.0, 5000000.0)
    write_geotiff(path, np.ones((1, 20, 20), dtype=np.float32), crs="EPSG:32633", transform=place)
    return path


def control_of(files: ControlFiles) -> Control:
    with ExitStack() as stack:
        return read_control(files, scenes(), IMAGES, stack)


def test_the_accuracy_of_an_ortho_image_is_that_of_its_product_or_stated(tmp_path: Path) -> None:
    unknown, product = (
        map_file(tmp_path, "map.tif"),
        map_file(tmp_path, "T33UUU_20190405T101031_B04.tif"),
    )
    with pytest.raises(
        InputError, match=r"map\.tif: the accuracy .* is not stated: .*--control-ortho-sigma-m"
    ):
        control_of(ControlFiles(orthos=(unknown,)))
    assert control_of(ControlFiles(orthos=(product,))).orthos[0].reference.frame.sigma_m > 5.0
    stated = control_of(ControlFiles(orthos=(unknown,), ortho_sigma_m=2.0)).orthos[0]
    assert stated.reference.frame.sigma_m == 2.0
    assert np.isnan(stated.reference.frame.sigma_up_m)


def test_the_pieces_of_an_ortho_image_are_one_control(tmp_path: Path) -> None:
    (tmp_path / "tiles").mkdir()
    first = map_file(tmp_path / "tiles", "a_B04.tif")
    second = map_file(tmp_path / "tiles", "b_B04.tif")
    with rasterio.open(second, "r+") as raster:
        raster.transform = rasterio.Affine(10.0, 0.0, 500200.0, 0.0, -10.0, 5000000.0)
    files = ControlFiles(orthos=(tmp_path / "tiles",), ortho_sigma_m=2.0)
    (ortho,) = control_of(files).orthos
    assert (ortho.name, ortho.reference.image.shape) == ("tiles", (20, 40))
    (facts,) = control_inputs(files)["orthos"]
    assert [Path(path) for path, _ in facts["pieces"]] == [first, second]


@pytest.mark.parametrize(
    ("stated", "error", "message"),
    [
        ({"sigma_m": None}, InputError, r"dem\.tif: the accuracy .*--control-dem-sigma-m"),
        ({"frame_sigma_m": None}, InputError, r"--control-dem-frame-sigma-m HORIZONTAL,UP"),
        ({"vertical": None}, InputError, r"vertical datum.*--control-dem-vertical"),
    ],
)
def test_heights_of_unknown_accuracy_or_datum_are_refused(tmp_path, stated, error, message) -> None:
    values = {"sigma_m": 1.0, "frame_sigma_m": (5.0, 2.0), "vertical": "ellipsoid", **stated}
    terrain = TerrainFile(map_file(tmp_path, "dem.tif"), values.pop("vertical"))
    with pytest.raises(error, match=message):
        control_of(ControlFiles(heights=HeightFile(terrain, **values)))
