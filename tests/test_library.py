"""The names that `import amers` gives, and the recipes of docs/library.md."""

import ast
import inspect
import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import amers
from amers import geometry
from amers.app.usecases.vector_files import CorrectionOptions
from amers.services.matching.tie_points import MatchOptions
from amers.services.mosaic.options import MosaicOptions
from amers.services.orthorectification.rectify import OrthoOptions
from amers.services.production.image_production import ProductionOptions
from amers.services.registration.options import RegistrationOptions
from amers.services.surface.options import SurfaceOptions
from scripts.recipes import LIBRARY, recipes, write_files, write_modules_of_others
from tests.app.flat_world import CENTRE, GROUND_H, SHIFT_PX, FlatWorld, make_flat_world
from tests.app.recorders import Recorders
from tests.imports import beyond_budget, imported_by

ROOT = Path(__file__).parent.parent
RECIPES = recipes()
TASKS = (
    "correct_vectors",
    "locate",
    "match_images",
    "mosaic",
    "open_scene",
    "open_terrain",
    "orthorectify",
    "produce_points",
    "refine",
    "register",
    "register_on_reference",
    "register_together",
    "straighten",
    "surface",
)
OPTION = re.compile(r"^ {8}(\w+(?:, \w+)*): (.*?)(?=^ {8}\w+(?:, \w+)*: |\Z)", re.DOTALL | re.MULTILINE)
"""The line of an option in a docstring, with what follows."""


def arguments_of(function: object) -> dict[str, str]:
    """What a docstring says about each argument."""
    text = inspect.getdoc(function) or ""
    section = re.search(r"^Args:\n(.*?)(?=^\w|\Z)", text, re.DOTALL | re.MULTILINE)
    assert section is not None
    indented = re.sub("^", "    ", section[1], flags=re.MULTILINE)
    return {
        name: " ".join(words.split())
        for names, words in OPTION.findall(indented)
        for name in names.split(", ")
    }


def test_the_import_of_amers_loads_nothing():
    assert beyond_budget(imported_by("import amers"), set()) == {}
    light = "import amers; amers.InputError; amers.Client"
    assert set(beyond_budget(imported_by(light), {"importlib.metadata"})) == {"httpx"}


@pytest.mark.long
@pytest.mark.parametrize(
    "words",
    [
        ("-m", "amers", "scene", "register", "--help"),
        ("-c", "import amers; amers.register; import sys; assert sys.path[0] == ''"),
        ("program.py",),
    ],
    ids=["module", "statement", "program"],
)
def test_modules_of_the_working_folder_are_not_imported(words: tuple[str, ...], tmp_path: Path):
    write_modules_of_others(tmp_path)
    (tmp_path / "program.py").write_text("import amers\n\namers.register\n")
    subprocess.run([sys.executable, *words], cwd=tmp_path, check=True, capture_output=True)


def test_the_names_for_type_checkers_are_those_that_are_loaded():
    tree = ast.parse(Path(amers.__file__).read_text())
    condition = next(node for node in tree.body if isinstance(node, ast.If))
    static = {
        alias.asname: node.module
        for node in condition.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert static == amers._HOME
    assert sorted(static) == sorted(amers.__all__)
    assert set(amers.__all__) <= set(dir(amers))
    for name in amers.__all__:
        assert getattr(amers, name).__doc__, name


def test_the_page_of_the_library_lists_the_names():
    table = LIBRARY.read_text().partition("| name |")[2].partition("\n\n")[0]
    listed = set(re.findall(r"`(\w+)`", table.replace("does |", "")))
    assert listed == {*amers.__all__, "__version__"}


def test_another_name_is_no_attribute():
    with pytest.raises(AttributeError, match="no_such_task"):
        _ = amers.no_such_task  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", TASKS)
def test_a_docstring_gives_the_default_and_the_effect_of_every_option(name: str):
    described = arguments_of(getattr(amers, name))
    parameters = inspect.signature(getattr(amers, name)).parameters
    assert set(described) == set(parameters)
    for option, parameter in parameters.items():
        if parameter.default is inspect.Parameter.empty or "defaults" in described[option]:
            continue
        words = described[option].partition("By default ")[2]
        assert words, option
        if isinstance(parameter.default, str) and parameter.default:
            assert f'"{parameter.default}"' in words, option
        elif isinstance(parameter.default, float | int) and not isinstance(parameter.default, bool):
            assert re.match(rf"{parameter.default:g}\b", words), option


def test_defaults_are_those_of_the_science():
    def default(name: str, option: str) -> object:
        return inspect.signature(getattr(amers, name)).parameters[option].default

    production, registration = ProductionOptions(), RegistrationOptions()
    assert (
        default("produce_points", "gsds_m") is production.fine_gsd_m is production.coarse_gsd_m is None
    )
    assert default("produce_points", "points") == production.points
    assert default("register", "max_points") == registration.max_points
    limit = registration.qualification.max_ce90_on_earth_m
    assert default("register", "max_ce90_on_earth_m") == limit
    assert default("match_images", "max_ratio") == MatchOptions().max_ratio
    assert default("match_images", "tolerance_px") == MatchOptions().tolerance_px
    assert default("orthorectify", "hide") == OrthoOptions().hide
    assert default("mosaic", "level") == MosaicOptions().level
    assert default("surface", "pairs") == SurfaceOptions().pairs
    assert default("correct_vectors", "sigma_px") == CorrectionOptions().sigma_px
    assert default("correct_vectors", "pixels") == CorrectionOptions().pixels


OPTIONS: dict[str, tuple[tuple[Any, ...], dict[str, Any]]] = {
    "open_scene": (
        (),
        {"model": "b.rpb", "sigma_m": 17.5, "bands": "2", "mask": "m.tif", "crop_origin": (19.5, 23.5)},
    ),
    "open_terrain": (("d.tif",), {"vertical": "EGM96", "geoid": "e.gtx", "fill_px": 3}),
    "refine": (("m.csv", "out"), {"heights": "EGM96", "order": "drift"}),
    "register": (
        ("base", "out"),
        {
            "control": "f.csv",
            "control_heights": "EGM96",
            "control_sigma_m": (17.5, 19.5),
            "control_frame_sigma_m": (23.5, 29.5),
            "check_points": "g.csv",
            "max_points": 31,
            "max_ce90_on_earth_m": 37.5,
            "copy_image": True,
        },
    ),
    "register_on_reference": (
        ("r.tif", "d.tif", "out"),
        {"check_points": "g.csv", "max_ce90_on_earth_m": 37.5, "copy_image": True},
    ),
    "register_together": (("base", "out"), {"copy_image": True, "jobs": 3}),
    "produce_points": (
        ("out",),
        {"gsds_m": (17.5, 19.5), "points": 23, "sigma_m": 29.5, "licence": "a licence", "jobs": 3},
    ),
    "orthorectify": (
        ("d.tif", "o.tif"),
        {"crs": "EPSG:32631", "gsd_m": 17.5, "hide": True, "registration": "reg"},
    ),
    "straighten": (("reg", "o.tif"), {}),
    "surface": (("o.tif",), {"gsd_m": 17.5, "heights_m": (19.5, 23.5), "pairs": 29, "jobs": 3}),
    "mosaic": (("o.tif", "d.tif"), {"gsd_m": 17.5, "level": True, "jobs": 3}),
    "correct_vectors": (
        ("d.tif", "o.gpkg"),
        {"registration": "reg", "crs": "EPSG:32631", "pixels": "centre", "sigma_px": 17.5},
    ),
    "match_images": ((), {"gsd_m": 17.5, "max_ratio": 0.19, "tolerance_px": 23.5}),
}
"""Arguments after the scenes, and options, each with a value that no other has."""
OF_MANY = {"register_together", "surface", "mosaic", "produce_points"}
ARRIVE_AS = {
    "model": "1",
    "bands": "bands[0]",
    "control": "paths[0]",
    "heights": "1",
    "order": "2",
    "licence": "license",
    "gsds_m[0]": "fine_gsd_m",
    "gsds_m[1]": "coarse_gsd_m",
}
"""Names, or places, under which options arrive that are neither their own nor its end."""
NOT_HERE = {"progress", "registered", "sigma_px"}
"""Options that other tests have: they change what is called, or what marks state."""


def handed_on(
    name: str, stated: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> set[tuple[str, str]]:
    """Values that a task of the library hands on, each after its name; of a scene, with statements."""
    task, (more, options) = getattr(amers, name), OPTIONS[name]
    with monkeypatch.context() as recorded:
        modules = ("amers.tasks", "amers.opened", "amers.geometry")
        recorders = [Recorders(recorded, module) for module in modules]
        scene = amers.open_scene("a.tif", **stated) if stated else "a.tif"
        given: dict[str, tuple[Any, ...]] = {
            "open_terrain": (),
            "match_images": (scene, "b.tif"),
            "correct_vectors": ("v.gpkg", scene),
            **dict.fromkeys(OF_MANY, ([scene],)),
        }
        task(*given.get(name, (scene,)), *more, **options)
    return {
        (re.split(r"[.(]", path)[-1].replace(")", ""), value)
        for one in recorders
        for path, value in one.notes
        if not (stated and path.startswith("read_scene"))
    }


@pytest.mark.parametrize("name", OPTIONS)
def test_an_option_arrives_under_its_name(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    parameters = inspect.signature(getattr(amers, name)).parameters.values()
    options = {one.name for one in parameters if one.kind is one.KEYWORD_ONLY}
    assert options - OPTIONS[name][1].keys() <= NOT_HERE
    monkeypatch.chdir(tmp_path)
    notes = handed_on(name, {}, monkeypatch)
    for option, given in OPTIONS[name][1].items():
        several = (
            {f"{option}[{n}]": value for n, value in enumerate(given)}
            if isinstance(given, tuple)
            else {option: given}
        )
        for place, value in several.items():
            names = {one for one, text in notes if text == str(value)}
            assert any(ARRIVE_AS.get(place, place).endswith(one) for one in names), (place, names)


@pytest.mark.parametrize(
    "name", sorted(OPTIONS.keys() - {"open_scene", "open_terrain", "produce_points"})
)
def test_what_was_stated_of_a_scene_goes_with_it(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The scene as it was opened, or its files with the statements about them."""
    monkeypatch.chdir(tmp_path)
    notes = handed_on(name, {"model": "own.rpb", "crop_origin": (41.25, 43.25)}, monkeypatch)
    texts = " ".join(text for _, text in notes)
    is_opened = "read_scene()" in texts.split()
    assert is_opened or all(text in texts for text in ("own.rpb", "41.25", "43.25"))


@pytest.mark.parametrize("gsds_m", [(1.5, 4.0), (4.0, 1.5)])
def test_images_are_matched_at_the_sampling_of_the_coarser_one(
    gsds_m: tuple[float, float], monkeypatch: pytest.MonkeyPatch
):
    scenes = dict(zip(("a.tif", "b.tif"), gsds_m, strict=True))
    samplings = list[float]()
    nothing = SimpleNamespace(line_sample=np.zeros((0, 2)))
    monkeypatch.setattr(geometry, "as_scene", lambda path: SimpleNamespace(content=path))
    monkeypatch.setattr(geometry, "scene_gsd_m", scenes.__getitem__)
    monkeypatch.setattr(geometry, "find_features", lambda _, gsd_m: samplings.append(gsd_m) or nothing)
    monkeypatch.setattr(
        geometry,
        "match_features",
        lambda *_, gsd_m, **__: (
            samplings.append(gsd_m)
            or SimpleNamespace(rows=np.zeros((0, 2), dtype=int), similarity=np.zeros(0))
        ),
    )
    for given, expected in ((None, 4.0), (2.5, 2.5)):
        amers.match_images(*scenes, gsd_m=given)
        assert samplings == [expected] * 3
        samplings.clear()


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> FlatWorld:
    return make_flat_world(tmp_path_factory.mktemp("world"), size=600, points=4)


@pytest.fixture
def scene(world: FlatWorld) -> amers.Scene:
    return amers.open_scene(world.tagged)


GROUND = [*CENTRE, GROUND_H]


def test_one_place_gives_one_answer_and_many_give_many(scene: amers.Scene):
    one = amers.project(scene, GROUND)
    many = amers.project(scene, np.array([GROUND, GROUND]))
    assert (one.shape, many.shape) == ((2,), (2, 2))
    assert (many == one).all()
    back = amers.locate(scene, one, GROUND_H)
    assert back == pytest.approx(GROUND, abs=1e-9)
    heights_m = [GROUND_H, GROUND_H + 300.0]
    each = [amers.locate(scene, one, height_m) for height_m in heights_m]
    assert (amers.locate(scene, many, heights_m) == each).all()
    assert each[0][0] != each[1][0]
    assert (amers.project(scene.files.image, GROUND) == one).all()
    assert (amers.project(str(scene.files.image), GROUND) == one).all()


@pytest.mark.parametrize(
    ("ground", "message"),
    [
        ([43.25, 95.0, 0.0], "lon_lat_h: latitude 95 found in row 0"),
        ([[5.0, 43.0, 0.0], [5.0, -91.0, 0.0]], "latitude -91 found in row 1"),
        ([500.0, 43.0, 0.0], "longitude 500 found"),
        ([5.25, 43.25], r"shape \(2,\) found, \(3,\) or \(n, 3\) expected"),
        (["east", 43.25, 0.0], "numbers expected"),
        ([360.001, 43.25, 0.0], "longitude 360.001 found"),
        ([5.25, -90.001, 0.0], "latitude -90.001 found"),
    ],
)
def test_what_is_no_ground_is_refused_by_name(scene: amers.Scene, ground: list, message: str):
    with pytest.raises(amers.InputError, match=message):
        amers.project(scene, ground)


def test_the_poles_and_a_whole_turn_are_ground(scene: amers.Scene):
    edges = [[360.0, 43.25, 0.0], [-360.0, 43.25, 0.0], [5.25, 90.0, 0.0], [5.25, -90.0, 0.0]]
    assert amers.project(scene, edges).shape == (4, 2)


def test_a_latitude_is_refused_wherever_ground_is_given(scene: amers.Scene):
    with pytest.raises(amers.InputError, match="marks: latitude 95"):
        amers.refine(scene, ([[5.0, 95.0, 0.0]], [[1.0, 1.0]]))


def test_either_a_height_or_a_terrain_is_expected(scene: amers.Scene):
    with pytest.raises(amers.InputError, match="either a height or a terrain"):
        amers.locate(scene, [10.0, 10.0])
    with pytest.raises(amers.InputError, match=r"shape \(3,\) found, one height or \(1,\)"):
        amers.locate(scene, [10.0, 10.0], [1.0, 2.0, 3.0])


@pytest.mark.parametrize("order", ["shift", "drift", "affine"])
def test_the_fewest_marks_of_an_order_give_the_correction(scene: amers.Scene, order: str):
    count = {"shift": 2, "drift": 3, "affine": 4}[order]
    seen = np.array([[90.0, 40.0], [450.0, 560.0], [70.0, 470.0], [500.0, 90.0]])[:count]
    ground = amers.locate(scene, seen, GROUND_H)
    moved = seen + [7.0, -3.0]
    refinement = amers.refine(scene, (ground, moved), order=order)
    assert amers.project(refinement, ground) == pytest.approx(moved, abs=1e-6)
    assert str(refinement).startswith(f"Refinement: {order} on {count} of {count} marks")


def test_too_few_marks_are_refused_with_their_number(scene: amers.Scene):
    ground = amers.locate(scene, [[30.0, 40.0]], GROUND_H)
    with pytest.raises(amers.ComputationError, match="1 usable points found, 3 needed"):
        amers.refine(scene, (ground, [[30.0, 40.0]]), order="drift")
    with pytest.raises(amers.InputError, match="as many of both"):
        amers.refine(scene, (ground, [[30.0, 40.0], [1.0, 1.0]]))
    with pytest.raises(amers.InputError, match="one of shift, drift, affine expected"):
        amers.refine(scene, (ground, [[30.0, 40.0]]), order="cubic")  # type: ignore[arg-type]


def test_the_correction_of_marks_is_that_which_was_put_in(world: FlatWorld):
    """The model of the flat world is off by a known shift; marks of half a pixel find it."""
    rng = np.random.default_rng(3)
    seen = rng.uniform(20.0, 580.0, (30, 2))
    ground = world.true_model.locate(seen, np.full(30, GROUND_H))
    refinement = amers.refine(world.tagged, (ground, seen + rng.normal(0.0, 0.5, (30, 2))))
    left = amers.project(refinement, ground) - seen
    predicted = refinement.adjustment.covariance_at(seen)
    normalised = np.einsum("ni,nij,nj->n", left, np.linalg.inv(predicted), left)
    assert np.abs(left).max() < 1.0
    assert normalised.mean() < 6.0
    assert np.median(amers.project(world.tagged, ground) - seen, axis=0) == pytest.approx(
        -SHIFT_PX, abs=1e-6
    )


def test_one_mark_shifts_a_model_and_a_wrong_one_is_rejected(scene: amers.Scene):
    """Without an order, as registrations on marks do."""
    seen = np.array([[90.0, 40.0], [450.0, 560.0], [70.0, 470.0], [500.0, 90.0], [300.0, 300.0]])
    ground = amers.locate(scene, seen, GROUND_H)
    moved = seen + [0.7, -0.3]
    one = amers.refine(scene, (ground[:1], moved[:1]))
    half_of_it_px = 0.35
    assert np.abs(amers.project(one, ground) - moved).max() < half_of_it_px
    moved[2] += 60.0
    refinement = amers.refine(scene, (ground, moved))
    assert np.flatnonzero(~refinement.adjustment.active).tolist() == [2]


def test_the_precision_of_marks_counts_where_their_file_states_none(scene: amers.Scene, tmp_path: Path):
    """A mark of a tenth of a pixel and one of ten or a tenth of a pixel, which contradict each other."""
    seen = np.array([[300.0, 300.0], [310.0, 300.0]])
    ground = amers.locate(scene, seen, GROUND_H)
    rows = [
        f"{lon!r},{lat!r},{h!r},{line!r},{sample!r},{sigma}"
        for (lon, lat, h), (line, sample), sigma in zip(
            ground.tolist(), (seen + [[0.4, 0.0], [-0.4, 0.0]]).tolist(), ("0.1", ""), strict=True
        )
    ]
    head = "# pixel-origin=centre heights=ellipsoid\nlon,lat,height_m,line,sample,sigma_px"
    (tmp_path / "marks.csv").write_text("\n".join([head, *rows]) + "\n")
    for sigma_px, moved_px in ((10.0, 0.4), (0.1, 0.0)):
        refinement = amers.refine(scene, tmp_path / "marks.csv", sigma_px=sigma_px)
        moved = amers.project(refinement, ground) - seen
        assert moved == pytest.approx(np.array([[moved_px, 0.0]] * 2), abs=0.05)


def test_results_need_a_folder_for_what_only_files_have(tmp_path: Path):
    for option in ({"check_points": "points.csv"}, {"copy_image": True}):
        with pytest.raises(amers.InputError, match="a folder for the results is expected"):
            amers.register("scene.tif", "block", **option)
        with pytest.raises(amers.InputError, match="a folder for the results is expected"):
            amers.register_on_reference("scene.tif", "ortho.tif", None, **option)


def test_scenes_of_one_name_are_refused_before_any_work():
    for names in (["a/scene.tif", "b/scene.tif"], ["block.tif"]):
        with pytest.raises(amers.InputError, match="images with different names expected"):
            amers.register_together(names, "block", "together")


def test_there_are_fifteen_recipes_of_some_ten_lines():
    assert len(RECIPES) == 15 + len(["Errors"])
    assert [name for name, program in RECIPES.items() if len(program.splitlines()) > 10] == []


@pytest.fixture(scope="module")
def recipe_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files that recipes name, beside modules of others."""
    folder = tmp_path_factory.mktemp("recipes")
    write_files(folder)
    write_modules_of_others(folder)
    return folder


@pytest.mark.long
@pytest.mark.thorough
def test_a_recipe_runs_as_it_stands(recipe_folder: Path):
    """Each in a process of its own, which Python starts in the folder with the modules of others."""
    for name, program in RECIPES.items():
        (recipe_folder / "recipe.py").write_text(program)
        done = subprocess.run(
            [sys.executable, "recipe.py"],
            cwd=recipe_folder,
            env={**os.environ, "PYTHONPATH": ""},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, name + done.stderr
        check_output(name, done.stdout)


def check_output(name: str, printed: str) -> None:
    """What a recipe prints: objects in three lines, and results near the truth."""
    first = printed.splitlines()[0] if printed else ""
    if name == "Register a scene":
        assert first.startswith("Registration: good"), printed
    if name == "Register a scene on a reference image":
        assert first.startswith(("Registration: good", "Registration: usable")), printed
    for line in printed.splitlines():
        assert len(line) < 200
