"""Chips of GCPLib and of the Copernicus database: where each pixel lies, and what is refused."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import rasterio

from amers.services.errors import FormatError, InputError
from amers.services.formats.gcp.base_chips import (
    ABSENT,
    NO_MAP,
    UNREADABLE,
    WRONG_SIZE,
    WRONG_TYPE,
    open_base_chip,
    read_base_chips,
)
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import Window
from tests.services.chip_bases import (
    base_points,
    brightness,
    north_up,
    write_copernicus,
    write_gcplib,
    write_geotiff,
)

GOLDEN = Path(__file__).parents[3] / "golden"
POINTS = base_points(3)


def shown(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """The pixels of a chip, and the true brightness of the land where its map places them."""
    lines, samples = scene.image.shape
    pixels = scene.image.read(Window(0, 0, lines, samples))
    places = np.stack(np.mgrid[:lines, :samples], axis=-1).reshape(-1, 2).astype(float)
    grid = scene.model.grid  # type: ignore[attr-defined]
    return pixels.ravel(), brightness(grid.xy(places))


def agreement(scene: Scene | str) -> float:
    assert isinstance(scene, Scene)
    return float(np.corrcoef(*shown(scene))[0, 1])


@pytest.mark.parametrize(
    ("origin", "first"), [("centre", 0.0), ("corner", 0.5), ("centre-1", 1.0), ("corner-1", 1.5)]
)
@pytest.mark.parametrize("data_type", ["BYTE", "I*2", "UI*2", "R*4"])
def test_pixels_of_a_gcplib_lie_where_the_record_places_them(
    tmp_path: Path, origin: str, first: float, data_type: str
) -> None:
    path = write_gcplib(tmp_path, POINTS, first=first, data_type=data_type)
    chips = read_base_chips(path, tmp_path / "chips", origin)
    assert [chip.point_id for chip in chips] == [point.name for point in POINTS]
    assert min(agreement(open_base_chip(chip)) for chip in chips) > 0.99
    other = read_base_chips(path, tmp_path / "chips", "centre" if origin != "centre" else "corner-1")
    assert max(agreement(open_base_chip(chip)) for chip in other) < 0.98


def test_chips_of_a_gcplib_have_the_date_and_source_of_their_record(tmp_path: Path) -> None:
    chips = read_base_chips(write_gcplib(tmp_path, POINTS), tmp_path / "chips", "centre-1")
    taken = chips[0].acquisition
    assert (taken.image_id, taken.sensor) == ("GLS_-GRAYSCALE-1999-01-14", "GLS+")
    assert taken.acquired_at is not None
    assert taken.acquired_at.isoformat() == "1999-01-14T12:00:00+00:00"
    assert chips[2].acquisition == taken != chips[1].acquisition


@pytest.mark.parametrize(("origin", "given"), [(None, "nothing"), ("middle", "middle")])
def test_the_origin_of_the_pixels_of_a_gcplib_is_never_guessed(
    tmp_path: Path, origin: str | None, given: str
) -> None:
    path = write_gcplib(tmp_path, POINTS)
    with pytest.raises(InputError, match=rf"{given} given; state it \(--chip-origin\): centre, corner"):
        read_base_chips(path, tmp_path / "chips", origin)


def test_pixels_of_the_copernicus_database_lie_where_their_files_place_them(tmp_path: Path) -> None:
    path = write_copernicus(tmp_path, POINTS, measures=2)
    chips = read_base_chips(path, tmp_path / "chips")
    assert len(chips) == 2 * len(POINTS)
    assert [chip.acquisition.image_id for chip in chips[:2]] == ["GRI-00", "GRI-01"]
    assert min(agreement(open_base_chip(chip)) for chip in chips) > 0.99
    with pytest.raises(InputError, match="leave --chip-origin out"):
        read_base_chips(path, tmp_path / "chips", "centre")


def test_names_of_chips_are_read_in_all_their_forms(tmp_path: Path) -> None:
    names = [
        (chip.point_id, chip.path.name)
        for chip in read_base_chips(GOLDEN / "invented_copernicus.json", tmp_path)
    ]
    assert names == [
        ("11", "11_00.TIF"),
        ("12", "12_00.TIF"),
        ("12", "12_01.TIF"),
        ("13", "13_00.TIF"),
        ("14", "14_00.TIF"),
        ("14", "14_01.TIF"),
        ("15", "15_00.TIF"),
    ]
    text = (GOLDEN / "invented_copernicus.json").read_text().replace("GRI_List", "none")
    (tmp_path / "without.json").write_text(text)
    without = read_base_chips(tmp_path / "without.json", tmp_path)
    assert [chip.path.name for chip in without] == [f"{number}_00.TIF" for number in range(11, 16)]
    gcplib = read_base_chips(GOLDEN / "invented_gcplib.txt", tmp_path, "centre")
    assert [chip.path.name for chip in gcplib] == [f"gcp_{number}.chip" for number in range(11, 16)]


@pytest.mark.parametrize("name", ["../P0.chip", "/etc/passwd", "a/../../P0.chip", "..\\P0.chip"])
def test_a_chip_outside_the_folder_is_refused(tmp_path: Path, name: str) -> None:
    path = write_gcplib(tmp_path, POINTS)
    path.write_text(path.read_text().replace(" P0.chip", f" {name}"))
    with pytest.raises(FormatError, match="a relative path inside the folder of the chips expected"):
        read_base_chips(path, tmp_path / "chips", "centre")
    path = write_copernicus(tmp_path / "other", POINTS)
    path.write_text(path.read_text().replace('"P0_00.TIF"', f'"{name}"'.replace("\\", "\\\\")))
    with pytest.raises(FormatError, match="a relative path inside the folder of the chips expected"):
        read_base_chips(path, tmp_path / "other" / "chips")


def test_a_link_out_of_the_folder_is_refused(tmp_path: Path) -> None:
    path = write_copernicus(tmp_path, POINTS)
    chip = tmp_path / "chips" / "P0_00.TIF"
    chip.rename(tmp_path / "outside.tif")
    chip.symlink_to(tmp_path / "outside.tif")
    with pytest.raises(FormatError, match="symbolic link"):
        read_base_chips(path, tmp_path / "chips")


def as_jpeg_2000(path: Path) -> None:
    path.write_bytes(b"\0\0\0\x0cjP  \r\n\x87\n" + path.read_bytes())


def too_large(path: Path) -> None:
    write_geotiff(path, north_up("EPSG:32633", (4e5, 5.8e6), 10.0, 2000), np.ones((1100, 4), np.uint16))


def without_map(path: Path) -> None:
    with rasterio.open(path, "w", "GTiff", 57, 57, 1, dtype=np.uint16) as file:
        file.write(np.ones((57, 57), np.uint16), 1)


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (Path.unlink, ABSENT),
        (as_jpeg_2000, UNREADABLE),
        (lambda path: path.write_bytes(path.read_bytes()[:200]), UNREADABLE),
        (lambda path: path.write_bytes(b""), UNREADABLE),
        (too_large, WRONG_SIZE),
        (without_map, NO_MAP),
    ],
)
def test_a_geotiff_that_cannot_be_used_has_a_reason(
    tmp_path: Path, damage: Callable[[Path], object], reason: str
) -> None:
    chips = read_base_chips(write_copernicus(tmp_path, POINTS), tmp_path / "chips")
    damage(chips[1].path)
    assert open_base_chip(chips[1]) == reason
    assert isinstance(open_base_chip(chips[0]), Scene)


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        (" 64.000000 64.000000 ", " 64.000000 63.000000 ", WRONG_SIZE),
        (" 64.000000 64.000000 ", " 64.500000 64.000000 ", WRONG_SIZE),
        (" 64.000000 64.000000 ", " 4096.00000 1.0000000 ", WRONG_SIZE),
        (" 64.000000 64.000000 ", " -64.000000 -64.00000 ", WRONG_SIZE),
        (" BYTE", " I*4", WRONG_TYPE),
        (" BYTE", " UI*2", WRONG_SIZE),
        (" UTM 33 ", " ALBERS 0 ", NO_MAP),
    ],
)
def test_a_record_that_does_not_fit_its_file_has_a_reason(
    tmp_path: Path, old: str, new: str, reason: str
) -> None:
    path = write_gcplib(tmp_path, POINTS)
    path.write_text(path.read_text().replace(old, new))
    chips = read_base_chips(path, tmp_path / "chips", "centre")
    assert {str(open_base_chip(chip)) for chip in chips} == {reason}


def test_pixels_of_zero_have_no_data(tmp_path: Path) -> None:
    path = write_gcplib(tmp_path, POINTS)
    file = tmp_path / "chips" / "P0.chip"
    file.write_bytes(bytes(64 * 32) + file.read_bytes()[64 * 32 :])
    scene = open_base_chip(read_base_chips(path, tmp_path / "chips", "centre")[0])
    assert isinstance(scene, Scene)
    pixels = scene.image.read(Window(0, 0, 64, 64))
    assert np.isnan(pixels[:32]).all()
    assert np.isfinite(pixels[32:]).all()


def test_other_points_have_no_chips(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"give images of other points \(--images\)"):
        read_base_chips(GOLDEN / "invented.csv", tmp_path)
    with pytest.raises(InputError, match="expected the folder of the chips"):
        read_base_chips(GOLDEN / "invented_gcplib.txt", tmp_path / "none", "centre")
