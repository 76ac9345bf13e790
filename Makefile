# `make demo` and `make test` work on a machine with nothing but Python 3.10-3.12 and make: each builds .venv first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DEMO_ARGS ?=

.PHONY: demo test test-slow test-browser lint clean

demo: $(VENV)/.installed  ## make a scene, train NRF and SH on it, compare them
	$(BIN)/nrfgs demo $(DEMO_ARGS)

test: $(VENV)/.installed  ## the default test suite, a process for each core
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist loadfile

test-slow: $(VENV)/.installed  ## real training runs
	$(BIN)/python -m pytest -m slow

test-browser: $(VENV)/.installed  ## the viewer in a headless Chromium, which must be on the path
	$(BIN)/pip install --quiet --constraint requirements.lock --editable '.[browser]'
	$(BIN)/python -m pytest -m browser

lint: $(VENV)/.installed
	$(BIN)/ruff check . && $(BIN)/ruff format --check .

$(VENV)/.installed: pyproject.toml requirements.lock
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --constraint requirements.lock --editable '.[dev]'
	@# nerfstudio brings OpenCV twice, and the one with windows, which a dependency of its asks for, needs libGL.
	$(BIN)/pip uninstall --quiet --yes opencv-python
	$(BIN)/pip install --quiet --constraint requirements.lock --no-deps --force-reinstall opencv-python-headless
	touch $@

clean:
	rm -rf $(VENV)
