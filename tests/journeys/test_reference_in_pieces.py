"""A Sentinel-2 scene of May registered on one of June, cut into pieces: as on the whole."""

from pathlib import Path

import numpy as np
import pytest

from tests.services.file_server import served_folder
from tests.services.pieces_world import as_safe, catalogue, cut, in_zone, packed

pytestmark = [pytest.mark.long, pytest.mark.real_data, pytest.mark.thorough]

ROUNDING_PX = 1e-9
TWO_HUNDREDTHS_OF_A_PIXEL = 0.02


def test_a_reference_in_pieces_gives_the_registration_of_the_whole(
    real_data: Path, amers, tmp_path: Path
) -> None:
    (june,) = (real_data / "s2a_berlin_pair").glob("ref_*.tif")
    (may,) = (real_data / "s2a_berlin_pair").glob("tgt_*.tif")
    tiles = cut(june, tmp_path / "tiles")

    def shift_px(name: str, *references: str | Path) -> np.ndarray:
        words = [word for one in references for word in ("--reference", one)]
        result = amers("scene", "register", may, *words, "-o", tmp_path / name)
        assert result["verdict"] == "good"
        return np.array(result["shift_px"])

    whole = shift_px("whole", june)
    product = packed(as_safe(tiles, tmp_path / "made"), tmp_path / "product.zip")
    np.testing.assert_allclose(shift_px("files", *tiles), whole, rtol=0, atol=ROUNDING_PX)
    np.testing.assert_allclose(shift_px("product", product), whole, rtol=0, atol=ROUNDING_PX)
    catalogue(tiles)
    with served_folder(tmp_path) as address:
        from_server = shift_px("server", f"{address}/tiles/collection.json")
    np.testing.assert_allclose(from_server, whole, rtol=0, atol=ROUNDING_PX)
    half = len(tiles) // 2
    beyond = [in_zone(tile, tmp_path / f"32_{tile.name}", "EPSG:32632") for tile in tiles[half:]]
    off_px = np.abs(shift_px("zones", *tiles[:half], *beyond) - whole).max()
    print(f"two zones side by side: {off_px:.3f} px from the whole")
    assert off_px < TWO_HUNDREDTHS_OF_A_PIXEL
