"""Options of commands, declared as the fields of dataclasses."""

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import pytest
import typer
from typer.testing import CliRunner

from amers.app.cli import scene, scenes_together
from amers.app.cli.control_options import ControlOptions
from amers.app.cli.main import app
from amers.app.cli.options import FromMilli, Shown, with_options, words_of
from amers.app.usecases.points_production import KnownPointFiles
from amers.services.docstrings import attribute_descriptions
from amers.services.formats.gcp.csv_points import PIXEL_ORIGINS
from amers.services.formats.gcp.text_formats import ECEF, LAT_LON_HEIGHT
from amers.services.quality.check_points import MARKING_SIGMA_PX
from tests.app.wiring import commands, parameters, value_of


@dataclass(frozen=True)
class Reading:
    """How things are read.

    Attributes:
        mask: file of the mask: an image,
            or polygons.
        colour: colours to use; repeat.
        sigma_m: accuracy, metres.
        is_exact: whether it is exact.
    """

    mask: Path | None = None
    colour: tuple[str, ...] = ()
    sigma_m: FromMilli = None
    is_exact: bool = False


@dataclass(frozen=True)
class Written(Reading):
    """How things are read and written.

    Attributes:
        output: file to write.
        size_px: side of a tile, pixels.
        sigma_m: accuracy of what is written.
    """

    output: Annotated[Path, typer.Option("-o")] = Path("out.tif")
    size_px: int = 7


@dataclass(frozen=True)
class Needed:
    """What is needed.

    Attributes:
        name: of the thing.
    """

    name: str


RESULTS: list[object] = []


def work(
    scene: Annotated[str, typer.Argument(help="The scene.")],
    *,
    needed: Needed,
    written: Written,
    last: Annotated[int, typer.Option(help="The last one.")] = 3,
) -> None:
    """Do the work."""
    RESULTS[:] = [scene, needed, written, last]


@pytest.fixture
def command() -> typer.Typer:
    app = typer.Typer(rich_markup_mode=None)
    app.command()(with_options(work))
    return app


def test_fields_that_are_not_given_have_their_defaults(command: typer.Typer):
    assert CliRunner().invoke(command, ["scene", "--name", "x"]).exit_code == 0
    assert ["scene", Needed("x"), Written(), 3] == RESULTS


def test_given_options_are_fields_of_their_own_types(command: typer.Typer, tmp_path: Path):
    mask = tmp_path / "mask.tif"
    mask.touch()
    words = (
        f"s --mask {mask} --colour red --colour blue --sigma-m 0.5 --is-exact --size-px 9 -o a --last 4"
    )
    done = CliRunner().invoke(command, [*words.split(), "--name", "x"])
    assert done.exit_code == 0, done.output
    made = Written(mask, ("red", "blue"), 0.5, True, Path("a"), 9)
    assert ["s", Needed("x"), made, 4] == RESULTS


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("", "Missing option '--name'"),
        ("--name x --sigma-m 0.0001", "greater than or equal to 0.001"),
        ("--name x --mask absent.tif", "does not exist"),
        ("--name x --no-is-exact", "No such option"),
        ("--name x --size-px many", "valid int"),
    ],
)
def test_a_wrong_option_is_refused(command: typer.Typer, words: str, message: str):
    done = CliRunner().invoke(command, ["s", *words.split()])
    assert (done.exit_code, message in done.output) == (2, True), done.output


def test_the_help_is_in_the_order_of_the_fields_and_has_their_descriptions(command: typer.Typer):
    shown = " ".join(CliRunner().invoke(command, ["--help"], env={"COLUMNS": "300"}).output.split())
    texts = (
        "--name <str> Of the thing. [required]",
        "--mask <path> File of the mask: an image, or polygons.",
        "--colour <list[str]> Colours to use; repeat.",
        "--sigma-m <float range> Accuracy of what is written. [x>=0.001]",
        "--is-exact Whether it is exact.",
        "-o, --output <path> File to write. [default: out.tif]",
        "--size-px <int> Side of a tile, pixels. [default: 7]",
        "--last <int> The last one. [default: 3]",
    )
    places = [shown.find(text) for text in texts]
    assert -1 not in places, shown
    assert places == sorted(places)


def test_a_field_without_a_description_is_no_option():
    @dataclass(frozen=True)
    class Silent:
        """Nothing is said of its fields."""

        field: int = 0

    def command(silent: Silent) -> None: ...

    command.__annotations__["silent"] = Silent
    with pytest.raises(KeyError, match="field"):
        with_options(command)


def test_a_command_shows_fields_in_its_own_order_under_its_own_names():
    def command(
        shown: Annotated[
            Written,
            Shown(
                output=typer.Argument(),
                size_px=typer.Option("--side", min=5),
                is_exact=None,
                mask=None,
            ),
        ],
    ) -> None:
        RESULTS[:] = [shown]

    app = typer.Typer(rich_markup_mode=None)
    app.command()(with_options(command))
    words = ["--side", "6", "--is-exact", "made.tif"]
    assert CliRunner().invoke(app, words).exit_code == 0
    assert RESULTS == [Written(output=Path("made.tif"), size_px=6, is_exact=True)]  # noqa: SIM300
    for wrong in (["--side", "4"], ["--size-px", "6"], ["--colour", "red"], ["--mask", "absent.tif"]):
        assert CliRunner().invoke(app, [*wrong, "made.tif"]).exit_code == 2, wrong
    shown = CliRunner().invoke(app, ["--help"]).output
    names = ("File to write.", "--side", "--is-exact", "--mask")
    places = [shown.find(name) for name in names]
    assert places == sorted(places), shown


def test_options_are_words_again():
    assert words_of(Needed("a b")) == ["--name", "a b"]
    assert words_of(Written()) == []
    words = "--mask m --colour red --colour blue --is-exact --size-px 9"
    assert words_of(Written(Path("m"), ("red", "blue"), is_exact=True, size_px=9)) == words.split()


def test_helps_name_the_conventions_and_defaults_of_the_code():
    control, chips = attribute_descriptions(ControlOptions), attribute_descriptions(KnownPointFiles)
    assert control["control_mark_sigma_px"].endswith(f"by default {MARKING_SIGMA_PX:g}.")
    assert control["control_sigma_axes"].endswith(f"{ECEF} or {LAT_LON_HEIGHT}.")
    assert chips["chip_origin"].endswith(f"{', '.join(PIXEL_ORIGINS)}.")


def test_a_folder_of_intermediate_results_may_be_new():
    """What an interrupted work goes on from is made by its first run."""
    made = [
        one
        for words in commands()
        for one in parameters(words)
        if one.name == "work" and one.param_type_name == "option"
    ]
    assert len(made) >= 4
    assert not any(one.type_descriptor.parameter_info.exists for one in made)


class HandedOn(Exception):
    """Carries what a command asks for, in place of the work."""


def asked(words: list[str], monkeypatch: pytest.MonkeyPatch) -> Any:
    """What a command on scenes hands on to be registered."""

    def note(*given: Any) -> None:
        raise HandedOn(*given)

    monkeypatch.setattr(scene, "check_map", lambda _image: None)
    monkeypatch.setattr(scene, "register_scenes", note)
    monkeypatch.setattr(scenes_together, "register_together", note)
    with pytest.raises(HandedOn) as found:
        app(words, standalone_mode=False)
    return found.value.args


@pytest.mark.parametrize("command", ["register", "register-many"])
@pytest.mark.parametrize("names", [("a.tif",), ("a.tif", "b.tif")])
def test_the_command_in_a_report_asks_for_the_same_again(
    command: str, names: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With every option but the accuracy of models, which is stated anew, and those of the machine."""
    left_out = {"--sigma-m", "--jobs", "--server", "--token", "--json", "--model", "--crop-origin"}
    left_out |= {"--mask", "--check-points"} if len(names) > 1 else set()
    words = ["scene", command, *names]
    for one in parameters(("scene", command)):
        if not one.required and one.opts[0] not in left_out:
            option, *value = value_of(one, tmp_path)
            words += [option, *({"--bands": ["2"], "--rigorous": ["srp"]}.get(option, value))]
    for number, name in enumerate(names):
        (tmp_path / f"{number}.rpb").touch()
        words += [
            "--model",
            f"{name}={tmp_path / str(number)}.rpb",
            "--crop-origin",
            f"{name}={number},7",
        ]
    given = asked(words, monkeypatch)
    for request in given[0] if command == "register" else given:
        again = asked(shlex.split(request.command)[1:], monkeypatch)
        assert again[0] == ([request] if command == "register" else request)
        if len(names) == 1:
            assert again == given
