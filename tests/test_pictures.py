"""The comparison of the pictures of documents notices a moved panel, and no other drawing of letters."""

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from tests.similar_pictures import MOST_CHANGED, changed_share, grey

PICTURES = sorted((Path(__file__).parents[1] / "docs" / "pictures").glob("*.jpg"))
moved_px = 40
PANELS = {
    "left": np.s_[:, :400],
    "right": np.s_[:, 400:],
    "upper": np.s_[60:460, :],
    "lower": np.s_[400:, :],
}


@pytest.mark.parametrize("path", PICTURES, ids=lambda path: path.stem)
def test_letters_drawn_otherwise_leave_a_picture_similar(path: Path) -> None:
    """Softer letters, noise of the compression, and all of them a pixel aside."""
    kept = grey(path)
    noise = np.random.default_rng(1).normal(0.0, 6.0, kept.shape)
    drawn = np.clip(gaussian_filter(np.roll(kept, 1, axis=1), 0.8) + noise, 0.0, 255.0)
    assert changed_share(kept, drawn) < MOST_CHANGED / 2.0


@pytest.mark.parametrize("panel", PANELS)
@pytest.mark.parametrize("axis", [0, 1], ids=["down", "aside"])
@pytest.mark.parametrize("path", PICTURES, ids=lambda path: path.stem)
def test_a_panel_that_moved_is_noticed(path: Path, panel: str, axis: int) -> None:
    kept = grey(path)
    drawn = kept.copy()
    drawn[PANELS[panel]] = np.roll(kept[PANELS[panel]], moved_px, axis)
    assert changed_share(kept, drawn) > MOST_CHANGED


def test_a_picture_of_another_size_is_another_picture() -> None:
    assert changed_share(np.zeros((700, 1120)), np.zeros((920, 1400))) == 1.0
