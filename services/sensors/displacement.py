"""A displacement of image positions that is not affine, on a grid of nodes."""

from dataclasses import dataclass, field

import numpy as np
from numba import njit

from amers.services.types import Array, IntArray

_BESIDE_PX = 1.0
"""Distance from a break at which its displacement is that of one side."""
_AVERAGED = 33
"""Places along each axis over which a displacement is averaged."""


@dataclass(frozen=True)
class DisplacementGrid:
    """A displacement of image positions: bilinear between nodes, constant beyond them.

    A motion of whole lines, as of a scanner that shakes, is the same at all samples and has two nodes
    along them; a bent detector has two nodes along the lines.

    Attributes:
        line: (k,) of the nodes, pixels of the uncorrected model, ascending; two at least.
        sample: (m,) of the nodes, the same.
        displacement_px: (k, m, 2) line and sample.
        variance_px2: (k, m, 2) what the errors of the displacement add to the variance of a corrected
            position by those of the affine parameters. It holds their covariance, too, so that it may be
            negative.
        breaks: (b,) lines at which it jumps, because the image is broken there: no chip shows the mean
            of both sides.
    """

    line: Array
    sample: Array
    displacement_px: Array
    variance_px2: Array
    breaks: Array = field(default_factory=lambda: np.zeros(0))

    def at(self, line_sample: Array) -> Array:
        """Displacement (n, 2) of positions (n, 2) of the uncorrected model."""
        return self._between(self.displacement_px, line_sample)

    def averaged(self, line_sample: Array, side: float) -> Array:
        """Mean displacement (n, 2) over a side around positions (n, 2): what a chip of this side shows.

        Exact where lines and samples move independently of each other. Across a break, a chip shows the
        side of its middle.
        """
        offsets = np.linspace(-0.5, 0.5, _AVERAGED) * side
        along_lines = [self._before_breaks(line_sample, offset) for offset in offsets]
        along_samples = [line_sample + [0.0, offset] for offset in offsets]
        places = np.concatenate([*along_lines, *along_samples])
        means = self.at(places).reshape(2, _AVERAGED, -1, 2).mean(axis=1)
        return np.asarray(means[0] + means[1] - self.at(line_sample))

    def beside_breaks(self, line_sample: Array) -> Array:
        """The same positions (n, 2), but off the breaks: those within a line of one move to its side."""
        return self._before_breaks(line_sample, 0.0)

    def _before_breaks(self, line_sample: Array, offset: float) -> Array:
        """Positions (n, 2) some lines away, or at the break that lies between."""
        line = line_sample[:, 0] + offset
        for jump in self.breaks.tolist():
            behind = line_sample[:, 0] > jump
            line = np.where(
                behind, np.maximum(line, jump + _BESIDE_PX), np.minimum(line, jump - _BESIDE_PX)
            )
        return np.column_stack([line, line_sample[:, 1]])

    def derivative(self, line_sample: Array) -> Array:
        """Derivative (n, 2, 2) of `at` by the line and by the sample."""
        (row, down), (column, right) = self._cells(line_sample)
        first, second, third, fourth = self._corners(self.displacement_px, row, column)
        height, width = np.diff(self.line)[row, None], np.diff(self.sample)[column, None]
        by_line = ((1.0 - right) * (third - first) + right * (fourth - second)) / height
        by_sample = ((1.0 - down) * (second - first) + down * (fourth - third)) / width
        inside = [
            (position >= nodes[0]) & (position <= nodes[-1])
            for position, nodes in zip(line_sample.T, (self.line, self.sample), strict=True)
        ]
        return np.stack([by_line * inside[0][:, None], by_sample * inside[1][:, None]], axis=-1)

    def variance_at(self, line_sample: Array) -> Array:
        """Values (n, 2) of `variance_px2` at positions (n, 2) of the uncorrected model."""
        return self._between(self.variance_px2, line_sample)

    def _between(self, values: Array, line_sample: Array) -> Array:
        """Values (k, m, 2) at the nodes, at positions (n, 2)."""
        places = np.asarray(line_sample, dtype=np.float64)
        return np.asarray(_bilinear(self.line, self.sample, values, places))

    def _cells(self, line_sample: Array) -> list[tuple[IntArray, Array]]:
        """Along lines and samples: node (n,) before a position, and the share (n, 1) of the way on."""
        cells = []
        for position, nodes in zip(line_sample.T, (self.line, self.sample), strict=True):
            before = np.clip(np.searchsorted(nodes, position, side="right") - 1, 0, len(nodes) - 2)
            share = (position - nodes[before]) / (nodes[before + 1] - nodes[before])
            cells.append((before, np.clip(share, 0.0, 1.0)[:, None]))
        return cells

    def _corners(
        self, values: Array, row: IntArray, column: IntArray
    ) -> tuple[Array, Array, Array, Array]:
        """Values (n, 2) at the corners of cells, line by line."""
        return (
            values[row, column],
            values[row, column + 1],
            values[row + 1, column],
            values[row + 1, column + 1],
        )


@njit(cache=True)
def _bilinear(line: Array, sample: Array, values: Array, line_sample: Array) -> Array:
    """Values (k, m, 2) at nodes (k,) and (m,), at positions (n, 2); constant beyond the nodes."""
    out = np.empty((len(line_sample), 2))
    for n in range(len(line_sample)):
        i, down = _cell(line, line_sample[n, 0])
        j, right = _cell(sample, line_sample[n, 1])
        for k in range(2):
            above = values[i, j, k] + right * (values[i, j + 1, k] - values[i, j, k])
            below = values[i + 1, j, k] + right * (values[i + 1, j + 1, k] - values[i + 1, j, k])
            out[n, k] = above + down * (below - above)
    return out


@njit(cache=True)
def _cell(nodes: Array, position: float) -> tuple[int, float]:
    """Node before a position, and the share of the way to the next, 0 to 1."""
    behind = int(np.searchsorted(nodes, position, side="right"))
    before = min(max(behind - 1, 0), len(nodes) - 2)
    share = float((position - nodes[before]) / (nodes[before + 1] - nodes[before]))
    return before, min(max(share, 0.0), 1.0)
