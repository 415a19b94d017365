# The commands a developer types. `make install` first; the others do it themselves when it is missing.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Test processes with threads of linear algebra each wait for one another and spend twenty times the processor time.
# One for each of two cores, and one that works while others wait for stores, workers and signals: each takes ten seconds
# to start. Folders in the order of their names: campaigns, whose files take longest, come first, and short files last.
# Compiled modules are kept, or each of the many processes compiles the program and the tests again.
TESTS := PYTHONDONTWRITEBYTECODE= OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 POLARS_MAX_THREADS=1 \
	$(BIN)/python -m pytest -n 3 --dist loadfile --no-loadscope-reorder
STAMP := $(VENV)/.balise-installed

.PHONY: install demo test quick stress check lint types bench docs mutations dictionary configuration lock clean

install: $(STAMP)

$(STAMP): requirements.txt pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --require-hashes -r requirements.txt
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation -e .
	touch $(STAMP)

demo: install
	$(BIN)/balise demo

test: install
	$(TESTS)

quick: install
	$(TESTS) -m "not slow"

# The tests while two other processes keep two cores busy: none may fail because it has to wait.
stress: install
	for core in 1 2; do $(BIN)/python -c "while True: pass" & busy="$$busy $$!"; done; \
	trap "kill $$busy" EXIT; trap "exit 130" INT TERM; $(TESTS)

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: install
	$(BIN)/mypy

check: lint types test

bench: install
	$(BIN)/python -m benchmarks

# The documentation as a site. A broken link or a page that is not in the menu is an error. Needs no network.
docs: install
	$(BIN)/python -m sphinx --fail-on-warning --keep-going --quiet -c docs . build/docs
	@echo "build/docs/index.html"

mutations: install
	$(BIN)/python -m benchmarks.mutations

dictionary: install
	$(BIN)/python -m schemas.dictionary > docs/dictionary.md

configuration: install
	$(BIN)/python -m schemas.settings_page > docs/configuration.md

# Pins every dependency with its hashes, for every extra, Python version and system; names no index.
lock:
	env -u PIP_FIND_LINKS $(BIN)/uv pip compile --quiet --universal --all-extras --generate-hashes --no-config \
		--fork-strategy fewest --custom-compile-command "make lock" --output-file requirements.txt pyproject.toml

clean:
	rm -rf build dist demo-out bench-out experiment-out .hypothesis .pytest_cache .mypy_cache .ruff_cache *.egg-info
