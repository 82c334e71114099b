# Everything runs from a virtual environment in the project; nothing is installed outside it.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
OUT    ?= out/demo
SEED   ?= 0
# Tests of real processes, the longest first, three at a time: most of them wait. Whatever is not listed here only
# computes. What judges times is marked "alone", and runs so at the end.
PROCESSES := $(addprefix tests/e2e/,test_soak.py test_scale.py test_demo.py) \
          tests/service/failover tests/service/protocol/test_fuzz.py \
          $(addprefix tests/benchmarks/,test_fuzz_bench.py test_latency_bench.py) \
          $(addprefix tests/service/,viewer/test_sink.py viewer/test_live.py operating security \
          server/test_process.py server/test_gap_live.py storage/test_recorder.py storage/test_folders.py \
          stage_node fleet adapters commissioning client protocol/test_protocol_page.py background/test_priority.py \
          runtime/test_memory.py runtime/test_stopping.py)
COMPILE = uv pip compile -q --universal --python-version 3.11 --generate-hashes --no-header --no-annotate \
          --no-emit-index-url --extra build --extra serve --extra viewer --extra lab

# One BLAS thread: two make a 1 ms solve stall for 65 ms now and then (docs/architecture.md).
export OPENBLAS_NUM_THREADS ?= 1
export OMP_NUM_THREADS ?= 1
# Each of the hundreds of processes that tests start would compile what it imports once more.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help setup setup-test demo test test-processes test-computing test-long test-clients wheel-check check docs bench foreign \
        fuzz blind blind-foreign vectors requirements clean
help: ## show this list
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 16

setup: .setup-run ## virtual environment with what running needs (1.3 GB)
	@$(BIN)/python -m dehyst.service.warm
setup-test: .setup-test ## the same with torch, peers and the checkers (7 GB)
	@$(BIN)/python -m dehyst.service.warm

$(BIN)/python:
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(0 if v >= (3, 11) else "dehyst needs Python 3.11 or newer, this is %d.%d: call make PYTHON=python3.11" % v[:2])'
	$(PYTHON) -m venv $(VENV)

.setup-run: requirements.txt pyproject.toml setup.py | $(BIN)/python
	$(BIN)/python -m pip install -q --disable-pip-version-check --require-hashes -r requirements.txt
	$(BIN)/python -m pip install -q --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

.setup-test: requirements-test.txt pyproject.toml setup.py | $(BIN)/python
	$(BIN)/python -m pip install -q --disable-pip-version-check --require-hashes -r requirements-test.txt
	$(BIN)/python -m pip install -q --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@ .setup-run

demo: setup ## watch a stage lose its hysteresis, drift, and be caught again
	$(BIN)/dehyst demo --out $(OUT)
	@# The demonstration's stage was built together with the service; these were not.
	@$(BIN)/python -m benchmarks.foreign --line

test: ## lint, types, import contract, and all tests
	@# What is compiled at set-up leaves a core idle, on which the checkers run meanwhile.
	@$(MAKE) --no-print-directory -j2 setup-test check
	@$(MAKE) --no-print-directory test-computing
	@$(MAKE) --no-print-directory test-processes
	$(BIN)/python -m pytest -m alone $$(grep -rl --include='test_*.py' mark.alone tests)

test-processes: .setup-test
	$(BIN)/python -m pytest -n 3 --dist loadfile --no-loadscope-reorder -m "not alone and not long" $(PROCESSES)

test-computing: .setup-test
	$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder -m "not alone and not long" \
	    $(addprefix --ignore=,$(PROCESSES))

test-long: .setup-test ## whole diagnoses of records of other generators, whole commissionings (ten minutes)
	$(BIN)/python -m pytest -n 2 --dist load -m long tests/sim tests/service/commissioning

test-clients: ## build and test the clients in Rust and C (needs cargo; without it says so)
	@sh clients/test.sh

wheel-check: setup-test ## build the wheel, install it into a fresh environment, and run its client there (needs a package index)
	$(BIN)/python .ci/wheel_check.py

check: .setup-test ## ruff, mypy --strict, the import contract
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	@# As they are installed: neither finds a package whose folder lies beside it.
	@rm -rf build/typed && $(BIN)/python setup.py -q build_py --build-lib build/typed
	@cd build/typed && $(abspath $(BIN))/mypy --config-file ../../pyproject.toml --cache-dir ../../.mypy_cache
	@cd build/typed && $(abspath $(BIN))/lint-imports --config ../../pyproject.toml --cache-dir ../../.import_linter_cache

docs: .setup-test ## the site of the documentation, offline, into out/site; a warning is an error
	@NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	@echo "out/site/index.html: to search in it, call $(BIN)/python -m http.server --directory out/site"

bench: setup-test ## the solver beside its yardsticks
	$(BIN)/dehyst bench

foreign: setup ## 500 random stages and events in lockstep, with the table of goals, and controllers (40 minutes; SEED=0)
	$(BIN)/python -m benchmarks.foreign --runs 500 --first-seed $(SEED) --jobs 2 --json out/foreign.jsonl
	$(BIN)/python -m benchmarks.foreign --controllers 1 5 20 --runs 10 --first-seed $(SEED) --jobs 2 --json out/controllers.jsonl

fuzz: setup-test ## a million malformed payloads, by coverage, and a live service under fire (minutes)
	$(BIN)/python -m benchmarks.fuzz --out out/fuzz

vectors: setup ## make the test vectors of the protocol anew
	$(BIN)/python -m tests.vectors.make_vectors

blind: setup-test ## score the diagnosis on 218 recordings with hidden effects (about half an hour)
	$(BIN)/python -m tests.hidden.blind

blind-foreign: setup-test ## the same on 92 recordings of six other hysteresis models, rigs and drives (half an hour)
	$(BIN)/python -m tests.hidden.foreign

requirements: ## pin both requirement files anew (needs uv)
	$(COMPILE) pyproject.toml -o requirements.txt
	$(COMPILE) --extra test pyproject.toml -o requirements-test.txt

clean: ## remove the environment and everything built
	rm -rf $(VENV) .setup-run .setup-test out build *.egg-info
