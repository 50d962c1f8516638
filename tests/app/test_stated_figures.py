"""The figures of blocks in columns: those of the statement, also for blocks of an earlier release."""

import json
from importlib import import_module
from pathlib import Path

import pytest

from amers.app.db.engine import Connection
from amers.app.storage import Storage
from amers.app.usecases.blocks import lifecycle
from tests.factories import make_block
from tests.statements import run_sql

FILL = import_module("amers.migrations.versions.0009_stated_accuracy").FILL
COLUMNS = ("relative_ce90_m", "relative_le90_m", "on_the_earth_ce90_m", "on_the_earth_le90_m")
MATRICES = {
    "elliptical": [[9.0, 3.5, 0.2], [3.5, 2.0, 0.1], [0.2, 0.1, 25.0]],
    "along one axis": [[400.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
    "without its height": [[4.0, 0.0, None], [0.0, 4.0, None], [None, None, None]],
    "without its position": [[None, None, None], [None, None, None], [None, None, 2.0]],
}
STATED = {name: {"covariance_m2": matrix} for name, matrix in MATRICES.items()} | {"unstated": None}


@pytest.mark.parametrize("stated", STATED.values(), ids=STATED)
@pytest.mark.parametrize("sigma_m", [None, 1.5])
def test_blocks_of_an_earlier_release_get_the_figures_of_their_statement(
    connection: Connection, storage: Storage, tmp_path: Path, stated: object, sigma_m: float | None
) -> None:
    block = lifecycle.ingest_block(connection, storage, make_block(tmp_path / "block").folder).block
    figure = {
        "name": "frame_sigma_m",
        "value": sigma_m,
        "count": 4,
        "against": "orbits",
    }
    absolute = [] if sigma_m is None else [figure]
    run_sql(
        connection,
        "update block set metadata = metadata"
        " || jsonb_build_object('amers:frame', cast(%s as jsonb),"
        " 'amers:accuracy', jsonb_build_object('relative', '[]'::jsonb, 'absolute', cast(%s as jsonb))),"
        + ", ".join(f" {name} = null" for name in COLUMNS),
        [json.dumps(stated), json.dumps(absolute)],
    )
    run_sql(connection, FILL)
    (row,) = run_sql(connection, f"select {', '.join(COLUMNS)} from block").fetchall()
    document = lifecycle.block_report(connection, block).stated
    expected = [
        figure
        for one in (document.relative_to_control_points, document.on_the_earth)
        for figure in (one.ce90_m, one.le90_m)
    ]
    for name, value in zip(COLUMNS, expected, strict=True):
        found = float("nan") if row[name] is None else row[name]
        assert found == pytest.approx(value, rel=1e-4, nan_ok=True), name
