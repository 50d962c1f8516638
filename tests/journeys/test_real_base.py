"""Bases of real Sentinel-2 pairs: what their dates disagree by is stated, and scenes find themselves."""

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
import shapely
from rasterio.transform import Affine
from rasterio.warp import transform_bounds

from tests.open_archive import write_cog

pytestmark = [pytest.mark.long, pytest.mark.real_data, pytest.mark.thorough]

MAY_OFF_M = np.array([6.4, 18.3])
"""East and north shift of the May scene of Berlin against the June scene, from SIFT over both."""
ALLOWED_M = 1.0
ARCHIVE = """
name = "pair"
collections = ["pair"]
image = "data"
attribution = "Contains modified Copernicus Sentinel data {years}"

[[accuracy]]
own_m = 8.17
"""


def catalogue_of(folder: Path, images: dict[str, Path]) -> tuple[float, float, float, float]:
    """Write a catalogue of images by day, its archive and a level terrain; the bounds of the first."""
    items = []
    for day, path in images.items():
        with rasterio.open(path) as image:
            bounds = transform_bounds(image.crs, "EPSG:4326", *image.bounds)
        items.append(
            {
                "type": "Feature",
                "stac_version": "1.0.0",
                "id": path.stem,
                "collection": "pair",
                "geometry": shapely.geometry.mapping(shapely.box(*bounds)),
                "properties": {"datetime": f"{day}T10:00:00Z", "grid:code": "MGRS-33UUU"},
                "assets": {"data": {"href": str(path), "type": "image/tiff"}},
                "links": [],
            }
        )
    (folder / "items.json").write_text(json.dumps({"type": "FeatureCollection", "features": items}))
    (folder / "pair.toml").write_text(ARCHIVE)
    west, south, east, north = bounds
    transform = Affine(0.01, 0.0, west - 0.1, 0.0, -0.01, north + 0.1)
    shape = round((north - south + 0.2) / 0.01), round((east - west + 0.2) / 0.01)
    level = np.full(shape, 80.0, dtype=np.float32)
    write_cog(folder / "level.tif", level, "EPSG:4326", transform, nodata=-9999.0)
    return west, south, east, north


def words_of(folder: Path, bounds: tuple[float, ...]) -> list[object]:
    terrain = ["--dem", folder / "level.tif", "--vertical", "ellipsoid", "--height-sigma-m", "30"]
    region = ["--bbox", *(f"{bound:.6f}" for bound in bounds)]
    source = ["--from", folder / "pair.toml", "--catalogue", folder / "items.json"]
    return ["base", "make", *source, *region, *terrain, "--dates", "2", "--min-share", "0.9"]


def test_the_base_of_berlin_states_that_its_dates_lie_18_m_apart(
    real_data: Path, amers, tmp_path: Path
) -> None:
    (june,) = (real_data / "s2a_berlin_pair").glob("ref_*.tif")
    (may,) = (real_data / "s2a_berlin_pair").glob("tgt_*.tif")
    bounds = catalogue_of(tmp_path, {"2016-05-29": may, "2016-06-08": june})
    block = tmp_path / "berlin"
    made = amers(*words_of(tmp_path, bounds), "-o", block)
    print({name: value for name, value in made.items() if name != "attribution"})
    assert made["dates_apart_m"] == pytest.approx(np.linalg.norm(MAY_OFF_M), abs=ALLOWED_M)
    assert made["sigma_m"] >= made["sigma_stated_m"] >= 8.17
    assert made["sigma_m"] >= made["dates_apart_m"] / 2.0 / np.sqrt(2.0)
    document = json.loads((block / "block.json").read_text())
    assert "Copernicus Sentinel data 2016" in json.dumps(document)
    site = ["--site", june, "--site-sigma-m", "1", "--search-m", "40"]
    quality = amers("block", "quality", block, *site, "--points-per-km2", "0.001", "-o", tmp_path / "q")
    (group,) = quality["planimetry"][0]["groups"]
    print(group["accuracy"])
    # The June image lies off the frame of both by half of their distance.
    np.testing.assert_allclose(group["accuracy"]["bias_m"], MAY_OFF_M / 2.0, atol=ALLOWED_M)
    assert group["accuracy"]["ce90_m"]["value"] < made["on_the_earth"]["ce90_m"]
    assert amers("block", "ingest", block, "--publish")["block"]["points"] == made["points"]
    shown = amers("block", "show", "berlin")
    assert shown["state"] == "published"
    assert shown["title"] == "berlin. Contains modified Copernicus Sentinel data 2016"
    assert shown["on_the_earth"]["ce90_m"] == pytest.approx(made["on_the_earth"]["ce90_m"], rel=0.01)
    for scene, sign in ((june, 1.0), (may, -1.0)):
        result = amers("scene", "register", scene, "--block", block, "-o", tmp_path / scene.stem)
        line_px, sample_px = result["shift_px"]
        found_m = np.array([sample_px, -line_px]) * 10.0
        print(
            f"{scene.stem}: {found_m} m, {result['active']} of {result['visible']}, {result['verdict']}"
        )
        assert np.abs(found_m + sign * MAY_OFF_M / 2.0).max() < ALLOWED_M
        assert result["verdict"] in ("good", "usable")


def test_the_pair_of_maricopa_makes_a_base_that_both_images_are_found_on(
    real_data: Path, amers, tmp_path: Path
) -> None:
    folder = real_data / "s2_maricopa_pair"
    bounds = catalogue_of(
        tmp_path, {"2020-01-01": folder / "left.tif", "2020-02-01": folder / "right.tif"}
    )
    block = tmp_path / "maricopa"
    made = amers(*words_of(tmp_path, bounds), "--spacing-m", "500", "-o", block)
    print({name: value for name, value in made.items() if name != "attribution"})
    assert made["dates_apart_m"] < 10.0
    assert made["local_sigma_m"] > 0.5, "the shifts within the pair are up to 7 m, and are stated"


def test_may_is_registered_on_points_of_june_alone_far_better_than_stated(
    real_data: Path, amers, tmp_path: Path
) -> None:
    """What is stated is not exceeded; chips of one image have its offset, which no other one shows."""
    (june,) = (real_data / "s2a_berlin_pair").glob("ref_*.tif")
    (may,) = (real_data / "s2a_berlin_pair").glob("tgt_*.tif")
    catalogue_of(tmp_path, {"2016-06-08": june})
    terrain = ["--dem", tmp_path / "level.tif", "--vertical", "ellipsoid", "--height-sigma-m", "30"]
    amers("production", "ortho", june, "--sigma-m", "1", *terrain, "-o", tmp_path / "june")
    result = amers("scene", "register", may, "--block", tmp_path / "june", "-o", tmp_path / "may")
    line_px, sample_px = result["shift_px"]
    off_m = np.abs([sample_px, line_px]) * 10.0 - MAY_OFF_M
    print(f"{np.linalg.norm(off_m):.2f} m, stated {result['relative_to_control_points']['words']}")
    assert result["verdict"] == "good"
    assert np.linalg.norm(off_m) < 0.5 < result["relative_to_control_points"]["ce90_m"]
