# What there is to do with a fresh checkout. `make help` lists it.
# Needs Python 3.11 or newer, make and a C compiler; pip brings the rest into .venv and nowhere else.

SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help

# The first that is new enough; constraints.txt is tested on 3.11.
PYTHON ?= $(shell for python in python3.11 python3.12 python3.13 python3; do \
  if $$python -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then echo $$python; break; fi; done)
WORKERS ?= 2

VENV := .venv
BIN := $(VENV)/bin
STAMPS := $(VENV)/.stamps
CREATED := $(STAMPS)/created
DEMO_INSTALLED := $(STAMPS)/installed-plot
TEST_INSTALLED := $(STAMPS)/installed-test
DEV_INSTALLED := $(STAMPS)/installed-dev
MUTANTS_INSTALLED := $(STAMPS)/installed-mutants
FAST_PASSED := $(STAMPS)/fast-tests-passed

# What decides whether the tests must run again: these files, and (through LISTED) that none was added or removed.
CODE := neuralq envs tests scripts
SOURCES := $(sort $(wildcard *.md) Makefile pyproject.toml constraints.txt \
  $(shell find $(CODE) docs .ci -name __pycache__ -prune -o -type f -print 2>/dev/null))
LISTED := $(STAMPS)/sources

# One BLAS thread: the arrays of the tests are small, and the test processes share the cores. A file stays in one process
# (--dist loadfile), so that the kernels of a file are not compiled in each of them; tests/conftest.py orders the files.
SIDE_BY_SIDE := -n $(WORKERS) --dist loadfile --no-loadscope-reorder
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest

.PHONY: help demo test whole check slow mutants wheel clean always

help:  ## lists the targets
	@awk -F ':.*## ' '/^[a-z]+:.*## / {printf "  make %-8s %s\n", $$1, $$2}' Makefile

demo: $(DEMO_INSTALLED)  ## installs, then trains on CartPole, shows Baird's star and writes a report
	@$(BIN)/neuralq demo

test: $(TEST_INSTALLED) $(LISTED)  ## installs what tests need, then runs the fast tests
	@$(run_fast_tests)

whole: $(TEST_INSTALLED)  ## runs the tests of whole systems, processes and pages, some minutes
	@$(PYTEST) $(SIDE_BY_SIDE) -m whole

slow: $(TEST_INSTALLED)  ## runs the slow tests, those of whole systems too
	@$(PYTEST) $(SIDE_BY_SIDE) -m slow

check: $(DEV_INSTALLED)  ## format, lint, types, floors, and the fast tests unless they passed on these very sources
	$(BIN)/ruff format --check
	$(BIN)/ruff check
	$(BIN)/mypy
	$(BIN)/lint-imports
	@$(MAKE) --no-print-directory $(FAST_PASSED)
	@echo "All checks passed."

mutants: $(MUTANTS_INSTALLED)  ## breaks the code in small ways for half an hour: do tests notice?
	@$(BIN)/python scripts/mutants.py --workers $(WORKERS) --seen $(STAMPS)/who-runs-what.json

wheel: $(DEV_INSTALLED)  ## builds the wheel into dist/
	@$(BIN)/python -m build --no-isolation --wheel

clean:  ## removes .venv, caches and builds; keeps runs/
	rm -rf $(VENV) dist build .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find $(CODE) -name __pycache__ -type d -prune -exec rm -rf {} +

# The stamp is as old as the start of the run, so that a file edited meanwhile counts as untested. What asserts compare is
# written into each test by pytest, which costs each process seconds: only tests that failed are run once more with it.
define run_fast_tests
rm -f $(FAST_PASSED); touch $(FAST_PASSED).started; \
$(PYTEST) $(SIDE_BY_SIDE) --assert=plain -m "not slow" || { \
  echo "Those that failed once more, with what they compared:"; $(PYTEST) --last-failed --last-failed-no-failures none -m "not slow"; exit 1; }; \
mv $(FAST_PASSED).started $(FAST_PASSED)
endef

$(FAST_PASSED): $(SOURCES) $(LISTED) | $(TEST_INSTALLED)
	@$(run_fast_tests)

$(LISTED): always | $(TEST_INSTALLED)
	@printf '%s\n' $(SOURCES) >$@.new; if cmp -s $@.new $@; then rm $@.new; else mv $@.new $@; fi

always:

# $(call install,EXTRA): one dot per package; errors and warnings come through as pip prints them.
define install
echo "Installing neuralq[$(1)] into $(VENV) (torch is large: the first time takes some minutes)"; \
$(BIN)/python -m pip install --disable-pip-version-check --progress-bar off --constraint constraints.txt \
  --editable '.[$(1)]' | awk '/^(Collecting|Requirement already|Installing)/ {printf "."; fflush()} END {print ""}'; \
touch $@
endef

$(DEMO_INSTALLED): $(CREATED) pyproject.toml constraints.txt
	@$(call install,plot)

$(TEST_INSTALLED): $(CREATED) pyproject.toml constraints.txt
	@$(call install,test)

$(DEV_INSTALLED): $(TEST_INSTALLED)
	@$(call install,dev)

$(MUTANTS_INSTALLED): $(TEST_INSTALLED)
	@$(call install,mutants)

# A .venv that is there and works is kept.
$(CREATED):
	@python="$(PYTHON)"; if [ -x $(BIN)/python ]; then python=$(BIN)/python; fi; \
	if ! "$${python:-python3}" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then \
	  echo "neuralq needs Python 3.11 or newer, but $${python:-python3} is" \
	    "$$("$${python:-python3}" --version 2>&1 | head -1); name another: make PYTHON=/path/to/python3.11" >&2; \
	  exit 1; fi; \
	if ! $(BIN)/python -m pip --version >/dev/null 2>&1; then \
	  echo "Creating $(VENV) with $$("$$python" --version)"; \
	  "$$python" -m venv $(VENV) || { echo "Python's venv module does not work here; on Debian and Ubuntu:" \
	    "apt install python3-venv" >&2; exit 1; }; fi
	@mkdir -p $(STAMPS); touch $@
