PYTHON ?= python3
BIN := .venv/bin

.PHONY: test lint validation docs paper clean

.venv: .venv/installed

.venv/installed: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo 'error: PYTHON must be 3.11 or newer, got' `$(PYTHON) --version`; exit 2; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[all,dev]'
	touch $@

lint: .venv/installed
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

test: lint
	$(BIN)/python -m pytest -n 2 --dist worksteal

validation: .venv/installed
	$(BIN)/python -m pytest tests/validation --write-validation

docs: .venv/installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[all,dev,docs]'
	$(BIN)/python -m sphinx -W --keep-going -q docs build/docs
	@echo site: build/docs/index.html

paper: .venv/installed
	$(BIN)/porrima paper --output paper

clean:
	rm -rf .venv paper build dist docs/generated src/porrima/__pycache__ .numba_cache
