"""Images adjusted in a neighbouring block: their parameters are observations in a new adjustment."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from amers.services.adjustment.parameters import AdjustableImage, BlockPriors
from amers.services.errors import InputError
from amers.services.sensors.displacement import DisplacementGrid
from amers.services.types import Array, BoolArray, Frame, IntArray

_SAME_PX = 0.01
"""Models that differ by less are the same."""
_PROBES = 3
"""Places a side of the image where models are compared, at two heights."""


@dataclass(frozen=True)
class KnownImages:
    """The images of an adjusted block, with all that it has told about them.

    Attributes:
        names: of the n images.
        parameters: names of those of each; some images may have fewer than others.
        values: (n, k) their parameters; 0 for those that an image lacks.
        relative: (n k, n k) covariance of the parameters for an exact frame; that of those that an image
            lacks is one.
        frame: of the block on the Earth, which its images share.
        ground, line_sample: (n, q, 3) and (n, q, 2), places and where the delivered models show them,
            of which the parameters are.
        displacements: (n,) of each beyond its parameters; None for none.
    """

    names: tuple[str, ...]
    parameters: tuple[tuple[str, ...], ...]
    values: Array
    relative: Array
    frame: Frame
    ground: Array
    line_sample: Array
    displacements: tuple[DisplacementGrid | None, ...]

    def __len__(self) -> int:
        return len(self.names)

    def take(self, rows: IntArray) -> "KnownImages":
        """A part of the images, with as many parameters as the one that has most."""
        parameters = tuple(self.parameters[row] for row in rows.tolist())
        most = max(map(len, parameters), default=0)
        inside = (rows[:, None] * self.values.shape[1] + np.arange(most)).ravel()
        return replace(
            self,
            names=tuple(self.names[row] for row in rows.tolist()),
            parameters=parameters,
            values=self.values[rows, :most],
            relative=self.relative[np.ix_(inside, inside)],
            ground=self.ground[rows],
            line_sample=self.line_sample[rows],
            displacements=tuple(self.displacements[row] for row in rows.tolist()),
        )

    def displacement(self, name: str) -> DisplacementGrid | None:
        """That of an image beyond its parameters; None for none, and for other images."""
        return dict(zip(self.names, self.displacements, strict=True)).get(name)


def known_images(
    images: Sequence[AdjustableImage], values: Array, relative: Array, frame: Frame
) -> KnownImages:
    """What later blocks may be tied to."""
    places = [_probes(image) for image in images]
    ground = np.stack([place for place, _ in places])
    return KnownImages(
        tuple(image.name for image in images),
        tuple(tuple(own.name for own in image.parameters) for image in images),
        values,
        relative,
        frame,
        ground,
        np.stack([seen for _, seen in places]),
        tuple(image.displacement for image in images),
    )


def _probes(image: AdjustableImage) -> tuple[Array, Array]:
    """Places (q, 3) all over an image, low and high, and where its delivered model shows them."""
    side = np.linspace(-0.9, 0.9, _PROBES)
    t = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)
    size = np.array(image.shape, dtype=np.float64)
    line_sample = np.tile((size - 1.0) / 2.0 + t * size / 2.0, (2, 1))
    height_m = np.repeat(image.model.height_range_m, len(t))
    ground = image.model.locate(line_sample, np.asarray(height_m, dtype=np.float64))
    return ground, image.model.project(ground)


@dataclass(frozen=True)
class Tie:
    """The images that a new block and an adjusted one have in common.

    Attributes:
        rows: (c,) images of the new block.
        known: the same images, in this order.
    """

    rows: IntArray
    known: KnownImages

    def priors(self, priors: BlockPriors, move: Array) -> BlockPriors:
        """The priors of a block where those of common images are what the neighbour tells of them.

        Their errors are those of the neighbour: relative ones, and that of its frame, which moves all of
        them alike. The covariance is R + D F D^T.

        Args:
            priors: of the block, without the tie.
            move: (K, 3 g) change of the parameters when groups of images move by a metre.
        """
        rows = self.parameter_rows(priors.size)
        moved = move.reshape(len(move), -1, 3).sum(axis=1)[rows]
        covariance = self.known.relative + moved @ self.known.frame.covariance_m2 @ moved.T
        weight = np.linalg.inv(covariance)
        weight = (weight + weight.T) / 2.0
        free = np.ones(len(priors.shape))
        free[rows] = 0.0
        at = [np.repeat(rows, len(rows)), np.tile(rows, len(rows))]
        told = sparse.coo_matrix((weight.ravel(), at), priors.apart.shape)
        kept = sparse.diags(free)
        mean = priors.mean.copy()
        mean[rows] = self.known.values.ravel()
        return replace(
            priors,
            apart=(kept @ priors.apart @ kept + told).tocsc(),
            shape=priors.shape * free,
            mean=mean,
        )

    def parameter_rows(self, size: int) -> IntArray:
        """Rows of the parameters of the common images, in blocks of `size`."""
        rows = self.rows[:, None] * size + np.arange(self.known.values.shape[1])
        return np.asarray(rows.ravel())

    def members(self, count: int) -> BoolArray:
        """Mask (count,) of the common images."""
        members = np.zeros(count, dtype=np.bool_)
        members[self.rows] = True
        return members


def tie(images: Sequence[AdjustableImage], known: KnownImages) -> Tie:
    """The images of a block that a neighbour has adjusted.

    Raises:
        InputError: there is none, or a common image has another model, or other parameters.
    """
    row_of = {name: row for row, name in enumerate(known.names)}
    rows = [row for row, image in enumerate(images) if image.name in row_of]
    if not rows:
        raise InputError(
            f"the neighbour has none of the {len(images)} images of the block: "
            f"{known.names[0]} and {len(known) - 1} more there, {images[0].name} and "
            f"{len(images) - 1} more here; give a neighbour that was made from some of these images"
        )
    common = known.take(np.array([row_of[images[row].name] for row in rows], dtype=np.int64))
    for number, row in enumerate(rows):
        image = images[row]
        there = common.line_sample[number]
        off_px = np.abs(image.model.project(common.ground[number]) - there)
        if not np.nanmax(off_px) < _SAME_PX:
            raise InputError(
                f"{image.name}: its model is not the one that the neighbour has adjusted; give both "
                "blocks the image with the same model, as delivered"
            )
        if (image.displacement is None) != (common.displacements[number] is None):
            raise InputError(
                f"{image.name}: its lines or samples were followed in one block and not in the other; "
                "register the scenes of both together"
            )
        here, before = [own.name for own in image.parameters], common.parameters[number]
        if tuple(here) != before:
            raise InputError(
                f"{image.name}: the parameters {', '.join(here)} are free, and the neighbour has "
                f"adjusted {', '.join(before)}; give both blocks the image with the same free parameters"
            )
    return Tie(np.array(rows, dtype=np.int64), common)
