# All that a newcomer types; `make help` lists it.
# PYTHON chooses the Python for a new .venv: make setup PYTHON=python3.12
# ARGS is handed to the program: make test ARGS="-k noise"

VENV  := .venv
BIN   := $(VENV)/bin
READY := $(VENV)/.ready
UV    := $(shell command -v uv 2>/dev/null)
RANGE := >=3.10,<3.14

ifneq ($(UV),)
  MAKE_VENV := uv venv --quiet --allow-existing --python "$(or $(PYTHON),$(RANGE))" $(VENV)
  INSTALL   := uv pip install --quiet --python $(BIN)/python
else
  MAKE_VENV := $(or $(PYTHON),python3) -m venv $(VENV)
  # A .venv that uv made, or that a Debian without python3-venv left half made, has no pip.
  NEED_PIP  := $(BIN)/python -m pip --version >/dev/null 2>&1 || $(BIN)/python -m ensurepip >/dev/null;
  INSTALL   := $(BIN)/python -m pip install --quiet --disable-pip-version-check
endif

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help setup demo test test-all torture lint docs bench proof lock clean

help:  ## list these targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /  make \1\t/' | expand -t 16

setup: $(READY)  ## make .venv from requirements.lock and find LLVM (installs it where apt-get can)

# The stamp lies inside .venv and goes with it. The first doctor runs before the long download, the second compiles a
# kernel with what was downloaded. The lock holds the build backend too, so the last install asks no package index.
$(READY): requirements.lock pyproject.toml setup.py
	@test -x $(BIN)/python || { echo "making $(VENV)"; $(MAKE_VENV); }
	@echo "looking for LLVM"; $(BIN)/python -I optics/doctor.py --prepare
	@echo "installing requirements.lock"; $(NEED_PIP) $(INSTALL) --require-hashes -r requirements.lock
	@$(INSTALL) --no-deps --no-build-isolation --editable .
	@$(BIN)/python -I optics/doctor.py --llvm >/dev/null
	@touch $@; echo "ready: $(BIN)/optics --help"

demo: setup  ## run the demonstration
	@$(BIN)/optics demo $(ARGS)

# One worker for each core, at most four: each takes 2 GB. A file stays with one worker, and so do its fixtures.
PYTEST := $(BIN)/pytest -q -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder

test: setup  ## run the tests, but for the slow ones (ARGS="-n 0": in one process)
	@$(PYTEST) -m "not slow" $(ARGS)

test-all: setup  ## run all tests, the slow ones too
	@$(PYTEST) $(ARGS)

torture: setup  ## try all hostile input: files, options, plugins, Ctrl-C, kill -9, full and read-only disks (half an hour)
	@OPTICS_TORTURE=1 $(PYTEST) tests/torture tests/workflow/test_trust.py tests/workflow/test_study_moves.py \
	    tests/workflow/test_bad_input.py $(ARGS)

lint: setup  ## check format, style, types, and that imports run one way
	@$(BIN)/ruff format --check -q . && $(BIN)/ruff check -q . && $(BIN)/mypy && $(BIN)/lint-imports --no-cache >/dev/null

docs: setup  ## build the documentation into build/docs
	@$(BIN)/python -m sphinx -q -W --keep-going -d build/doctrees docs build/docs $(ARGS)
	@$(BIN)/python docs/tools/links.py build/docs
	@echo "build/docs/index.html"

bench: setup  ## measure the speed
	@$(BIN)/python -m optics.proof.speed $(ARGS)

proof: setup  ## hide effects, run the loop blind on each, count what it said (hours; can be stopped and taken up again; ARGS=--quick)
	@$(BIN)/python -m optics.proof $(ARGS)

lock:  ## resolve requirements.lock again from pyproject.toml (newest versions: make lock ARGS=--upgrade)
	@command -v uv >/dev/null || { echo "make lock needs uv: pip install uv" >&2; exit 1; }
	uv pip compile pyproject.toml --extra test --extra lint --extra docs --group build --universal --python-version 3.10 --generate-hashes \
	    --no-annotate --no-emit-index-url --no-emit-find-links --custom-compile-command "make lock" --quiet \
	    --output-file requirements.lock $(ARGS)

clean:  ## remove what builds and tests leave behind (not .venv, not renders)
	rm -rf build dist *.egg-info docs/generated .pytest_cache .hypothesis
	find optics plugins tests -name __pycache__ -type d -prune -exec rm -rf {} +
