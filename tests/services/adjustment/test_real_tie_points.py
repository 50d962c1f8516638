"""Real tie points with their outliers: SkySat images, corrected until their rays meet."""

from pathlib import Path

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from amers.services.adjustment.bundle import BlockAdjustment, adjust_block
from amers.services.adjustment.parameters import image_parameters
from amers.services.formats.sensor_models.rpc_text import parse_rpc_text
from amers.services.types import Array, Observations

pytestmark = [pytest.mark.real_data, pytest.mark.thorough]

location_sigma_px = 20.0
slope = 1e-4
tie_sigma_px = 0.3


def tracks(folder: Path, names: list[str]) -> Observations:
    """Connected matches of keypoints; tracks with two keypoints of one image are left out."""
    matches = np.load(folder / "matches.npy").astype(np.int64)
    keypoints = [np.load(folder / "keypoints" / f"{name}.npy") for name in names]
    most = max(len(positions) for positions in keypoints)
    one, other = matches[:, 0] + most * matches[:, 2], matches[:, 1] + most * matches[:, 3]
    n = most * len(names)
    graph = sparse.coo_matrix((np.ones(len(one)), (one, other)), (n, n))
    label = connected_components(graph, directed=False)[1]
    node = np.unique(np.concatenate([one, other]))
    image, track = node // most, label[node]
    twice = np.unique(np.stack([track, image]), axis=1, return_counts=True)
    contradicting = np.unique(twice[0][0][twice[1] > 1])
    node = node[~np.isin(track, contradicting)]
    image, track = node // most, np.unique(label[node], return_inverse=True)[1]
    order = np.lexsort((image, track))
    node, image, track = node[order], image[order], track[order]
    line_sample = np.array([keypoints[i][k % most][1::-1] for i, k in zip(image, node, strict=True)])
    return Observations(
        track.astype(np.int64),
        image.astype(np.int64),
        line_sample.astype(np.float64),
        np.full(len(node), tie_sigma_px),
    )


def adjusted(folder: Path) -> tuple[BlockAdjustment, Observations]:
    ties = folder / "predefined_matches"
    names = [Path(line).stem for line in (ties / "filenames.txt").read_text().split()]
    observations = tracks(ties, names)
    images = []
    for i, name in enumerate(names):
        model = parse_rpc_text((folder / "rpcs" / f"{name}.rpc").read_text())
        seen = observations.line_sample[observations.image == i]
        shape = (int(seen[:, 0].max()) + 1, int(seen[:, 1].max()) + 1)
        images.append(
            image_parameters(
                name, model, shape, shift_px=location_sigma_px, slope_px=slope * max(shape) / 2.0
            )
        )
    return adjust_block(images, observations), observations


def median_px(block: BlockAdjustment, observations: Observations) -> float:
    """Median length of the residuals of tracks of three views or more, outliers included."""
    several: Array = np.bincount(observations.point)[observations.point] >= 3
    return float(np.nanmedian(np.linalg.norm(block.residual_px[several], axis=1)))


@pytest.mark.parametrize(("folder", "largest_px"), [("miami_university", 0.18), ("richards_bay", 0.15)])
@pytest.mark.long
def test_rays_of_real_tie_points_meet(real_data: Path, folder: str, largest_px: float) -> None:
    block, observations = adjusted(real_data / "skysat_tiepoints" / folder)
    found_px = median_px(block, observations)
    assert found_px <= largest_px
    assert 0.5 < block.active.mean() < 1.0
