"""Figures as SVG: panels with axes, discs, marks, lines, bars, arrows, images and text.

Lengths are points (1/72 inch) of a figure of `WIDTH` points; the page scales figures to its columns.
Each call draws all its marks as one path, which keeps pages of thousands of points light.
"""

import base64
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from html import escape

import cv2
import numpy as np
import numpy.typing as npt

from amers.services.types import Array

INK, QUIET = "var(--ink)", "var(--quiet)"
"""Colours that the style sheet of the page sets, so that figures follow its light or dark scheme."""

WIDTH = 360.0
TEXT = 10.0
SMALL_TEXT = 9.0
_CHARACTER = 0.56
"""Width of an average character relative to the size of its font."""
_TICK = 3.0
_STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)
_MARKS = {
    "x": "m-{r} -{r}l{d} {d}m0 -{d}l-{d} {d}",
    "+": "m-{r} 0h{d}m-{r} -{r}v{d}",
    "^": "m-{r} {r}h{d}l-{r} -{d}z",
    "s": "m-{r} -{r}h{d}v{d}h-{d}z",
    "d": "m0 -{r}l{r} {r}l-{r} {r}l-{r} -{r}z",
}
MARKS = tuple(_MARKS)
"""Shapes of marks: cross, plus, triangle, square and diamond."""


@dataclass
class Figure:
    """A figure under construction.

    Attributes:
        height: of the figure, points.
        parts: SVG elements in the order in which they are painted.
    """

    height: float
    parts: list[str] = field(default_factory=list)

    def markup(self, label: str) -> str:
        """The figure as an SVG element without addresses or fixed size.

        Args:
            label: describes the figure to readers who do not see it.
        """
        return (
            f'<svg viewBox="0 0 {WIDTH:g} {self.height:.1f}" role="img" '
            f'aria-label="{escape(label)}" font-size="{SMALL_TEXT:g}">{"".join(self.parts)}</svg>'
        )

    def text(
        self,
        x: float,
        y: float,
        content: str,
        *,
        anchor: str = "start",
        size: float = TEXT,
        colour: str = INK,
        turned: bool = False,
    ) -> None:
        """Write a line of text from, around or up to a place of the figure; `turned` reads upwards."""
        turn = f' transform="rotate(-90 {x:.1f} {y:.1f})"' if turned else ""
        self.parts.append(
            f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size:g}" text-anchor="{anchor}" '
            f'fill="{colour}"{turn}>{escape(content)}</text>'
        )

    def discs(self, places: Array, diameter: float, colour: str, opacity: float = 1.0) -> None:
        """Draw discs around places (n, 2) of the figure."""
        path = "".join(f"M{x:.1f} {y:.1f}h.01" for x, y in places.tolist())
        self._path(path, f'{_stroke(colour, diameter, opacity)} stroke-linecap="round"')

    def marks(self, places: Array, shape: str, size: float, colour: str) -> None:
        """Draw marks of one of the shapes `MARKS` around places (n, 2) of the figure."""
        mark = _MARKS[shape].format(r=f"{size / 2.0:.2f}", d=f"{size:.2f}")
        path = "".join(f"M{x:.1f} {y:.1f}{mark}" for x, y in places.tolist())
        fill = colour if shape not in "x+" else "none"
        self._path(path, _stroke(colour, 1.0), fill)

    def line(self, places: Array, colour: str, width: float, opacity: float = 1.0) -> None:
        """Draw a line through places (n, 2) of the figure."""
        path = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in places.tolist()) if len(places) else ""
        self._path(path, _stroke(colour, width, opacity))

    def arrows(self, tails: Array, heads: Array, colour: str, width: float) -> None:
        """Draw arrows from tails (n, 2) to heads (n, 2) in the figure."""
        along = heads - tails
        length = np.maximum(np.hypot(*along.T), 1e-9)
        tip = along * np.minimum(1.0, 4.5 * width / length)[:, None]
        side = np.column_stack([-tip[:, 1], tip[:, 0]]) / 3.0
        shafts = np.concatenate([tails, along - 0.8 * tip], axis=1)
        corners = np.concatenate([heads, side - tip, -2.0 * side], axis=1)
        path = "".join(f"M{x:.1f} {y:.1f}l{u:.1f} {v:.1f}" for x, y, u, v in shafts.tolist())
        self._path(path, _stroke(colour, width))
        path = "".join(
            f"M{x:.1f} {y:.1f}l{u:.1f} {v:.1f}l{s:.1f} {t:.1f}z" for x, y, u, v, s, t in corners.tolist()
        )
        self._path(path, f'fill="{colour}"', fill=None)

    def box(
        self,
        corner: tuple[float, float],
        size: tuple[float, float],
        colour: str,
        *,
        opacity: float = 1.0,
        title: str = "",
    ) -> None:
        """Fill a rectangle; its title is shown under the pointer."""
        inside = f"<title>{escape(title)}</title>" if title else ""
        self.parts.append(
            f'<rect x="{corner[0]:.2f}" y="{corner[1]:.2f}" width="{size[0]:.2f}" '
            f'height="{size[1]:.2f}" fill="{colour}"{_opacity(opacity)}>{inside}</rect>'
        )

    def area(self, places: Array, colour: str, opacity: float) -> None:
        """Fill the polygon with corners (n, 2)."""
        path = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in places.tolist()) + "z"
        self._path(path, f'fill="{colour}"{_opacity(opacity)}', fill=None)

    def _path(self, path: str, style: str, fill: str | None = "none") -> None:
        if path:
            filled = "" if fill is None else f' fill="{fill}"'
            self.parts.append(f'<path d="{path}" {style}{filled}/>')


@dataclass(frozen=True)
class Panel:
    """A rectangle of a figure with data coordinates.

    Attributes:
        figure: that the panel is part of.
        left, top, width, height: in the figure.
        x_range: data at the left and right edges.
        y_range: data at the bottom and top edges.
    """

    figure: Figure
    left: float
    top: float
    width: float
    height: float
    x_range: tuple[float, float]
    y_range: tuple[float, float]

    def places(self, x: Array, y: Array) -> Array:
        """Places (m, 2) in the figure of data coordinates; those that are not finite are omitted."""
        across = (np.asarray(x) - self.x_range[0]) / (self.x_range[1] - self.x_range[0])
        up = (np.asarray(y) - self.y_range[0]) / (self.y_range[1] - self.y_range[0])
        places = np.column_stack([self.left + across * self.width, self.top + (1.0 - up) * self.height])
        return np.asarray(places[np.isfinite(places).all(axis=1)])

    @contextmanager
    def clipped(self) -> Iterator[None]:
        """Cut what is drawn inside the `with` at the edges of the panel."""
        box = f"{self.left:.1f} {self.top:.1f} {self.width:.1f} {self.height:.1f}"
        x, y, width, height = box.split()
        self.figure.parts.append(
            f'<svg x="{x}" y="{y}" width="{width}" height="{height}" viewBox="{box}" overflow="hidden">'
        )
        yield
        self.figure.parts.append("</svg>")

    def frame(self) -> None:
        """Draw the four edges."""
        right, bottom = self.left + self.width, self.top + self.height
        corners = np.array(
            [(self.left, self.top), (right, self.top), (right, bottom), (self.left, bottom)]
        )
        self.figure.line(np.concatenate([corners, corners[:1]]), QUIET, 0.6)

    def outline(self, ring: Array, colour: str, opacity: float) -> None:
        """Draw a closed line through places (n, 2) of the data, and fill it."""
        places = self.places(*np.concatenate([ring, ring[:1]]).T)
        self.figure.area(places, colour, opacity)
        self.figure.line(places, colour, 1.0)

    def x_axis(
        self, label: str = "", *, count: int = 4, numbers: bool = True, grid: bool = False
    ) -> None:
        """Draw the lower edge with ticks, their numbers and a label."""
        figure, bottom = self.figure, self.top + self.height
        figure.line(np.array([(self.left, bottom), (self.left + self.width, bottom)]), QUIET, 0.6)
        values = ticks(*self.x_range, count)
        for value, words in zip(values, tick_words(values), strict=True):
            x = float(self.places(np.array([value]), np.array([self.y_range[0]]))[0, 0])
            figure.line(np.array([(x, bottom), (x, bottom + _TICK)]), QUIET, 0.6)
            if grid:
                figure.line(np.array([(x, self.top), (x, bottom)]), QUIET, 0.5, 0.25)
            if numbers:
                figure.text(x, bottom + 13.0, words, anchor="middle", size=SMALL_TEXT)
        if label:
            figure.text(self.left + self.width / 2.0, bottom + 27.0, label, anchor="middle")

    def y_axis(
        self, label: str = "", *, count: int = 4, numbers: bool = True, grid: bool = False
    ) -> None:
        """Draw the left edge with ticks, their numbers and a label."""
        figure, left = self.figure, self.left
        figure.line(np.array([(left, self.top), (left, self.top + self.height)]), QUIET, 0.6)
        values = ticks(*self.y_range, count)
        for value, words in zip(values, tick_words(values), strict=True):
            y = float(self.places(np.array([self.x_range[0]]), np.array([value]))[0, 1])
            figure.line(np.array([(left - _TICK, y), (left, y)]), QUIET, 0.6)
            if grid:
                figure.line(np.array([(left, y), (left + self.width, y)]), QUIET, 0.5, 0.25)
            if numbers:
                figure.text(left - 5.0, y + 3.0, words, anchor="end", size=SMALL_TEXT)
        if label:
            figure.text(10.0, self.top + self.height / 2.0, label, anchor="middle", turned=True)

    def image(self, grey: Array, opaque: Array) -> None:
        """Fill the panel with an image (h, w) of 0 to 255, transparent where it is not opaque."""
        layers = (grey,) if opaque.all() else (grey, grey, grey, 255.0 * opaque)
        self.picture(np.stack(layers, axis=-1).astype(np.uint8))

    def picture(self, pixels: npt.NDArray[np.uint8]) -> None:
        """Fill the panel with pixels (h, w, k): grey, or red, green and blue with or without opacity."""
        if pixels.shape[2] > 1:
            pixels = pixels[:, :, [2, 1, 0, 3][: pixels.shape[2]]]
        _, encoded = cv2.imencode(".png", np.ascontiguousarray(pixels))
        uri = base64.b64encode(encoded.tobytes()).decode("ascii")
        self.figure.parts.append(
            f'<image x="{self.left:.2f}" y="{self.top:.2f}" width="{self.width:.2f}" '
            f'height="{self.height:.2f}" preserveAspectRatio="none" href="data:image/png;base64,{uri}"/>'
        )


def left_margin(values_range: tuple[float, float], count: int = 6) -> float:
    """Width that the numbers and the label of a vertical axis need."""
    longest = max(map(len, tick_words(ticks(*values_range, count))), default=1)
    return 22.0 + _CHARACTER * SMALL_TEXT * longest


def data_range(values: Array) -> tuple[float, float]:
    """Range of the finite values and zero, with a margin on both sides."""
    finite = np.append(values[np.isfinite(values)], 0.0)
    return widened(float(finite.min()), float(finite.max()))


def widened(low: float, high: float, margin: float = 0.05) -> tuple[float, float]:
    """A range with a relative margin on both sides; one value becomes a range around it."""
    if not high > low:
        return low - 0.5, high + 0.5
    return low - margin * (high - low), high + margin * (high - low)


def ticks(first: float, last: float, count: int) -> Array:
    """About `count` multiples of a round number within a range, in either direction."""
    low, high = min(first, last), max(first, last)
    raw = (high - low) / count
    power = 10.0 ** np.floor(np.log10(raw))
    step = power * next(step for step in _STEPS if step * power >= 0.8 * raw)
    return np.asarray(
        step * np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1.0),
        dtype=np.float64,
    )


def tick_words(values: Array) -> Sequence[str]:
    """The numbers of ticks with as many decimals as distinguish them."""
    step = float(values[1] - values[0]) if len(values) > 1 else float(abs(values[0]) or 1.0)
    decimals = next(n for n in range(10) if abs(round(step, n) - step) < 1e-6 * step or n == 9)
    return [f"{value + 0.0:.{decimals}f}".replace("-", "\N{MINUS SIGN}") for value in values.tolist()]


def _stroke(colour: str, width: float, opacity: float = 1.0) -> str:
    return f'stroke="{colour}" stroke-width="{width:.2f}"{_opacity(opacity)}'


def _opacity(opacity: float) -> str:
    return "" if opacity == 1.0 else f' opacity="{opacity:g}"'
