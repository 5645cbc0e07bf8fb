# make demo   clean a ghost-ridden room on the CPU (installs megabytes, no torch)
# make test   install everything and run every test
# Each does all of its own set-up; a second run is quick. `make help` lists the rest.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --no-input
PINS := -c constraints.txt
MADE := $(VENV)/.made
INPUTS := pyproject.toml constraints.txt
SYSTEM_PACKAGES := libusb-1.0-0 libgl1 libegl1 libgomp1 libx11-6

BROWSERS := chromium chromium-browser google-chrome google-chrome-stable

NERFSTUDIO := .venv-nerfstudio
NERFSTUDIO_NEEDS := 'viser==0.2.7' 'tyro<0.10' tensorboard 'protobuf<=3.20.3' torchmetrics jaxtyping \
	opencv-python-headless matplotlib splines rich msgpack safetensors tqdm onnxruntime pyyaml pycolmap

NERFBASELINES := .venv-nerfbaselines
NERFBASELINES_NEEDS := 'numpy<2' opencv-python-headless click tqdm Pillow matplotlib plyfile tensorboard scipy \
	typing-extensions onnxruntime tyro

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-fast check bench-short clean clean-all demo-setup nerfstudio nerfbaselines

help:
	@echo "make demo       clean a synthetic room with labelled ghosts; writes out/demo/index.html (no torch)"
	@echo "make test       set up everything, then run the whole test suite"
	@echo "make test-fast  what takes under half a second of it, in under a minute"
	@echo "make setup      create .venv with every extra, pinned by constraints.txt"
	@echo "make check      ruff, formatting, mypy"
	@echo "make bench-short  the short form of every benchmark that needs no data, into out/short"
	@echo "make nerfstudio nerfacto with the regularizer on, for some steps, in .venv-nerfstudio"
	@echo "make nerfbaselines  its command line scores with this project's protocols, in .venv-nerfbaselines"
	@echo "make clean      remove caches and builds"
	@echo "make clean-all  the same, and .venv"
	@echo "PYTHON=python3.12 make …  to choose the interpreter (3.10 or later)"

$(MADE)/venv:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' \
		|| { echo "unghost needs Python 3.10 or later; try: make PYTHON=python3.12"; exit 1; }
	@test -x $(BIN)/python && $(BIN)/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv $(VENV) \
		|| { rm -rf $(VENV); echo "no venv module: apt-get install python3-venv, then again"; exit 1; }
	@mkdir -p $(MADE) && touch $@

# The light half: what `unghost demo` uses and nothing else.
$(MADE)/demo: $(INPUTS) | $(MADE)/venv
	@echo "setting up $(VENV) for the demo (numpy, onnxruntime, scipy, matplotlib, Jinja2; no torch) …"
	@$(PIP) install --quiet $(PINS) -e '.[demo]'
	@touch $@

# Everything. torch goes first and alone, so that whichever build of the pinned version the
# configured index offers (the CPU one, if it does) is settled before anything else asks for it.
$(MADE)/full: $(INPUTS) | $(MADE)/venv
	@echo "setting up $(VENV) with everything (torch, open3d, …): a few minutes the first time …"
	@$(PIP) install --quiet $(PINS) torch==2.13.0
	@$(PIP) install --quiet $(PINS) -e '.[dev]'
	@touch $(MADE)/demo $@

# open3d is a wheel that expects a few system libraries. Never fatal: only the code that calls open3d needs them.
$(MADE)/system: | $(MADE)/full
	@if $(BIN)/python -c 'import open3d' >/dev/null 2>&1; then :; \
	elif [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
		echo "installing $(SYSTEM_PACKAGES) for open3d"; \
		{ apt-get -qq update && DEBIAN_FRONTEND=noninteractive apt-get -qq install -y --no-install-recommends \
			$(SYSTEM_PACKAGES); } >/dev/null 2>&1 \
			|| echo "could not install them; open3d stays unusable until: apt-get install $(SYSTEM_PACKAGES)"; \
	else echo "open3d lacks system libraries; run: sudo apt-get install $(SYSTEM_PACKAGES)"; fi
	@touch $@

# The page of `unghost evaluate` is opened in a real browser. Never fatal: without one those tests are skipped.
$(MADE)/browser: | $(MADE)/venv
	@if for name in $(BROWSERS); do command -v $$name && break; done >/dev/null; then :; \
	elif [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
		echo "installing chromium for the tests of pages"; \
		{ apt-get -qq update && DEBIAN_FRONTEND=noninteractive timeout 600 apt-get -qq install -y \
			--no-install-recommends chromium; } >/dev/null 2>&1 \
			|| echo "could not install it; the tests of pages are skipped until: apt-get install chromium"; \
	else echo "no chromium: the tests of pages are skipped; sudo apt-get install chromium"; fi
	@touch $@

setup: $(MADE)/full $(MADE)/system

demo-setup: $(MADE)/demo

demo: demo-setup
	@$(BIN)/unghost demo

# Two processes of one thread each: most tests are too small to share between threads.
test: setup $(MADE)/browser
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --durations=20

# Under a minute, while one works; what takes long (examples, trainings, killed processes) is left to `make test`.
test-fast: setup
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 -m "not slow"

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# One after the other; each writes its output to out/short/logs. benchmarks/README.md lists them.
bench-short: setup
	$(BIN)/python -m benchmarks.all_short $(ARGUMENTS)

# nerfstudio 1.1.5 pins an old protobuf and much that its models do without: an environment of its own, no dependencies.
$(NERFSTUDIO)/.made:
	@echo "setting up $(NERFSTUDIO) with nerfstudio 1.1.5 …"
	@$(PYTHON) -m venv $(NERFSTUDIO)
	@$(NERFSTUDIO)/bin/pip install --quiet torch==2.13.0 numpy setuptools wheel
	@$(NERFSTUDIO)/bin/pip install --quiet --no-deps nerfstudio==1.1.5 nerfacc==0.5.2
	@$(NERFSTUDIO)/bin/pip install --quiet $(NERFSTUDIO_NEEDS)
	@$(NERFSTUDIO)/bin/pip install --quiet --no-deps --no-build-isolation -e .
	@touch $@

nerfstudio: $(NERFSTUDIO)/.made
	$(NERFSTUDIO)/bin/python -W ignore -m benchmarks.integrations.nerfstudio $(ARGUMENTS)

# nerfbaselines 1.2.12 wants numpy < 2, an OpenCV with a screen, and torch (only to see that it is there).
$(NERFBASELINES)/.made:
	@echo "setting up $(NERFBASELINES) with nerfbaselines 1.2.12 …"
	@$(PYTHON) -m venv $(NERFBASELINES)
	@$(NERFBASELINES)/bin/pip install --quiet torch==2.13.0 'numpy<2' setuptools wheel
	@$(NERFBASELINES)/bin/pip install --quiet --no-deps nerfbaselines==1.2.12
	@$(NERFBASELINES)/bin/pip install --quiet $(NERFBASELINES_NEEDS)
	@$(NERFBASELINES)/bin/pip install --quiet --no-deps --no-build-isolation -e .
	@touch $@

nerfbaselines: $(NERFBASELINES)/.made
	$(NERFBASELINES)/bin/python -W ignore -m benchmarks.integrations.nerfbaselines $(ARGUMENTS)

clean:
	rm -rf build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +

clean-all: clean
	rm -rf $(VENV) $(NERFSTUDIO) $(NERFBASELINES)
