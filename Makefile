# The two commands of the README are `make demo` and `make test`; the others are for developers.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAGE ?= room_area
MAX_BYTES := 500000

.PHONY: help demo test lint format clean
.DEFAULT_GOAL := help

help:
	@echo 'make demo    relight a bundled stage into out/demo.exr and out/demo.png'
	@echo 'make test    run the tests'
	@echo 'make lint    check style, types and file sizes'
	@echo 'make format  rewrite the sources in the house style'
	@echo 'make clean   remove what the others made'

# A stamp says what is installed; pyproject.toml is newer when the dependencies may have changed.
$(VENV)/bin/pip:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || \
	  { echo 'Python 3.10 or newer is needed; name one with: make PYTHON=python3.12'; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || \
	  { echo 'Python cannot make a virtual environment here; try: apt-get install python3-venv'; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.run-installed: pyproject.toml | $(VENV)/bin/pip
	$(BIN)/python -m pip install --quiet -e .
	@touch $@

$(VENV)/.test-installed: pyproject.toml | $(VENV)/bin/pip
	$(BIN)/python -m pip install --quiet -e '.[test]'
	@touch $@ $(VENV)/.run-installed

$(VENV)/.dev-installed: pyproject.toml | $(VENV)/bin/pip
	$(BIN)/python -m pip install --quiet -e '.[dev]'
	@touch $@ $(VENV)/.run-installed

demo: $(VENV)/.run-installed
	@mkdir -p out
	@echo 'Relighting $(STAGE); the first run also compiles the kernels, for about half a minute.'
	@$(BIN)/warp-dvct relight "$$($(BIN)/warp-dvct scenes $(STAGE))" out/demo.exr
	@echo 'The picture is $(CURDIR)/out/demo.png; all its layers are in $(CURDIR)/out/demo.exr'

test: $(VENV)/.test-installed
	$(BIN)/python -m pytest

# pyright sees links to the folders that only an installation maps into the package, and untyped stand-ins for what has
# no types (the kernels, which are Warp's own language, and pxr) or may be absent (what the extras bring).
STAND_INS := pxr/__init__.py flip_evaluator.py mitsuba.py drjit.py oidn.py open3d.py cv2.py libusb_package.py matplotlib/__init__.py matplotlib/pyplot.py
lint: $(VENV)/.dev-installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	@rm -rf $(VENV)/typing && mkdir -p $(VENV)/typing/warp_dvct/kernels $(VENV)/typing/pxr $(VENV)/typing/matplotlib
	@ln -s ../../../bench ../../../usd_scenes $(VENV)/typing/warp_dvct/
	@for f in $(STAND_INS) $$(ls kernels/*.py | sed 's,^,warp_dvct/,'); do \
	  printf 'from typing import Any\n\ndef __getattr__(name: str) -> Any: ...\n' > $(VENV)/typing/$${f}i; done
	$(BIN)/pyright
	@big=$$(git ls-files -z 2>/dev/null | xargs -0 -r -I{} find {} -maxdepth 0 -size +$(MAX_BYTES)c 2>/dev/null); \
	  if [ -n "$$big" ]; then echo "larger than $(MAX_BYTES) bytes:"; echo "$$big"; exit 1; fi

format: $(VENV)/.dev-installed
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) out build dist *.egg-info .pytest_cache .ruff_cache .hypothesis .cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
