# The verbs for people. Paths are relative, so that the folder may have spaces in its name.
.DEFAULT_GOAL := help
# If it is set, each of the many test processes compiles torch's sources again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help setup demo suite90 base rl test test-all rehearse gpu-check lint docs bench clean

BIN := .venv/bin
# Each takes about 2 GB, and 10 s to start. One more than two cores: tests wait for processes that they stop.
TEST_PROCESSES ?= 3
PYTEST := $(BIN)/python -m pytest --numprocesses $(TEST_PROCESSES) --dist worksteal

help:  ## list these verbs
	@awk -F ':.*## ' '/^[a-z0-9-]+:.*## / { printf "  make %-10s %s\n", $$1, $$2 }' Makefile

setup:  ## create .venv and install a Vulkan driver if there is none
	@bash scripts/setup.sh

demo: setup  ## evaluate scripted policies and two learned ones, print the tables, write the report pages
	$(BIN)/mikasa-vla eval configs/demo.yaml --html runs/demo-report
	$(BIN)/mikasa-vla eval configs/demo_memory.yaml --html runs/demo-memory-report

suite90: setup  ## install the official package of 90 tasks beside this one, without its pins
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --ignore-requires-python \
		--require-hashes --requirement scripts/suite90.txt
	$(BIN)/mikasa-vla list tasks --suite mikasa_vla_90

base: setup  ## install what the tasks of MIKASA-Base need, the two in 3D included
	@bash scripts/base.sh

rl: setup  ## install what training by rewards (train-agent) needs
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --requirement scripts/rl.txt

test: base rl  ## run the tests that need neither GPU, network nor much time
	$(PYTEST)

test-all: base rl  ## run every test this machine can run
	$(PYTEST) -m "not network and not parity and not peer and not full_size and not suite90"

rehearse: setup  ## write, load and run every policy at its published size: 20 GB of memory, 30 GB of disk
	$(BIN)/python scripts/rehearse.py

gpu-check: setup  ## measure a machine with a GPU: at most 30 minutes, resumable, writes runs/gpu_check
	$(BIN)/python scripts/gpu_check.py

lint: setup  ## ruff, mypy --strict and import-linter
	$(BIN)/python -m ruff check .
	$(BIN)/python -m ruff format --check .
	$(BIN)/python -m mypy
	$(BIN)/lint-imports --no-cache

docs: setup  ## build the documentation into site/; a warning is an error
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	@echo "Documentation: site/index.html"

bench: setup  ## measure the speed of this machine
	$(BIN)/mikasa-vla bench
	$(BIN)/mikasa-vla bench --loader

clean:  ## remove .venv and caches; results in runs/ stay
	rm -rf .venv dist build site .mypy_cache .ruff_cache .pytest_cache
