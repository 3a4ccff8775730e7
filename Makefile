# `make demo` and `make test` each work as the first command on a machine with Python 3.11 or newer.

# Newest first, but a plain python3 wins if it is new enough; override with make PYTHON=...
PYTHON ?= $(shell for python in python3 python3.13 python3.12 python3.11 python; do \
	$$python -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null \
	&& echo $$python && break; done)
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet
ARGS ?=

.PHONY: help demo test lint format wheel clean

help:
	@echo "make demo     track the sample sequence, print the table, write out/demo with a video"
	@echo "make test     run the whole test suite           (make test ARGS='-k camera')"
	@echo "make lint     ruff, pyright and the kernel check"
	@echo "make format   let ruff format the code"
	@echo "make wheel    build dist/*.whl"
	@echo "make clean    remove the environment, caches and results"

demo: $(VENV)/.installed
	$(BIN)/handtrack demo --video $(ARGS)

test: $(VENV)/.installed-test
	$(BIN)/python -m pytest $(ARGS)

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/python tools/check_kernels.py
	$(BIN)/python tools/check_large_files.py

format: $(VENV)/.installed-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

wheel: $(VENV)/.created
	$(PIP) wheel --no-deps --wheel-dir dist .

clean:
	rm -rf $(VENV) build dist out .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The stamp files keep an installation from being repeated until pyproject.toml changes.
$(VENV)/.created:
	@test -n "$(PYTHON)" || { echo "handtrack needs Python 3.11 or newer: install it, or say make PYTHON=/path/to/python" >&2; exit 1; }
	@echo "creating the virtual environment $(VENV) with $(PYTHON)"
	@$(PYTHON) -m venv $(VENV)
	@touch $@

$(VENV)/.installed: $(VENV)/.created pyproject.toml
	@echo "installing handtrack into $(VENV) (about 1 GB; a few minutes the first time)"
	@$(PIP) install --editable .
	@touch $@

$(VENV)/.installed-test: $(VENV)/.created pyproject.toml
	@echo "installing handtrack and its test tools into $(VENV) (about 1 GB; a few minutes the first time)"
	@$(PIP) install --editable '.[test]'
	@touch $(VENV)/.installed $@

$(VENV)/.installed-dev: $(VENV)/.created pyproject.toml
	@echo "installing handtrack and its development tools into $(VENV)"
	@$(PIP) install --editable '.[dev]'
	@touch $(VENV)/.installed $(VENV)/.installed-test $@
