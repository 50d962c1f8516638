"""Detection of rectangular parts with other pixels, by corners in which two joints meet.

A joint differs from an edge of the ground in that it lies between two lines and leaves the lines beside
it as they are, and in that what lies on both sides of it does not change together along it.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from amers.services.imagery.line_profiles import LineProfile, quantile_of_cells, without_periods
from amers.services.types import FloatImage, IntArray

CORNER_LIMIT = 6.2
"""Clearest corner of a part, see `clearest_corner`. Source: `benchmarks/pixel_checks.py`."""
_LENGTHS = (8, 12, 16)
"""Cells of a joint: shorter ones are those of roofs and fields."""
_MOST_OSCILLATION = 0.3
"""Oscillation that all cells of a line share over what they do not, above which all is removed that they
share: the image is enlarged."""
_BORDER_PX = 8
"""Lines and samples at the border of an image that are left aside: resampling makes others of them."""
_LEAST, _MOST, _MIXED_SHARE = -0.4, 0.8, 0.75
"""Bounds of the contrast of a cell, logarithm, so that no single one makes a joint; weight of what
changes along the joint as well."""


@dataclass(frozen=True)
class Corner:
    """The clearest corner of a part.

    Attributes:
        score: of the weaker of its joints, in standard deviations of the contrast of a cell.
        line, sample: of its first pixel, on the side of larger ones.
        lines, samples: length of its joints; negative where they lead to smaller lines, or samples.
    """

    score: float
    line: int
    sample: int
    lines: int
    samples: int


def clearest_corner(along_lines: LineProfile, along_samples: LineProfile) -> Corner:
    """The corner of joints of equal numbers of cells whose weaker one is the clearest."""
    across, down = _standardised(along_lines), _standardised(along_samples)
    best = Corner(0.0, 0, 0, 0, 0)
    for length in _LENGTHS:
        if length > min(across.shape[1], down.shape[1]):
            break
        right, left = _joints(across, length)
        below, above = _joints(down, length)
        for horizontal, sample_sign in ((right, 1), (left, -1)):
            near, line = _near(horizontal, along_samples.start)
            for vertical, line_sign in ((below, 1), (above, -1)):
                beside, sample = _near(vertical, along_lines.start)
                score = np.minimum(near, beside.T)
                i, j = np.unravel_index(int(score.argmax()), score.shape)
                if score[i, j] > best.score:
                    ends = [
                        starts[np.clip(at + sign * length, 0, len(starts) - 1)] - starts[at]
                        for starts, at, sign in (
                            (along_samples.start, i, line_sign),
                            (along_lines.start, j, sample_sign),
                        )
                    ]
                    best = Corner(
                        float(score[i, j]),
                        int(line[i, j]),
                        int(sample[j, i]),
                        int(ends[0]),
                        int(ends[1]),
                    )
    return best


def _standardised(profile: LineProfile) -> FloatImage:
    """Contrast (n, cells) of the lines, less oscillations that their cells share, in its own spread."""
    parts = []
    for cells in (profile.change, profile.mixed):
        bounded = np.clip(np.nan_to_num(cells), _LEAST, _MOST)
        shared = quantile_of_cells(bounded, 0.5)
        oscillation = shared - without_periods(shared)
        is_enlarged = oscillation.std() > _MOST_OSCILLATION * bounded.std()
        bounded -= (shared if is_enlarged else oscillation)[:, None].astype(np.float32)
        parts.append(bounded / max(float(bounded.std()), 1e-6))
    mean = (1.0 - _MIXED_SHARE) * parts[0] + _MIXED_SHARE * parts[1]
    mean[:_BORDER_PX] = mean[len(mean) - _BORDER_PX :] = 0.0
    return np.asarray(mean / max(float(mean.std()), 1e-6), np.float32)


def _joints(contrast: FloatImage, length: int) -> tuple[FloatImage, FloatImage]:
    """Joints (n, cells + 1) of a number of cells that begin and that end at each border of cells."""
    lines, cells = contrast.shape
    total = np.zeros((lines, cells + 1), dtype=np.float32)
    np.cumsum(contrast, axis=1, out=total[:, 1:])
    begun = np.full((lines, cells + 1), -np.inf, dtype=np.float32)
    ended = begun.copy()
    sums = (total[:, length:] - total[:, :-length]) / np.float32(np.sqrt(length))
    begun[:, : cells + 1 - length] = sums
    ended[:, length:] = sums
    return begun, ended


def _near(joints: FloatImage, borders: IntArray) -> tuple[FloatImage, IntArray]:
    """The clearest joints within half a cell of borders (k,), (k, m), and their lines."""
    middles = (borders[1:] + borders[:-1]) // 2
    edges = np.concatenate([[0], middles, [len(joints)]])
    clearest = np.full((len(borders), joints.shape[1]), -np.inf, dtype=np.float32)
    line = np.zeros(clearest.shape, dtype=np.int64)
    for k, (first, last) in enumerate(pairwise(edges.tolist())):
        if last > first:
            part = joints[first:last]
            line[k] = first + part.argmax(axis=0)
            clearest[k] = part.max(axis=0)
    return clearest, line
