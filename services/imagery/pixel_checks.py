"""Detection of faults in the pixels of an image, before anything is matched.

Each check is a statistic that real images do not show; its limit lies between the largest value of clean
real images and the values of distorted ones: `docs/methods/pixel_checks.md`. Changed ground, cloud and
haze leave every one as it is.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from amers.services.imagery.jump_sizes import jump_px, moved_px
from amers.services.imagery.line_checks import (
    DOUBLED_SHARE,
    JUMP_LIMIT,
    RepeatedLines,
    doubled_share,
    jumps,
    lost_lines,
    repeated_lines,
)
from amers.services.imagery.line_profiles import LineProfile, TransposedImage, line_profile
from amers.services.imagery.part_checks import CORNER_LIMIT, Corner, clearest_corner
from amers.services.imagery.source import ImageSource, Window
from amers.services.imagery.spectral_checks import (
    BANDS_LIMIT_PX,
    ECHO_LIMIT,
    FIELDS_LIMIT_PX,
    LEAST_SHIFT_SCORE,
    Echo,
    Shift,
    blur_px,
    clearest_echo,
    displacement,
    fields_shift,
    log_spectra,
    windows_of,
)
from amers.services.types import Array, FloatImage

_MOST_JUMPS = 8
"""Jumps of an image, beyond which they are the way of its sensor or of its compression."""
_MOST_BLOCKING = 1.0
"""Blocking of an image, see `PixelStatistics`, above which its blocks have joints and second images of
their own: that of JPEG at a quality of about 20."""
_NAMES = ("line", "sample")
_NOTHING = Echo(0.0, 0.0, 0, 0)


class Fault(StrEnum):
    """What is wrong with pixels."""

    REPEATED_LINES = "repeated lines"
    REPEATED_SAMPLES = "repeated samples"
    LOST_LINES = "lost lines"
    LOST_SAMPLES = "lost samples"
    DOUBLED = "enlarged by nearest neighbour"
    ODD_LINES = "odd lines displaced"
    ODD_SAMPLES = "odd samples displaced"
    BANDS = "bands displaced"
    SECOND_IMAGE = "second image"
    PART = "part of another image"


@dataclass(frozen=True)
class PixelFinding:
    """Something that is wrong with the pixels of an image.

    Attributes:
        kind: what it is.
        line, sample: first pixel of the place where it is seen.
        lines, samples: size of that place, pixels.
        amount_px: displacement that it may leave in the image, pixels, as far as the pixels tell; NaN
            where they do not.
        evidence: the statistic over its limit, which no clean real image reaches.
        words: one sentence for people.
    """

    kind: Fault
    line: int
    sample: int
    lines: int
    samples: int
    amount_px: float
    evidence: float
    words: str


@dataclass(frozen=True)
class PixelStatistics:
    """The statistics of an image that findings follow from; two are of lines and of samples.

    Attributes:
        doubled: share of lines that equal the one before.
        repeated: runs of lines that equal earlier ones.
        jumps: (n,) how far each line differs from the one before.
        corner: the clearest corner of a part.
        fields: displacement of odd lines against even ones.
        bands: displacement of each further band against the first.
        echo: the clearest sign of a second image.
        blur_px: one standard deviation of the blur, pixels; NaN where unknown.
        blocking: how much more lines and samples differ at the borders of blocks of 8, as a share: what
            a compression leaves.
    """

    doubled: tuple[float, float]
    repeated: tuple[tuple[RepeatedLines, ...], tuple[RepeatedLines, ...]]
    jumps: tuple[Array, Array]
    corner: Corner
    fields: tuple[Shift, Shift]
    bands: tuple[Shift, ...]
    echo: Echo
    blur_px: float
    blocking: float


@dataclass(frozen=True)
class PixelFindings:
    """What is wrong with the pixels of an image, and how sharp they are.

    Attributes:
        findings: in the order of the checks; none for a clean image.
        blur_px, blocking: see `PixelStatistics`; numbers, no accusations.
    """

    findings: tuple[PixelFinding, ...]
    blur_px: float
    blocking: float


def pixel_findings(image: ImageSource, bands: Sequence[ImageSource] = ()) -> PixelFindings:
    """What is wrong with the pixels of an image.

    Args:
        image: read once along each axis, by pieces, and in a few windows.
        bands: its bands, where it has several that show the same.
    """
    statistics = pixel_statistics(image, bands)
    return PixelFindings(findings_of(image, statistics), statistics.blur_px, statistics.blocking)


def findings_of(image: ImageSource, statistics: PixelStatistics) -> tuple[PixelFinding, ...]:
    """The findings that the statistics of an image exceed their limits with."""
    if max(statistics.doubled) > DOUBLED_SHARE:
        found = [_doubled(image.shape, statistics)]
    else:
        found = _in_places(image, statistics)
    return (*found, *_bands(image.shape, statistics))


def pixel_statistics(image: ImageSource, bands: Sequence[ImageSource] = ()) -> PixelStatistics:
    """The statistics that findings follow from; see `pixel_findings`."""
    turned = TransposedImage(image)
    lines, samples = line_profile(image), line_profile(turned)
    windows = windows_of(image)
    pixels = list(windows.values())
    spectra = log_spectra(pixels) if pixels else None
    transposed = [one.T for one in pixels]
    return PixelStatistics(
        doubled=(doubled_share(lines), doubled_share(samples)),
        repeated=(tuple(repeated_lines(lines)), tuple(repeated_lines(samples))),
        jumps=(jumps(lines), jumps(samples)),
        corner=clearest_corner(lines, samples),
        fields=(fields_shift(pixels), fields_shift(transposed)),
        bands=_band_shifts(bands, list(windows)),
        echo=_NOTHING if spectra is None else clearest_echo(spectra),
        blur_px=float("nan") if spectra is None else blur_px(spectra),
        blocking=max(_blocking(lines), _blocking(samples)),
    )


def _band_shifts(bands: Sequence[ImageSource], places: list[Window]) -> tuple[Shift, ...]:
    """Displacements of further bands against the first, in windows where all are known."""
    if len(bands) < 2:
        return ()
    read: list[list[FloatImage]] = [[] for _ in bands]
    for place in places:
        pixels = [band.read(place) for band in bands]
        if all(np.isfinite(one).all() and one.std() > 0.0 for one in pixels):
            for kept, one in zip(read, pixels, strict=True):
                kept.append(one)
    return tuple(displacement(read[0], other) for other in read[1:])


def _blocking(profile: LineProfile) -> float:
    """How much more lines differ at the borders of blocks of 8 than inside, as a share; 0 at least."""
    known = np.asarray(np.isfinite(profile.change).any(axis=1))
    if known.sum() < 64:
        return 0.0
    contrast = np.zeros(len(known))
    contrast[known] = np.nanmedian(profile.change[known], axis=1)
    phases = np.array([np.median(contrast[k::8]) for k in range(8)])
    # The contrast counts a difference in full, and half of it, negative, at the lines beside.
    return float(np.expm1(max(phases.max() - np.median(phases), 0.0)))


def _in_places(image: ImageSource, statistics: PixelStatistics) -> list[PixelFinding]:
    """Findings of an image that was not enlarged; one fault has one name, the first that explains it."""
    found = [
        _repeated(one, image.shape if axis == 0 else image.shape[::-1], axis)
        for axis in range(2)
        for one in statistics.repeated[axis]
    ]
    odd, has_blocks = _odd(image.shape, statistics), statistics.blocking > _MOST_BLOCKING
    twice = []
    if not (found or odd or has_blocks):
        twice = _second_image(image.shape, statistics.echo)
    if odd or twice:
        return found + odd + twice
    lost = [one for axis in range(2) for one in _lost(image, statistics, axis)]
    part = [] if found or has_blocks else _part(image, statistics.corner)
    if part and all(one.evidence < part[0].evidence for one in lost):
        return part
    return found + lost


def _repeated(one: RepeatedLines, shape: tuple[int, int], axis: int) -> PixelFinding:
    name = _NAMES[axis]
    last, original = one.first + one.count - 1, one.first - one.lag
    words = f"{name}s {one.first} to {last} repeat {name}s {original} to {original + one.count - 1}"
    if one.count == 1:
        words = f"{name} {one.first} repeats {name} {original}"
    words += f": what follows may lie {one.count} px from its place"
    kind = (Fault.REPEATED_LINES, Fault.REPEATED_SAMPLES)[axis]
    # Identical lines have no limit but their number: one line of texture is enough.
    place = _place(axis, one.first, one.count, shape)
    return PixelFinding(kind, *place, float(one.count), float(one.count), words)


def _lost(image: ImageSource, statistics: PixelStatistics, axis: int) -> list[PixelFinding]:
    """Findings of jumps, and of lines that are repeated without being identical."""
    source = image if axis == 0 else TransposedImage(image)
    score, name = statistics.jumps[axis], _NAMES[axis]
    lost = lost_lines(score, list(statistics.repeated[axis])).tolist()
    found = []
    for line in lost if len(lost) <= _MOST_JUMPS else []:
        amount = jump_px(source, line)
        kind = (Fault.LOST_LINES, Fault.LOST_SAMPLES)[axis]
        size = "an unknown number of them" if np.isnan(amount) else f"roughly {amount:.0f} of them"
        words = f"{name}s are missing between {name}s {line - 1} and {line}, {size}"
        if amount < 0.0:
            kind = (Fault.REPEATED_LINES, Fault.REPEATED_SAMPLES)[axis]
            words = f"{name}s {line} to {line - amount - 1:.0f} repeat the {-amount:.0f} {name}s before"
        place = _place(axis, line - 1, 2, source.shape)
        evidence = float(score[line]) / JUMP_LIMIT
        found.append(PixelFinding(kind, *place, abs(amount), evidence, words))
    return found


def _place(axis: int, first: int, count: int, shape: tuple[int, int]) -> tuple[int, int, int, int]:
    """First line and sample, lines and samples of lines along an axis of an image.

    Args:
        axis: 0 for lines, 1 for samples.
        first, count: of the lines along it.
        shape: of the image, transposed for samples.
    """
    return (first, 0, count, shape[1]) if axis == 0 else (0, first, shape[1], count)


def _doubled(shape: tuple[int, int], statistics: PixelStatistics) -> PixelFinding:
    share = max(statistics.doubled)
    words = (
        f"the whole image is enlarged by nearest neighbour: {share:.0%} of its lines or samples equal "
        "the one before; each lies up to half a pixel from its place"
    )
    return PixelFinding(Fault.DOUBLED, 0, 0, *shape, 0.5, share / DOUBLED_SHARE, words)


def _part(image: ImageSource, corner: Corner) -> list[PixelFinding]:
    """The finding of a part."""
    if corner.score <= CORNER_LIMIT:
        return []
    first, last = sorted((corner.line, corner.line + corner.lines))
    left, right = sorted((corner.sample, corner.sample + corner.samples))
    moved = moved_px(image, corner.line, (left, right))
    if moved is None:
        moved = moved_px(TransposedImage(image), corner.sample, (first, last))
        moved = None if moved is None else moved[::-1]
    amount = float("nan") if moved is None else float(np.hypot(*moved))
    size = "by how much it is displaced is unknown"
    if moved is not None:
        size = f"it is displaced by {moved[0]:+.0f} px in line and {moved[1]:+.0f} px in sample"
    words = (
        f"a part of the image does not go on in what is around it ({size}): it has a corner at line "
        f"{corner.line}, sample {corner.sample}, and joints along lines {first} to {last} and samples "
        f"{left} to {right}"
    )
    evidence = corner.score / CORNER_LIMIT
    return [PixelFinding(Fault.PART, first, left, last - first, right - left, amount, evidence, words)]


def _odd(shape: tuple[int, int], statistics: PixelStatistics) -> list[PixelFinding]:
    """Findings of odd lines and samples that lie aside."""
    found = []
    echo = statistics.echo
    for axis, (shift, name) in enumerate(zip(statistics.fields, _NAMES, strict=True)):
        along, across = np.abs(shift.line_sample)
        evidence = max(along / FIELDS_LIMIT_PX[0], across / FIELDS_LIMIT_PX[1])
        # Odd lines aside look like a second image, one line away.
        is_second_image = echo.score > ECHO_LIMIT and abs((echo.line, echo.sample)[axis]) > 1
        if evidence > 1.0 and shift.score >= LEAST_SHIFT_SCORE and not is_second_image:
            line, sample = shift.line_sample if axis == 0 else shift.line_sample[::-1]
            words = (
                f"odd {name}s lie {line:+.2f} px in line and {sample:+.2f} px in sample from where even "
                f"{name}s expect them, over the whole image"
            )
            kind = (Fault.ODD_LINES, Fault.ODD_SAMPLES)[axis]
            amount = float(np.hypot(line, sample))
            found.append(PixelFinding(kind, 0, 0, *shape, amount, float(evidence), words))
    return found


def _bands(shape: tuple[int, int], statistics: PixelStatistics) -> list[PixelFinding]:
    """The finding of bands that lie apart."""
    known = [one.line_sample for one in statistics.bands if one.score >= LEAST_SHIFT_SCORE]
    places = np.array([np.zeros(2), *known])
    apart = np.linalg.norm(places[:, None] - places[None, :], axis=2)
    largest = float(apart.max())
    if largest <= BANDS_LIMIT_PX:
        return []
    line, sample = np.ptp(places, axis=0)
    words = (
        f"bands lie {largest:.2f} px from each other ({line:.2f} px in line, {sample:.2f} px in sample) "
        "over the whole image"
    )
    return [PixelFinding(Fault.BANDS, 0, 0, *shape, largest, largest / BANDS_LIMIT_PX, words)]


def _second_image(shape: tuple[int, int], echo: Echo) -> list[PixelFinding]:
    """The finding of a second image."""
    if echo.score <= ECHO_LIMIT:
        return []
    words = (
        f"the image shows the ground twice: again {abs(echo.line)} px along the lines' axis and "
        f"{abs(echo.sample)} px along the samples' axis away, {echo.share:.0%} as strong"
    )
    amount, evidence = float(np.hypot(echo.line, echo.sample)), echo.score / ECHO_LIMIT
    return [PixelFinding(Fault.SECOND_IMAGE, 0, 0, *shape, amount, evidence, words)]
