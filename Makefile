# Everything does its own set-up: a virtual environment, PostgreSQL with PostGIS where it is missing, the map page.

export OPENBLAS_NUM_THREADS := 1
export OMP_NUM_THREADS := 1
# Hundreds of processes start in the tests: each would compile all modules again.
unexport PYTHONDONTWRITEBYTECODE

BIN := .venv/bin
READY := .venv/ready
PAGE := app/web/built/index.html
# Tests of services wait for them: three processes for two cores, whose number nproc does not tell where
# OMP_NUM_THREADS is set. More would collect all tests once more each, and wait for the cores.
WORKERS := $(shell expr $$(env -u OMP_NUM_THREADS nproc) \* 3 / 2)
# The plugin of schemathesis takes two seconds to load, and only the tests of all operations need it.
PYTEST := $(BIN)/python -m pytest -p no:schemathesis --dist loadfile --no-loadscope-reorder --durations 20
APART := not endurance and not qgis
LONG := cape_verde continent distorted real_scenes faults image_selection load stress throughput block_adjustment block_parts toutin

.PHONY: demo test test-thorough test-files test-operations test-shuffled test-fast test-security test-endurance test-qgis check kernels programs docs serve bench bench-registration bench-load bench-faults bench-throughput mutants mutants-changed postgis page chromium proxies pictures notebooks plugin release

demo: postgis page
	@$(BIN)/amers demo

# Style, types and contracts are checked while another core compiles what all tests use and others download.
test: $(READY)
	$(MAKE) --jobs 3 check kernels programs
	$(MAKE) --jobs 2 test-files test-operations

# Whole journeys, a browser, scenes that are registered again and again: what `make test` leaves out for its time.
test-thorough: $(READY)
	$(MAKE) --jobs 2 kernels programs
	$(MAKE) chromium
	$(PYTEST) -m "thorough and $(APART)" -n $(WORKERS)

# One after the other: Debian's packages are installed by one process at a time.
programs: $(READY)
	$(MAKE) postgis
	$(MAKE) proxies
	$(MAKE) page

test-files: $(READY)
	$(PYTEST) -m "not thorough and $(APART)" -n $(WORKERS) --ignore tests/app/test_openapi.py

# The same in an order that is drawn, to find tests that need others before them; SEED=7 draws that one again.
test-shuffled: $(READY)
	$(MAKE) --jobs 2 kernels programs
	$(PYTEST) -p randomly $(if $(SEED),--randomly-seed $(SEED)) -m "not thorough and $(APART)" -n $(WORKERS) \
		--ignore tests/app/test_openapi.py

# All operations have one name, of which files handed out as a whole run only the first.
test-operations: $(READY)
	$(BIN)/python -m pytest -q -n0 tests/app/test_openapi.py

# No database, no journeys, no Monte Carlo tests, nothing long, no endurance. It reports what it leaves out.
test-fast: $(READY)
	$(PYTEST) --fast -n auto

# All operations with all callers, and all hostile values, filters, archives and images: some minutes.
test-security: postgis
	$(BIN)/python -m pytest -m security --attacks full -n auto --dist loadfile --no-loadscope-reorder

# Repeated kills, cuts and floods, bombs, further cases and real views.
test-endurance: postgis
	$(BIN)/python -m pytest -m endurance -n auto --dist load

# QGIS of the distribution on a virtual screen: layers, styles and the plugin. Not in `make test` for its size.
test-qgis: postgis
	scripts/ensure-qgis
	$(BIN)/python -m pytest -m qgis -n0 tests/journeys/test_qgis.py

# The QGIS plugin, as QGIS installs it.
plugin: $(READY)
	$(BIN)/python -m scripts.make_plugin build/amers-qgis.zip

# Wheel, sources, the client alone and the plugin, each tried in an environment of its own outside the checkout.
release: postgis page
	rm -rf dist
	$(BIN)/python -m scripts.make_release dist
	$(BIN)/python -m scripts.check_release dist

# Small faults, one at a time: MODULE=services/quality takes minutes, without a module all take hours.
# What was broken off goes on; SAMPLE=200 tries more of each module.
mutants: postgis
	$(BIN)/python -m mutants $(MODULE) $(if $(SAMPLE),--sample $(SAMPLE)) $(if $(SINCE),--since $(SINCE))

# A handful, of lines changed since the branch left origin/main, in the last change of the code, or since SINCE:
# a report within a minute.
mutants-changed: postgis
	$(BIN)/python -m mutants.changed --within 60 $(if $(SINCE),--since $(SINCE))

pictures: page chromium
	$(BIN)/python scripts/make_pictures.py demo-output

# Runs the notebooks of the examples and writes their outputs; NAME=register_scene runs one. Minutes.
notebooks: $(READY)
	$(BIN)/python -m scripts.run_notebooks $(NAME)

docs: $(READY)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

check: $(READY)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

kernels: $(READY)
	$(BIN)/python -m tests.kernels

serve: postgis page
	$(BIN)/amers serve

bench: postgis
	set -e; for name in $(filter-out $(LONG),$(basename $(notdir $(wildcard benchmarks/[a-z]*.py)))); do \
		$(BIN)/python -m benchmarks.$$name; done

bench-load: postgis
	$(BIN)/python -m benchmarks.load --clients 64 --seconds 60

bench-faults: postgis
	$(BIN)/python -m benchmarks.faults

bench-throughput: postgis
	$(BIN)/python -m benchmarks.throughput --scenes 200

bench-registration: $(READY)
	$(BIN)/python -m benchmarks.stress

postgis: $(READY)
	@scripts/quietly "PostgreSQL with PostGIS" scripts/ensure-postgis

page: $(PAGE)

$(PAGE): $(wildcard web/* web/source/*) scripts/make-page
	@scripts/quietly "Map page" scripts/make-page

chromium:
	@scripts/quietly "Chromium" scripts/ensure-chromium

proxies:
	@scripts/quietly "Proxies" scripts/ensure-proxies

$(READY): pyproject.toml constraints.txt scripts/make-venv
	@scripts/quietly "Virtual environment in .venv" scripts/make-venv .venv
	@touch $@
