# Every target sets up what it needs first; see .ci/setup. `make` alone says what there is.

SEED ?= 0
ARBITER ?= on
GPU ?= fake:8GiB
OUT ?= out/demo
PREFIX ?= /opt/vram-arbiter
DESTDIR ?=
ARGS ?=
QUICK ?=
# How long `make chaos` storms.
SECONDS ?= 300
# How many histories `make nightly` walks, of all machines together; one machine alone.
HISTORIES ?= 100000
MACHINE ?=
# How many mutants `make mutation` tries; 0: all.
SAMPLE ?= 300

BIN := .venv/bin
CORE := .venv-core/bin
# The tools of the tests find `tests.support` from here.
TOOL := PYTHONPATH=. $(BIN)/python
# Two workers: more only make the tests of timing fight for the cores of a small machine.
WORKERS ?= 2

.DEFAULT_GOAL := help
.PHONY: help setup setup-core demo test test-core nightly mutation lint format chaos sim bench schemas install-units clean

help: ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-13s %s\n", $$1, $$2 }' Makefile

setup: ## environment with everything (.venv)
	@bash .ci/setup full

setup-core: ## environment of the base install (.venv-core)
	@bash .ci/setup core

demo: setup ## find, navigate, grab in 8 GiB: SEED=0 ARBITER=on|off GPU=fake:8GiB|nvml OUT=out/demo
	$(BIN)/vramctl demo --seed $(SEED) --arbiter $(ARBITER) --gpu $(GPU) --out $(OUT) $(ARGS)

test: setup ## the whole product; ARGS goes to pytest
	$(BIN)/pytest -q -n $(WORKERS) --dist loadfile -m "not e2e" $(ARGS)
	$(BIN)/pytest -q -n $(WORKERS) --dist loadfile -m e2e $(ARGS)

test-core: setup-core ## the base install alone, in seconds
	$(CORE)/pytest -q -n $(WORKERS) --dist loadfile -m "not heavy and not e2e and not gpu" $(ARGS)

nightly: setup ## the engine's rule machines, far and at random, on all cores: HISTORIES=100000 MACHINE=leases SEED=n
	$(TOOL) tests/nightly/nightly_run.py --histories $(HISTORIES) $(if $(MACHINE),--machine $(MACHINE)) $(if $(filter-out 0,$(SEED)),--seed $(SEED)) $(ARGS)

mutation: setup ## small changes in arbiter/core that no test of the core sees: SAMPLE=300 of them by chance, SEED=n
	$(TOOL) tests/mutation/mutation_run.py --sample $(SAMPLE) --seed $(SEED) $(ARGS)

lint: setup ## style, types and who may import whom
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: setup ## rewrite the code in the project's style
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

chaos: setup ## kill, stop and starve real processes at every step of a switch: SECONDS=300 SEED=0
	$(TOOL) tests/chaos/storm.py --seconds $(SECONDS) --seed $(SEED) --out out/chaos

sim: setup ## the daemon under simulated faults: SEED=n one run with its story, SEEDS=1000 many on all cores
	$(TOOL) tests/sim/sim_run.py $(if $(SEEDS),--seeds $(SEEDS) --out out/sim/sums.json,--seed $(SEED)) $(ARGS)

bench: setup ## how fast it is, beside bare ZeroMQ and Redis locks: QUICK=1 takes less of everything
	$(TOOL) tests/bench/run.py $(if $(QUICK),--quick) $(ARGS)

schemas: setup ## write the JSON Schemas anew after a model changed
	$(BIN)/python -m vram_arbiter.schemas export schemas/json

install-units: ## copy the systemd units into the system (docs/systemd.md): PREFIX=/opt/vram-arbiter DESTDIR=
	@bash .ci/install-units "$(PREFIX)" "$(DESTDIR)"

clean: ## remove environments, caches and outputs
	rm -rf .venv .venv-core build dist out .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis .coverage
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
