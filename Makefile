# Everything happens in .venv inside this checkout; nothing is installed anywhere else.
# Works with GNU make 3.81 and later on Linux and macOS.

PYTHON ?= python3
ARGS ?=

VENV := .venv
BIN := $(VENV)/bin
UV := $(BIN)/uv
INSTALL = sh requirements/install.sh $(VENV)

# The program's matrices are small: threads inside BLAS only slow it down.
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1
export MKL_NUM_THREADS ?= 1
export VECLIB_MAXIMUM_THREADS ?= 1
export UV_PYTHON_DOWNLOADS := never
# The system's certificates, for networks that have certificates of their own.
export UV_SYSTEM_CERTS ?= 1
# Another environment's packages must not leak in.
unexport PYTHONPATH PYTHONHOME

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo test lint format types contracts docs-coverage check bench lock clean moved

help: ## Show this list
	@echo "Usage: make <target> [ARGS=\"...\"] [PYTHON=python3.12]"
	@echo
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  \1|\2/p' Makefile | awk -F'|' '{ printf "%-16s %s\n", $$1, $$2 }'

demo: $(VENV)/.run $(VENV)/.project ## Set everything up and run the demonstration (ARGS="--seconds 10 --headless")
	$(BIN)/atmd demo $(ARGS)

test: $(VENV)/.dev $(VENV)/.project ## Set everything up and run the tests (ARGS="-k observer")
	$(BIN)/python -m pytest -n 2 --dist loadfile $(ARGS)

lint: $(VENV)/.dev ## Style and formatting
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

format: $(VENV)/.dev ## Rewrite the code in the project's format
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

types: $(VENV)/.dev ## Static types
	$(BIN)/mypy

contracts: $(VENV)/.dev $(VENV)/.project ## Which room may import which
	$(BIN)/lint-imports --no-logo

docs-coverage: $(VENV)/.dev ## Every public thing has a docstring
	$(BIN)/interrogate twin estimators tuning

check: lint types contracts docs-coverage ## lint, types, contracts, docs-coverage

bench: $(VENV)/.dev $(VENV)/.project ## Speed, measured against the reference libraries side by side (ARGS="observer --json -")
	$(BIN)/python -m benchmarks $(ARGS)

LOCK = $(UV) pip compile --quiet --universal --python-version 3.11 --generate-hashes \
	--no-emit-index-url --no-header $(ARGS)

lock: $(VENV)/.uv ## Write requirements/*.txt anew from pyproject.toml (ARGS=--upgrade for newer versions)
	$(LOCK) --group bootstrap --output-file requirements/bootstrap.txt
	$(LOCK) --group dev pyproject.toml --output-file requirements/dev.txt
	$(LOCK) --group build --constraint requirements/dev.txt pyproject.toml --output-file requirements/run.txt

clean: ## Remove the environment and all caches; recordings stay
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache dist
	find . -name __pycache__ -prune -exec rm -rf {} +

# An environment remembers where it was made, so a checkout that was moved or copied needs a new one.
ifneq ($(shell cat $(VENV)/.python 2>/dev/null),$(CURDIR))
$(VENV)/.python: moved
endif

$(VENV)/.python:
	@PYTHON="$(PYTHON)" sh requirements/environment.sh $(VENV)

$(VENV)/.uv: requirements/bootstrap.txt $(VENV)/.python
	@echo "Installing the installer ..."
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements/bootstrap.txt
	@touch $@

$(VENV)/.run: requirements/run.txt $(VENV)/.uv
	@echo "Installing what the program needs; a few minutes the first time ..."
	@$(INSTALL) --require-hashes -r requirements/run.txt
	@touch $@

$(VENV)/.dev: requirements/dev.txt $(VENV)/.run
	@echo "Installing what the tests need ..."
	@$(INSTALL) --require-hashes -r requirements/dev.txt
	@touch $@

$(VENV)/.project: pyproject.toml $(VENV)/.run
	@$(INSTALL) --no-deps --no-build-isolation --editable .
	@touch $@
