"""The page: whole, closed to the network, safe with hostile names, and sound on poor registrations."""

import base64
import re
from dataclasses import replace
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest

from amers.services.quality.criteria import at_least, at_most
from amers.services.reports.criteria_rows import margin_words
from amers.services.reports.drawing import ACTIVE, ARROW, round_number
from amers.services.reports.figure_data import Quicklook
from amers.services.reports.gallery import chip_uri, choose_comparisons
from amers.services.reports.html import figure_markup, format_html
from amers.services.reports.maps import coverage_map, residual_map
from amers.services.reports.plot import tick_words, ticks
from amers.services.reports.registration_pages import FIGURES, REGISTRATION_PAGE
from amers.services.types import Acquisition

HOSTILE = "<script>alert('x')</script>\"&$\\frac"
most_characters_of_images = 700_000
VOID = {"meta", "img", "br", "link", "input", "hr"}


class Page(HTMLParser):
    """Tags and texts of a page; complains about tags that are not closed."""

    def __init__(self, markup):
        super().__init__()
        self.open, self.tags, self.attributes, self.texts = [], set(), [], []
        self.feed(markup)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.attributes.extend(attrs)
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_startendtag(self, tag, attrs):
        self.tags.add(tag)
        self.attributes.extend(attrs)

    def handle_data(self, data):
        self.texts.append(data.strip())


def page(made):
    return format_html(REGISTRATION_PAGE, made.report())


def without_points(made):
    """A registration that saw no point at all."""
    measures = made.measures
    none = np.zeros(0, dtype=int)
    empty = replace(
        measures, **{name: getattr(measures, name)[none] for name in measures.__dataclass_fields__}
    )
    made = made.with_measures(empty)
    return replace(
        made,
        figure_data=replace(made.figure_data, quicklook=None, gallery=()),
        scene=replace(made.scene, footprint_lon_lat=np.empty((0, 2))),
    )


def nothing_active(made):
    """A registration whose measures were all deactivated, scores unknown."""
    n = len(made.measures.score)
    made = made.with_measures(replace(made.measures, active=np.zeros(n, bool), score=np.full(n, np.nan)))
    quicklook = Quicklook(np.full((20, 25), np.nan, dtype=np.float32), 200.0)
    return replace(made, figure_data=replace(made.figure_data, quicklook=quicklook))


def one_active(made):
    """A registration with a single active point."""
    active = np.zeros(len(made.measures.score), bool)
    active[-1] = True
    return made.with_measures(replace(made.measures, active=active))


def test_the_page_asks_nothing_of_the_network(material):
    markup = page(material())
    assert "://" not in markup
    assert "@import" not in markup
    parsed = Page(markup)
    addresses = [value for name, value in parsed.attributes if name in ("src", "href", "xlink:href")]
    assert addresses
    assert [a for a in addresses if not a.startswith(("data:image/png;base64,", "#"))] == []
    assert re.findall(r"url\((?!#|&quot;#|'#)", markup) == []
    assert parsed.tags.isdisjoint({"script", "link", "iframe", "object", "embed"})


def test_hostile_names_are_shown_and_not_run(material):
    made = material(name=HOSTILE)
    measures = made.measures
    reason = np.where(measures.active, "", HOSTILE)
    gallery = tuple(replace(one, status=HOSTILE) for one in made.figure_data.gallery)
    acquisition = replace(made.scene.acquisition, sensor=HOSTILE)
    checks = tuple(replace(check, against=HOSTILE) for check in made.checks)
    made = made.with_measures(replace(measures, reason=reason))
    report = replace(
        made,
        scene=replace(made.scene, acquisition=acquisition, model=HOSTILE),
        run=replace(made.run, software_version=HOSTILE),
        figure_data=replace(made.figure_data, gallery=gallery),
        checks=checks,
    ).report()
    report = replace(report, correction=replace(report.correction, order_reason=HOSTILE))
    parsed = Page(format_html(REGISTRATION_PAGE, report))
    assert "script" not in parsed.tags
    assert HOSTILE in parsed.texts


@pytest.mark.parametrize("poor", [without_points, nothing_active, one_active])
def test_a_page_is_made_of_any_registration(material, poor):
    parsed = Page(page(poor(material())))
    assert "Registration report" in parsed.texts
    assert [name for name, _ in parsed.attributes].count("aria-label") == len(FIGURES) - 1 + 3, (
        "all figures but that of a displacement, which an affine correction has not"
    )


@pytest.mark.thorough
def test_a_page_of_thousands_of_points_stays_light(material):
    """A large scene has 1,800 points (SPOT 6/7); a mail takes 10 MB."""
    megabyte = 1_000_000
    assert len(page(material(n=1800, lost=100, wrong=60))) < 3 * megabyte


def test_figures_on_one_page_share_no_identifier(report):
    seen = [set(re.findall(r' id="([^"]+)"', figure_markup(draw, report))) for draw in FIGURES]
    assert sum(map(len, seen)) == len(set.union(*seen))


def test_the_residual_arrows_point_where_the_residuals_do(material):
    """A residual of +1 px in line points down the page, of +1 px in sample to the right."""
    made = material()
    residual = np.tile([1.0, 2.0], (60, 1))
    measures = replace(made.measures, residual_px=residual)
    drawn = figure_markup(residual_map, made.with_measures(measures).report())
    on_image = drawn[drawn.index("<svg x=") :]
    shafts = re.findall(r"M[\d.]+ [\d.]+l(-?[\d.]+) (-?[\d.]+)", on_image[: on_image.index("stroke")])
    right, down = np.array(shafts, dtype=float).T
    a_printed_digit = 0.1
    assert len(shafts) == made.measures.active.sum()
    assert (down > 0).all()
    np.testing.assert_allclose(right, 2.0 * down, atol=a_printed_digit)


@pytest.mark.parametrize(
    ("first", "last", "count", "words"),
    [
        (0.0, 2200.0, 5, "0 500 1000 1500 2000"),
        (2200.0, 0.0, 5, "0 500 1000 1500 2000"),
        (-0.13, 0.21, 4, "\N{MINUS SIGN}0.1 0.0 0.1 0.2"),
        (210.0, 310.0, 4, "220 240 260 280 300"),
        (1e-7, 4e-7, 3, "0.0000001 0.0000002 0.0000003 0.0000004"),
    ],
)
def test_ticks_are_round_numbers_within_the_range(first, last, count, words):
    assert " ".join(tick_words(ticks(first, last, count))) == words


def test_the_gallery_shows_best_middle_and_worst_and_no_point_twice(material):
    gallery = material(compared=21).figure_data.gallery
    groups = choose_comparisons(gallery[::-1])
    shown = [one.point_id for group in groups for one in group.comparisons]
    assert [len(group.comparisons) for group in groups] == [4, 4, 4]
    assert shown == [0, 1, 2, 3, 8, 9, 10, 11, 17, 18, 19, 20]


def test_a_point_without_a_score_is_the_worst(material):
    gallery = material(compared=20).figure_data.gallery
    unknown = replace(gallery[0], score=float("nan"))
    assert choose_comparisons((unknown, *gallery[1:]))[-1].comparisons[-1] is unknown


def test_an_empty_gallery_takes_no_room(material):
    assert choose_comparisons(()) == ()
    assert "Chips and the scene" not in page(material(compared=0))


def test_a_page_of_many_points_shows_twelve_each_as_chip_raw_and_registered_scene(material):
    """However many points a gallery has: the size of the page is bounded."""
    parsed = Page(page(material(compared=30)))
    images = [value for name, value in parsed.attributes if name == "alt"]
    assert len(images) == 3 * 12
    assert images[:3] == ["Chip, point 0", "Raw, point 0", "Registered, point 0"]
    sources = [value for name, value in parsed.attributes if name == "src"]
    assert sum(map(len, sources)) < most_characters_of_images
    raw, registered = sources[1:3]
    assert (shown(raw)[:, 2:] == shown(registered)[:, :-2]).mean() > 0.9


@pytest.mark.parametrize(
    "chip", [np.zeros((101, 101), np.uint8), np.full((101, 101), np.nan), np.full((101, 101), np.inf)]
)
def test_a_chip_without_data_is_still_an_image(chip):
    assert chip_uri(chip).startswith("data:image/png;base64,")


def shown(uri: str) -> np.ndarray:
    """The grey values of an image inside a page."""
    encoded = base64.b64decode(uri.partition(",")[2])
    return np.asarray(cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_UNCHANGED))


def test_saturated_pixels_of_a_chip_are_white_and_change_nothing_else():
    chip = np.random.default_rng(2).uniform(100.0, 200.0, (101, 101)).astype(np.float32)
    damaged = chip.copy()
    damaged[30:33, 40:45] = np.inf
    grey, plain = shown(chip_uri(damaged)), shown(chip_uri(chip))
    lost = damaged == np.inf
    assert (grey[lost] == 255).all()
    assert np.abs(grey[~lost].astype(int) - plain[~lost]).max() <= 1


def test_saturated_pixels_of_a_quicklook_are_as_bright_as_the_brightest(material):
    made = material()
    pixels = np.full((20, 25), 500.0, dtype=np.float32)
    pixels[:, :12] = 300.0
    pixels[3:6, 4:8] = np.inf
    pixels[10:12, 20:] = np.nan
    quicklook = Quicklook(pixels, 200.0)
    markup = page(replace(made, figure_data=replace(made.figure_data, quicklook=quicklook)))
    uri = re.search(r'href="(data:image/png;base64,[^"]+)"', markup)
    assert uri is not None
    picture = shown(uri[1])
    brightness, opacity = picture[..., 0], picture[..., 3]
    assert brightness[3:6, 4:8].min() == brightness.max()
    assert (opacity[10:12, 20:] == 0).all()
    assert (opacity == 0).sum() == 10


@pytest.mark.parametrize(
    ("value", "comparison", "limit", "words"),
    [
        (30.0, "at least", 20.0, "+50 %"),
        (10.0, "at least", 20.0, "-50 %"),
        (0.25, "at most", 1.0, "+75 %"),
        (2.0, "at most", 1.0, "-100 %"),
        (float("nan"), "at most", 1.0, "–"),  # noqa: RUF001
        (1.0, "at least", 0.0, "–"),  # noqa: RUF001
    ],
)
def test_a_margin_is_positive_where_the_criterion_is_met(value, comparison, limit, words):
    judged = {"at least": at_least, "at most": at_most}[comparison]
    assert margin_words(judged("active_points", value, limit, "good")) == words


@pytest.mark.parametrize(
    ("value", "rounded"), [(0.0, 1.0), (0.37, 0.5), (1.4, 1.0), (8.0, 10.0), (23.0, 20.0)]
)
def test_the_scale_arrow_has_a_round_length(value, rounded):
    assert round_number(value) == pytest.approx(rounded)


def test_what_does_not_apply_is_left_out(material):
    texts = Page(page(material())).texts
    assert {"Incidence", "Sun elevation"} <= set(texts)
    assert {"dZ_amer", "LE90"}.isdisjoint(texts), "one scene gives no heights, nor have its check points"
    made = material()
    made = replace(made, scene=replace(made.scene, acquisition=Acquisition("IMG_1")))
    assert {"Incidence", "Sun elevation"}.isdisjoint(Page(page(made)).texts)


def test_the_arrow_of_the_scale_has_the_colour_of_the_arrows(material):
    made = material()
    on_paper = replace(made, figure_data=replace(made.figure_data, quicklook=None))
    for shown, colour, other in ((made, ARROW, ACTIVE), (on_paper, ACTIVE, ARROW)):
        markup = figure_markup(residual_map, shown.report())
        assert markup.count(colour) == 4, "shafts and heads of the arrows, and of the scale"
        assert other not in markup


@pytest.mark.parametrize("clouds", [0.0, 0.1, 0.4, 0.6])
def test_ground_is_seen_as_well_beside_clouds(material, clouds):
    """Clouds are ten times as bright; the ground keeps nearly the contrast that it has without them."""
    made = material()
    ground = made.figure_data.quicklook.pixels
    rows = round(clouds * len(ground))
    cloudy = ground.copy()
    cloudy[:rows] = 10.0 * ground.mean() + ground[:rows]

    def contrast(pixels):
        shown = replace(made.figure_data, quicklook=Quicklook(pixels, 10.0))
        markup = figure_markup(coverage_map, replace(made, figure_data=shown).report())
        encoded = base64.b64decode(re.search(r"base64,([^\"]+)", markup).group(1))
        grey = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_GRAYSCALE)
        return grey[rows:].std()

    assert contrast(cloudy) > 0.7 * contrast(ground)
