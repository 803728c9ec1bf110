# Each command sets up .venv by itself, from any Python >= 3.11; uv is used where it is present. The demo needs what a user
# installs; the development tools, twice as much again, come with the first other command.
VENV   := .venv
BIN    := $(VENV)/bin
PLAIN  := $(VENV)/.plain
READY  := $(VENV)/.ready
CACHE  := $(VENV)/cache
export MPLCONFIGDIR := $(CURDIR)/$(CACHE)/matplotlib
export SEAOPT_CACHE_DIR := $(CURDIR)/$(CACHE)
# Where bytecode is not kept, every process of the tests compiles all of seaopt again: as long as it takes to collect them.
unexport PYTHONDONTWRITEBYTECODE
SHELL  := /bin/sh
PYTEST := $(BIN)/python -m pytest

.PHONY: demo test slow check lint types contract notebooks docs floors golden bench bench-check bench-peers truth fuzz nocompiler clean setup
.DEFAULT_GOAL := demo

# Every pass both ways, and fits by each method; the rest would take an hour in CasADi's virtual machine.
METHODS     := tests/estimation/solver/test_methods.py
INTERPRETED := tests/simulation tests/estimation/result/test_fit.py tests/estimation/result/test_nist.py \
               $(METHODS)::test_prediction_error_sees_noise_inside_the_plant \
               $(METHODS)::test_slow_drift_is_taken_out $(METHODS)::test_shots_start_where_the_plant_is

setup: $(READY)

$(READY): pyproject.toml constraints.txt tools/setup.sh
	@sh tools/setup.sh $(VENV) constraints.txt dev
	@touch $(PLAIN) $(READY)

$(PLAIN): pyproject.toml constraints.txt tools/setup.sh
	@sh tools/setup.sh $(VENV)
	@touch $(PLAIN)

demo: $(PLAIN)
	$(BIN)/seaopt demo -o out/demo

test: $(READY)
	$(PYTEST) -n 2 --dist worksteal -q -m "not slow"

# Statistics over hundreds of fits: coverage of intervals, scatter against stated standard deviations. Argument types are
# checked in `make test`, which makes the same calls: here the checks would take a twentieth of the time.
slow: $(READY)
	SEAOPT_TYPES=0 $(PYTEST) -n 2 --dist worksteal -q -m slow tests

# The same numbers without a C compiler: the tests that compare both ways, and the simulation and fit tests.
nocompiler: $(READY)
	SEAOPT_TYPES=0 SEAOPT_COMPILER=none $(PYTEST) -n 2 -q -m "not slow" $(INTERPRETED)

# The lowest versions of the libraries that pyproject.toml declares; FLOOR_TESTS=... for some of the tests. What they
# themselves depend on is newer, so that they may use what is deprecated there. Argument types: see `slow`.
FLOORS      := $(VENV)-floors
FLOOR_TESTS := tests
floors: $(FLOORS)/.ready
	SEAOPT_TYPES=0 $(FLOORS)/bin/python -m pytest -n 2 --dist worksteal -q -m "not slow" -W default::DeprecationWarning $(FLOOR_TESTS)

$(FLOORS)/.ready: pyproject.toml constraints.txt tools/floors.py tools/setup.sh | $(READY)
	@mkdir -p $(CACHE)
	$(BIN)/python tools/floors.py > $(CACHE)/floors.txt
	@sh tools/setup.sh $(FLOORS) $(CACHE)/floors.txt formats,test
	@touch $@

# Figures that a refactoring must keep, against tests/golden; SUBJECTS="draws schedule" for some of them. They were written
# with these kernels of OpenBLAS; others differ in the last digits, and ties of worst cases then fall elsewhere.
golden: $(READY)
	OPENBLAS_CORETYPE=Haswell $(BIN)/python tools/golden.py compare $(SUBJECTS)

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(READY)
	$(BIN)/basedpyright

contract: $(READY)
	$(BIN)/lint-imports --no-cache

# Every notebook runs, and shows what is stored in it; `python tools/notebooks.py write` stores what it shows now.
notebooks: $(READY)
	$(BIN)/python tools/notebooks.py compare

# The site, in an environment of its own: warnings are errors, search and pages are tried in a browser.
DOCS := $(VENV)-docs
SITE := docs/_build/html
docs: $(DOCS)/.ready
	rm -rf $(SITE) docs/reference/api  # pages of what is gone
	$(DOCS)/bin/sphinx-build -W --keep-going -q -b html docs $(SITE)
	SEAOPT_SITE=$(SITE) $(DOCS)/bin/python -m pytest -q tests/test_site.py

$(DOCS)/.ready: pyproject.toml constraints.txt tools/setup.sh
	@sh tools/setup.sh $(DOCS) constraints.txt docs
	@touch $@

check: test slow nocompiler lint types contract notebooks

# What things cost beside bare NumPy, SciPy, polars and CasADi, in processor time: benchmarks/table.json and .md. The
# check measures again, into out/bench.json, and names what lost more than 10 %.
BENCH := $(BIN)/python benchmarks/table.py
bench: $(READY)
	$(BENCH) --out benchmarks/table.json

bench-check: $(READY)
	$(BENCH) --out out/bench.json --check benchmarks/table.json

# Other estimators on one problem, each in an environment of its own; ARGS="--only jax,seaopt" for some of them.
bench-peers: $(READY)
	$(BIN)/python benchmarks/peers/run.py $(ARGS)

# How often a met fit is right where the actuator has physics that the model lacks; ARGS="--fits 300 --seed 7" for more.
truth: $(READY)
	$(BIN)/python benchmarks/truth/run.py $(ARGS)

# Random and mutated CSV, JSON and MAT files, and plants of problem files, so many seconds each; needs atheris (CPython on Linux).
FUZZ_SECONDS := 60
fuzz: $(READY)
	$(BIN)/python -c 'import atheris' 2>/dev/null || $(BIN)/python -m pip install --quiet --constraint constraints.txt atheris \
		|| VIRTUAL_ENV=$(VENV) uv pip install --quiet --constraint constraints.txt atheris
	for target in csv json mat plant; do $(BIN)/python tools/fuzz.py $$target --seconds $(FUZZ_SECONDS) || exit 1; done

clean:
	rm -rf $(VENV) $(FLOORS) $(DOCS) docs/_build docs/reference/api out
