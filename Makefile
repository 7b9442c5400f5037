# Every target sets up what it needs first; see .ci/setup. `make` alone lists the targets.

SEED ?= 0
ROBOT ?= so101-mobile
ARBITER ?= on
GPU ?= fake:8GiB
OUT ?= out/demo
ARGS ?=
QUICK ?=
# Minutes of turns on each program of `make bench-gateway`, and of `make fuzz` altogether.
MINUTES ?= 10
# Of `make fuzz`: one parser alone.
TARGET ?=
# Seconds of `make chaos`.
SECONDS ?= 300
# Histories of `make nightly`, of all rule machines together; MACHINE: one of them alone.
HISTORIES ?= 100000
MACHINE ?=
# Mutants of `make mutation`; 0: all. EXPLORE: seconds of exploration for each that no test notices.
SAMPLE ?= 300
EXPLORE ?= 60

BIN := .venv/bin
CORE := .venv-core/bin
# Test tools import `tests.support` from here.
TOOL := PYTHONPATH=. $(BIN)/python
# Four workers keep two cores busy: half of the tests wait for processes most of their time.
WORKERS ?= 4
# One worker for each file, in the order of tests/conftest.py: the longest first.
BY_FILE := --dist loadfile --no-loadscope-reorder

.DEFAULT_GOAL := help
.PHONY: help setup setup-core setup-worlds setup-vllm jetson demo test test-core test-gpu nightly mutation fuzz measure lint format \
	explore stories lock sbom wheel chaos sim bench bench-doors bench-fleet bench-gateway bench-switch schemas docs clean

help: ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-13s %s\n", $$1, $$2 }' Makefile

setup: ## environment with everything (.venv)
	@bash .ci/setup full

setup-core: ## environment of the base install (.venv-core)
	@bash .ci/setup core

setup-worlds: ## LIBERO, with an older MuJoCo (.venv-worlds)
	@bash .ci/setup worlds

setup-vllm: ## vLLM for CPUs (.venv-vllm)
	@bash .ci/setup vllm

jetson: ## as root on a Jetson: system packages, Cyclone DDS, NVIDIA's torch: ARGS=--dry-run
	@bash .ci/jetson $(ARGS)

demo: setup ## find, navigate, grab in 8 GiB: SEED=0 ROBOT=panda-mobile ARBITER=off GPU=nvml OUT=out/demo
	$(BIN)/vramctl demo --seed $(SEED) --robot $(ROBOT) --arbiter $(ARBITER) --gpu $(GPU) --out $(OUT) $(ARGS)

test: setup ## the whole product; ARGS goes to pytest
	$(BIN)/pytest -q -n $(WORKERS) $(BY_FILE) -m "not gpu and not nightly" $(ARGS)

test-gpu: setup ## what needs an NVIDIA GPU, alone on it; skipped with the reason elsewhere
	$(BIN)/vramctl selftest
	$(BIN)/pytest -q -rsP tests/gpu $(ARGS)

test-core: setup-core ## the base install alone, in seconds
	$(CORE)/pytest -q -n $(WORKERS) $(BY_FILE) -m "not heavy and not e2e and not gpu" $(ARGS)

nightly: setup setup-worlds setup-vllm ## random histories of the engine: HISTORIES=100000 MACHINE=leases SEED=n; long tests
	$(BIN)/pytest -q -m nightly
	.venv-worlds/bin/pytest -q -m nightly tests/runner/sim/test_lerobot_worlds.py
	$(TOOL) tests/nightly/nightly_run.py --histories $(HISTORIES) \
		$(if $(MACHINE),--machine $(MACHINE)) $(if $(filter-out 0,$(SEED)),--seed $(SEED)) $(ARGS)

stories: setup ## write the answers in tests/arbiter/core/stories anew, for their diff
	$(TOOL) -m tests.support.stories tests/arbiter/core/stories/*.txt

explore: MINUTES = 60
explore: setup ## all orders of events of small worlds: MINUTES=60 WORLD=turns
	$(TOOL) -m tests.explore.explore_run --minutes $(MINUTES) $(addprefix --world ,$(WORLD)) $(ARGS)

mutation: setup ## small changes in arbiter/core that no core test notices: SAMPLE=300 SEED=n EXPLORE=60
	$(TOOL) tests/mutation/mutation_run.py --sample $(SAMPLE) --seed $(SEED) --explore $(EXPLORE) $(ARGS)

fuzz: setup ## bytes that break a parser of tests/fuzz/targets.py: MINUTES=10 TARGET=zmtp
	$(TOOL) -m tests.fuzz.fuzz_run --minutes $(MINUTES) $(if $(TARGET),--target $(TARGET)) $(ARGS)

measure: setup ## how long the path of a request is, and what one more request touches
	$(TOOL) tests/measure_path.py
	$(TOOL) tests/measure_request.py

lint: setup ## style, types and import layers
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: setup ## rewrite the code in the project's style
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

chaos: setup ## kill, stop and starve real processes at each step: SECONDS=300 SEED=0
	$(TOOL) tests/chaos/storm.py --seconds $(SECONDS) --seed $(SEED) --out out/chaos

sim: setup ## the daemon under simulated faults: SEED=n one run, SEEDS=1000 many on all cores
	$(TOOL) tests/sim/sim_run.py \
		$(if $(SEEDS),--seeds $(SEEDS) --out out/sim/sums.json,--seed $(SEED)) $(ARGS)

bench: setup ## latencies beside bare ZeroMQ and Redis locks: QUICK=1 is shorter
	$(TOOL) tests/bench/run.py $(if $(QUICK),--quick) $(ARGS)

bench-switch: setup ## how fast a model of 500 MB is loaded, restored and evicted: QUICK=1 is shorter
	$(TOOL) tests/bench/bench_switch.py $(if $(QUICK),--quick) $(ARGS)

bench-gateway: setup ## what the gateway adds, and two servers in room for one: MINUTES=10
	$(TOOL) tests/bench/gateway.py --minutes $(MINUTES) $(ARGS)

bench-doors: setup ## how long robots at a sidecar's doors wait while one process attacks
	$(TOOL) tests/bench/doors.py $(if $(QUICK),--quick) $(ARGS)

bench-fleet: setup ## a lease's cost in an actor of Ray, scaling, a node's death: ARGS="--quick --only calls"
	$(TOOL) tests/bench/fleet.py $(if $(QUICK),--quick) $(ARGS)

schemas: setup ## write the JSON Schemas after a model changed
	$(BIN)/python -m vram_arbiter.schemas export schemas/json

docs: setup ## the documentation site in build/site; a warning is an error
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

lock: ## constraints-hashed.txt, as pyproject.toml asks: ARGS=--upgrade, or ARGS="-P numpy"
	@bash .ci/lock $(ARGS)

sbom: setup ## CycloneDX list of the packages of constraints-hashed.txt: out/sbom.cdx.json
	mkdir -p out
	$(BIN)/cyclonedx-py requirements --pyproject pyproject.toml --output-reproducible \
		--output-file out/sbom.cdx.json constraints-hashed.txt

wheel: setup ## dist/vram_arbiter-*.whl, the same bytes wherever it is built
	$(BIN)/python -m hatchling build -t wheel

clean: ## remove environments, caches and outputs
	rm -rf .venv .venv-core .venv-worlds .venv-vllm build dist out .coverage
	rm -rf .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
