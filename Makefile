# pc2grid: every target makes .venv and installs into it when that has not happened yet.
# Only make and a POSIX shell are needed, and where apt is not: a Python 3.10 to 3.13 with venv. `make help` lists the targets.

PYTHON ?=
BIN = .venv/bin
READY = .venv/.ready
# Hundreds of processes are started: without byte code, each compiles 200 modules, 0.4 s.
BYTE_CODE = PYTHONDONTWRITEBYTECODE=
PYTEST_ARGS ?=

.PHONY: help browser demo test nightly check real fuzz pictures docs clean
.DEFAULT_GOAL = help

help:
	@echo 'make demo    simulate two robots, map with one, find the other; leaves a picture in demo_out/'
	@echo 'make test    run the tests (PYTEST_ARGS="-k name" for some of them)'
	@echo 'make nightly what `make test` leaves out: README pasted whole, the site, kill -9, recordings; 1,000 rounds of fuzz'
	@echo 'make check   lint, format, types, import order'
	@echo 'make real    every real recording, against examples/real.md (QUICK=1: some of them); data: PC2GRID_DATA'
	@echo 'make fuzz    20,000 mutations of every kind of input; then kill -9 and crowds, 200 times and a minute'
	@echo 'make pictures draw all pictures of README and the pages again (2 hours, of it 2 minutes without the paper)'
	@echo 'make docs    the documentation site: site/index.html'
	@echo 'make clean   remove .venv and everything that was made'
	@echo 'All of them work from a fresh clone. PYTHON=/path/to/python3 chooses the interpreter for .venv.'

$(READY): pyproject.toml constraints.txt tools/setup.sh
	@PYTHON='$(PYTHON)' sh tools/setup.sh
	@touch $(READY)

# Tests look at pages in chromium; the demo does without it.
browser:
	@sh tools/setup.sh browser

demo: $(READY)
	$(BIN)/pc2grid demo --out demo_out --force

test: $(READY) browser
	$(BYTE_CODE) $(BIN)/python -m pytest -q -n auto --dist worksteal $(PYTEST_ARGS)

nightly: $(READY) browser
	$(BYTE_CODE) $(BIN)/python -m pytest -q -n auto --dist worksteal -m nightly $(PYTEST_ARGS)
	PC2GRID_FUZZ=1000 $(BIN)/python -m pytest -q -n auto --dist worksteal $(FUZZED) $(PYTEST_ARGS)

check: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	MYPYPATH=tools $(BIN)/mypy -p pc2grid -p signature -p pc2grid_cli -p pc2grid_lab
	$(BIN)/lint-imports

# Real recordings, where there are any. A whole run replaces the table that the next run is compared with.
REAL_DATA = $(or $(PC2GRID_DATA),../shared/data)
REAL = $(BIN)/pc2grid compare recordings $(REAL_DATA) --table examples/real.json --out results/real

real: $(READY)
	$(REAL) $(if $(QUICK),--quick) $(REAL_ARGS)

# Half a million small files: in memory, where there is a place for that.
FUZZ_FOLDER = $(shell test -w /dev/shm && echo --basetemp=/dev/shm/pc2grid-fuzz -o tmp_path_retention_policy=failed)
FUZZED = tests/pc2grid/io/test_fuzz.py tests/test_fuzz_inputs.py
FUZZ = PC2GRID_FUZZ=20000 $(BIN)/python -m pytest -q -n auto --dist worksteal --timeout 1200 -m "" $(PYTEST_ARGS)

fuzz: $(READY) browser
	$(FUZZ) $(FUZZ_FOLDER) $(FUZZED)
	$(FUZZ) tests/signature/database/test_faults.py tests/signature/database/test_durability.py \
		tests/pc2grid_cli/test_view.py -k fuzz

# Every picture of README and the pages, by the program as it is. Those of the paper need its maps.
pictures: demo
	cp demo_out/answer.png examples/demo.png
	$(BIN)/python examples/how_it_works.py demo_out/lidar.mcap demo_out/depth.mcap --out examples/how_it_works.png
	$(BIN)/pc2grid export demo_out/office.submaps --map demo_out/office --force
	$(BIN)/python examples/signature_of_a_submap.py demo_out/office.yaml --out docs/signatures.png
	$(BIN)/pc2grid compare paper --maps $(REAL_DATA)/maps --offset 1.0 --out results/paper --methods proposed \
		--methods proposed_ln_bc --methods shape_context --methods sift_bow --methods surf_bow --methods sift_tfidf \
		--methods surf_tfidf --methods sdf --methods unlearned --methods learned
	cp results/paper/figure-9-offset-1.png examples/paper.png
	$(BIN)/pc2grid compare scale --maps $(REAL_DATA)/maps --out results/scale
	cp results/scale/scale.png examples/scale.png

docs: $(READY)
	@$(BIN)/python -c "from pc2grid.libraries import require; require({'docs': 'make docs'})"
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build

clean:
	rm -rf .venv demo_out dist build site .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
