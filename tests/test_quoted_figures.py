"""Figures stand in one place: documents quote benchmarks/figures, and a number that differs is seen."""

import json
import re
import shutil

import pytest

from scripts.figures import (
    DOCUMENTS,
    FIGURES,
    NUMBER,
    PAGE,
    QUOTE,
    ROOT,
    differences,
    number_of,
    page,
    read_figures,
)

README = ROOT / "README.md"
KEPT = read_figures()
RESULTS = README.read_text().split("| task | result |\n")[1].split("\n\n")[0].splitlines()[1:]


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_document_quotes_the_figures_as_they_are_kept(document):
    assert differences(document.read_text(), KEPT) == []


def test_the_page_of_figures_is_that_of_the_files():
    assert PAGE.read_text() == page(KEPT)


@pytest.mark.parametrize(
    ("name", "key"),
    [("distorted_simulated", "wrong"), ("stress", "ordinary_usable"), ("demo", "after_m")],
)
def test_a_figure_that_changes_is_seen_in_the_readme(tmp_path, name, key):
    folder = shutil.copytree(FIGURES, tmp_path / "figures")
    path = folder / f"{name}.json"
    figure = json.loads(path.read_text())
    figure["values"][key]["value"] += 1
    path.write_text(json.dumps(figure))
    found = differences(README.read_text(), read_figures(folder))
    assert [one.partition(" ")[0] for one in found] == [f"{name}.{key}"]


def test_a_family_that_changes_or_is_left_out_is_seen_in_its_table():
    text = (ROOT / "docs/methods/distorted_scenes.md").read_text()
    parts = KEPT["distorted_simulated"]["families"]["parts"]
    changed = {"families": {**KEPT["distorted_simulated"]["families"], "parts": {**parts, "wrong": 3}}}
    others = {**KEPT, "distorted_simulated": {**KEPT["distorted_simulated"], **changed}}
    assert [one.partition(":")[0] for one in differences(text, others)] == ["distorted_simulated, parts"]
    without = re.sub(r"^\| parts: .*\n", "", text, flags=re.MULTILINE)
    assert [one.split()[0] for one in differences(without, KEPT)] == [
        "distorted_real",
        "distorted_simulated",
    ]


def test_a_figure_that_does_not_exist_and_a_comment_without_a_number_are_seen():
    assert differences("4<!-- rpc.no_such_key -->", KEPT) != []
    assert differences("<!-- rpc.project_times_gdal --> times", KEPT) != []
    assert differences("**49**<!-- rpc.project_times_gdal --> times", KEPT) == []


@pytest.mark.parametrize("row", RESULTS, ids=lambda row: row[2:40])
def test_every_number_of_a_result_in_the_readme_is_quoted(row):
    result = row.split("|")[2]
    assert QUOTE.search(result)
    assert NUMBER.findall(QUOTE.sub("", result)) == []


def values_of(name: str) -> dict[str, float]:
    return {key: one["value"] for key, one in KEPT[name]["values"].items()}


@pytest.mark.parametrize("name", ["distorted_simulated", "distorted_real"])
def test_the_figures_of_the_distorted_scenes_are_sums_over_all_families(name):
    rows, values = KEPT[name]["families"].values(), values_of(name)
    assert values["scenes"] == sum(row["scenes"] for row in rows)
    assert values["delivered"] == sum(row["good"] + row["usable"] for row in rows)
    assert values["wrong"] == sum(row["wrong"] for row in rows)
    assert values["wrong_in_part"] == sum(row["wrong_in_part"] for row in rows)


def test_the_figures_of_real_crops_are_those_of_the_distorted_and_of_the_clean():
    values, clean = values_of("distorted_real"), KEPT["distorted_real"]["families"]["clean"]
    assert values["distorted_scenes"] + values["clean_scenes"] == values["scenes"]
    assert values["distorted_delivered"] + values["clean_delivered"] == values["delivered"]
    assert values["clean_delivered"] == clean["good"] + clean["usable"]


def test_the_figures_under_stress_are_sums_over_all_families():
    families, values = KEPT["stress"]["families"], values_of("stress")
    ordinary, hard = families["ordinary"], [families[name] for name in ("points", "sensor", "damaged")]
    assert values["ordinary_scenes"] == ordinary["scenes"]
    assert values["ordinary_good"] == ordinary["good"]
    assert values["ordinary_usable"] == ordinary["usable"]
    assert values["ordinary_not_delivered"] == ordinary["failed"] + ordinary["refused"]
    assert values["hard_scenes"] == sum(row["scenes"] for row in hard)
    assert values["hard_delivered"] == sum(row["good"] + row["usable"] for row in hard)
    assert values["delivered"] == sum(
        row["good"] + row["usable"] for row in (ordinary, families["nominal"], *hard)
    )
    assert values["wrong"] == sum(row["wrong"] + row["wrong_on_earth"] for row in families.values())


def test_the_readme_states_scenes_delivered_and_wrong_of_every_campaign():
    readme = " ".join(RESULTS)
    keys = ("scenes", "delivered", "wrong")
    for name, parts in (("stress", ("ordinary", "hard")), ("distorted_real", ("distorted", "clean"))):
        quoted = [f"{part}_scenes" for part in parts]
        assert [key for key in (*quoted, "wrong") if f"<!-- {name}.{key} -->" not in readme] == []
    assert [key for key in keys if f"<!-- distorted_simulated.{key} -->" not in readme] == []


def test_the_rows_of_a_family_add_up():
    for name in ("stress", "distorted_simulated", "distorted_real"):
        for family, row in KEPT[name]["families"].items():
            verdicts = row["good"] + row["usable"] + row["failed"] + row["refused"]
            assert verdicts == row["scenes"], (name, family)


def test_every_family_of_the_campaigns_has_figures():
    text = (ROOT / "docs/methods/stress.md").read_text().split("## Families")[1].split("\n### ")[0]
    families = set(re.findall(r"^\| (\w+) \| \d", text, re.MULTILINE))
    assert {"ordinary", "jitter", "parts"} <= families
    assert families <= KEPT["stress"]["families"].keys() | KEPT["distorted_simulated"]["families"].keys()


@pytest.mark.parametrize("name", KEPT)
def test_a_figure_states_its_command_its_commit_its_date_and_out_of_how_many(name):
    figure = KEPT[name]
    assert re.fullmatch(r"[0-9a-f]{7,40}", figure["commit"])
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", figure["date"])
    assert re.search(r"python -m benchmarks\.\w+|make \w+|pytest tests/", figure["command"])
    assert all(figure[key] for key in ("claim", "denominator", "record"))
    module = re.search(r"benchmarks\.(\w+)|(tests/[\w/]+\.py)", figure["command"])
    if module:
        path = f"benchmarks/{module[1]}.py" if module[1] else module[2]
        assert (ROOT / path).is_file()


@pytest.mark.parametrize(
    ("text", "number"), [("1,192", 1192.0), ("0.70", 0.7), ("two", 2), ("None", 0), ("RPC00B", None)]
)
def test_the_number_of_a_text(text, number):
    assert number_of(text) == number
