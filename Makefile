# Everything does its own set-up: a virtual environment, and PostgreSQL with PostGIS where it is missing.

export OPENBLAS_NUM_THREADS := 1
export OMP_NUM_THREADS := 1

BIN := .venv/bin
READY := .venv/ready

.PHONY: demo test check serve bench postgis

demo: postgis
	$(BIN)/amers demo

test: check postgis
	$(BIN)/python -m pytest -n auto --dist loadfile

check: $(READY)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

serve: postgis
	$(BIN)/amers serve

bench: postgis
	set -e; for script in benchmarks/[a-z]*.py; do $(BIN)/python -m benchmarks.$$(basename $$script .py); done

postgis: $(READY)
	@scripts/ensure-postgis

$(READY): pyproject.toml constraints.txt scripts/make-venv
	scripts/make-venv .venv
	touch $@
