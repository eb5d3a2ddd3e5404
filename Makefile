# `make demo` and `make test` are the whole set-up: they build the virtual environment when it is missing
# or older than the dependency files.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

export OMP_NUM_THREADS ?= 2

.PHONY: demo test test-slow soak lint bench paper networks clean

demo: $(READY)
	$(BIN)/phase-sumo demo --out out/demo

test: lint
	$(BIN)/pytest

test-slow: $(READY)
	$(BIN)/pytest -m slow

soak: $(READY)
	$(BIN)/python -m tests.soak --vehicles 500 --seconds 3600

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/pyright

bench: $(READY)
	$(BIN)/phase-sumo bench --json out/bench.json

paper: $(READY)
	$(BIN)/python -m tools.results.paper --logs $(LOGS)

networks: $(READY)
	$(BIN)/python -m tools.networks.generate
	$(BIN)/python -m tools.networks.hard
	$(BIN)/python -m tools.scenarios

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or newer is needed; name one with make PYTHON=python3.x" if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $(READY)

clean:
	rm -rf $(VENV) out build *.egg-info
