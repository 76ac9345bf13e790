# `make demo` and `make test` work on a machine with nothing but Python 3.10-3.12 and make: each builds .venv first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DEMO_ARGS ?=
# uv, not pip: it can leave out the dependencies that need a compiler (requirements.override).
INSTALL := $(BIN)/uv pip install --quiet --system-certs --python $(BIN)/python --constraint requirements.lock --override requirements.override

.PHONY: demo test test-slow test-gpu test-browser lint site clean

demo: $(VENV)/.installed  ## make a scene, train the field on it, show what it adds
	$(BIN)/nrfgs demo $(DEMO_ARGS)

test: $(VENV)/.installed  ## the default test suite, a process for each core
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder

test-slow: $(VENV)/.installed  ## real training runs
	$(BIN)/python -m pytest -m slow

test-gpu: $(VENV)/.installed  ## kernels and trainings on a CUDA GPU
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m gpu -n 8 --dist worksteal

test-browser: $(VENV)/.installed  ## exported pages in Chromium and in Firefox (firefox-esr, xvfb), if they are on the path
	$(INSTALL) --editable '.[browser]'
	$(BIN)/python -m pytest -m browser

lint: $(VENV)/.installed
	$(BIN)/ruff check . && $(BIN)/ruff format --check .

site: $(VENV)/.installed  ## the pages as a site, in site/
	$(INSTALL) --editable '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

$(VENV)/.installed: pyproject.toml requirements.lock requirements.override
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --constraint requirements.lock uv
	$(INSTALL) --editable '.[dev]'
	touch $@

clean:
	rm -rf $(VENV)
