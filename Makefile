# Every target does its own set-up; Python >= 3.11 and make are all it needs.
# With PYTHON given, a .venv of another version stays as it is, and this version gets .venv-X.Y beside it.
VERSION_OF = $(shell $(1) -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null)
ifeq ($(origin PYTHON),undefined)
  PYTHON := python3
  VENV   := .venv
else
  VENV   := .venv$(if $(filter-out $(call VERSION_OF,$(PYTHON)),$(call VERSION_OF,.venv/bin/python)),-$(call VERSION_OF,$(PYTHON)))
endif
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed

.DEFAULT_GOAL := help
.PHONY: help venv check test slow field demo slam bench docs release-check clean

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-13s %s\n", $$1, $$2 }' Makefile

$(STAMP): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "dpmjax needs Python >= 3.11, and '$(PYTHON)' is $$($(PYTHON) --version 2>&1); try: make PYTHON=python3.12"; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[dev]'
	@touch $@

venv: $(STAMP)  ## make the environment and install dpmjax with its development tools

check: $(STAMP)  ## lint, docstrings, format, types, import rules, links of the site
	$(BIN)/ruff check .
	$(BIN)/ruff check --preview --select DOC,D417 src
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest -q tests/test_import_rules.py
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

test: $(STAMP)  ## the test suite, without what is slow
	$(BIN)/python -m pytest -n 2 --dist worksteal $(PYTEST_OPTIONS)

slow: $(STAMP)  ## the tests that train, start processes, or compile for seconds
	$(BIN)/python -m pytest -n 2 --dist worksteal -m slow

field: $(STAMP)  ## the commands on inputs of users that once were wrong, where the data are there (DPMJAX_DATA)
	$(BIN)/python -m pytest -n 0 -q -m field tests/test_field.py

demo: $(STAMP)  ## register the built-in 2-D world; pictures in results/demo
	$(BIN)/dpmjax map2d --init odometry --force -o results/demo
	@echo "Pictures:"; find results/demo/ -name '*.png' | sort | sed 's/^/  /'

slam: $(STAMP)  ## map a simulated town from 3-D scans; pictures in results/slam_demo
	$(BIN)/dpmjax slam --force -o results/slam_demo
	@echo "Pictures:"; find results/slam_demo/ -name '*.png' | sort | sed 's/^/  /'

bench: $(STAMP)  ## speed and accuracy of everything that is measured
	$(BIN)/python -m benchmarks

docs: $(STAMP)  ## the site of the documentation: build/site/index.html
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

release-check: $(STAMP)  ## build wheel and sdist, and use the wheel in bare environments of each Python that is found
	rm -rf build/release && mkdir -p build/release
	$(BIN)/python -m build --outdir build/release
	$(BIN)/twine check --strict build/release/*
	for version in 3.11 3.12 3.13; do \
	  python$$version --version >/dev/null 2>&1 || { echo "python$$version: not found, left out"; continue; }; \
	  python$$version -m venv build/release/$$version && \
	  build/release/$$version/bin/python -I -m pip install --quiet build/release/*.whl && \
	  (cd build/release && $$version/bin/python -I ../../docs/quick_start.py && $$version/bin/dpmjax info) || exit 1; \
	done

clean:  ## remove the environments and the caches (results/ stays)
	rm -rf .venv .venv-* build dist .pytest_cache .ruff_cache .mypy_cache src/*.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
