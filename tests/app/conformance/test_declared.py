"""Every declared conformance class has tests."""

import re
from pathlib import Path

from amers.app.api.system import CONFORMS_TO

OGC = "http://www.opengis.net/spec/"
TESTS_OF_CLASS = {
    "ogcapi-common-1/1.0/conf/core": "test_req_core_query_param",
    "ogcapi-common-1/1.0/conf/landing-page": "test_common_landing_page",
    "ogcapi-common-1/1.0/conf/json": "test_common_json_and_html",
    "ogcapi-common-1/1.0/conf/html": "test_common_json_and_html",
    "ogcapi-common-1/1.0/conf/oas30": "test_req_oas30_",
    "ogcapi-features-1/1.0/conf/oas30": "test_req_oas30_",
    "ogcapi-processes-1/1.0/conf/oas30": "test_req_oas30_",
    "ogcapi-features-1/1.0/conf/core": "test_req_core_fc_",
    "ogcapi-features-1/1.0/conf/geojson": "test_req_core_fc_response",
    "ogcapi-features-1/1.0/conf/html": "test_req_html_",
    "ogcapi-features-2/1.0/conf/crs": "test_req_crs_",
    "ogcapi-features-3/1.0/conf/queryables": "test_req_queryables_get_",
    "ogcapi-features-3/1.0/conf/queryables-query-parameters": "test_req_queryables_query_parameters",
    "ogcapi-features-3/1.0/conf/filter": "test_req_filter_filter_",
    "ogcapi-features-3/1.0/conf/features-filter": "test_req_filter_mixing",
    "cql2/1.0/conf/cql2-text": "test_json_means_the_same_as_text",
    "cql2/1.0/conf/cql2-json": "test_json_means_the_same_as_text",
    "cql2/1.0/conf/basic-cql2": "test_req_cql2_numbers",
    "cql2/1.0/conf/advanced-comparison-operators": "test_req_cql2_texts",
    "cql2/1.0/conf/case-insensitive-comparison": "test_req_cql2_texts",
    "cql2/1.0/conf/basic-spatial-functions": "test_basic_spatial_functions",
    "cql2/1.0/conf/basic-spatial-functions-plus": "test_basic_spatial_functions",
    "cql2/1.0/conf/spatial-functions": "test_spatial_functions",
    "cql2/1.0/conf/temporal-functions": "test_temporal_functions",
    "cql2/1.0/conf/property-property": "test_property_property",
    "cql2/1.0/conf/arithmetic": "test_arithmetic",
    "ogcapi-tiles-1/1.0/conf/core": "test_tiles_core",
    "ogcapi-tiles-1/1.0/conf/tileset": "test_tiles_tileset",
    "ogcapi-tiles-1/1.0/conf/tilesets-list": "test_tiles_tilesets_list",
    "ogcapi-tiles-1/1.0/conf/geodata-tilesets": "test_tiles_tilesets_list_and_geodata_tilesets",
    "ogcapi-tiles-1/1.0/conf/mvt": "test_tiles_mvt",
    "ogcapi-processes-1/1.0/conf/core": "test_req_core_process_",
    "ogcapi-processes-1/1.0/conf/ogc-process-description": "test_req_ogc_process_description",
    "ogcapi-processes-1/1.0/conf/json": "test_req_core_job_results_async_document",
    "ogcapi-processes-1/1.0/conf/job-list": "test_req_job_list_",
    "ogcapi-processes-1/1.0/conf/dismiss": "test_req_dismiss_",
}
"""How the names of the tests of each class begin; those of STAC are tests/app/test_stac*.py."""


def test_each_declared_class_is_tested_and_each_tested_class_is_declared():
    declared = {name.removeprefix(OGC) for name in CONFORMS_TO if name.startswith(OGC)}
    assert declared == set(TESTS_OF_CLASS)
    folder = Path(__file__).parent
    text = "\n".join(path.read_text() for path in folder.glob("test_*.py"))
    tests = re.findall(r"^def (test_\w+)", text, re.MULTILINE)
    for name, beginning in TESTS_OF_CLASS.items():
        assert any(test.startswith(beginning) for test in tests), name
