# Every target sets itself up: a .venv with the locked packages, made once and again when a lock changes.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.DEFAULT_GOAL := help
.PHONY: help setup demo test check lock bench figures studies real clean

help: ## what can be made
	@grep -hE '^[a-z]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z]+):.*## /  make \1\t/'

$(VENV)/user.stamp: requirements/user.lock pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements/user.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@touch $@

$(VENV)/test.stamp: requirements/test.lock $(VENV)/user.stamp
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements/test.lock
	@touch $@

setup: $(VENV)/user.stamp ## the program and what it needs, in .venv

demo: $(VENV)/user.stamp ## four simulated radars, then a recorded ferry: processes decide over Zenoh
	@rm -rf runs/four-radars runs/autoferry-5
	@$(BIN)/waldnet run four-radars --speed 10 --out runs/four-radars
	@$(BIN)/waldnet run autoferry-5 --speed 10 --out runs/autoferry-5
	@echo
	@echo "Look at, in runs/four-radars and in runs/autoferry-5:"
	@echo "  log_lr.png      log LR of every hypothesis, until it crossed a threshold and after"
	@echo "  plan.png        sensors, plots, tracks with 95 % ellipses"
	@echo "  decisions.json  what was decided when;  tracks.jsonl  every track at every time;  logs/  of the processes"
	@echo "  input/  the scenario and all plots, to replay or to evaluate"

# A file stays with one process, which makes its fixtures once; in order, for by number of tests the longest come last.
test: $(VENV)/test.stamp ## all tests
	$(BIN)/python -m pytest --numprocesses logical --dist loadfile --no-loadscope-reorder

check: $(VENV)/test.stamp ## what CI checks beside the tests: format, lint, types, import rules
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

lock: ## resolve the locks anew from pyproject.toml (needs uv)
	uv pip compile pyproject.toml requirements/build.in --universal --python-version 3.11 --generate-hashes --no-emit-index-url --no-header --quiet -o requirements/user.lock
	uv pip compile pyproject.toml requirements/build.in --extra test -c requirements/user.lock --universal --python-version 3.11 --generate-hashes --no-emit-index-url --no-header --quiet -o requirements/test.lock

bench: $(VENV)/test.stamp ## speed of the estimator beside Stone Soup, and of the steps
	$(BIN)/python waldnet/benchmarks/estimator.py
	$(BIN)/python waldnet/benchmarks/steps.py

figures: $(VENV)/test.stamp ## measure all figures of docs/performance.md and many-targets.md anew (half an hour, needs root)
	$(BIN)/python -m waldnet.benchmarks.figures docs/performance.md
	$(BIN)/python -m waldnet.benchmarks.figures docs/many-targets.md bench

studies: $(VENV)/test.stamp ## play all studies of docs/studies.md and the pairs of many-targets.md anew (an hour and a half)
	$(BIN)/python -m waldnet.benchmarks.figures docs/studies.md
	$(BIN)/python -m waldnet.benchmarks.figures docs/many-targets.md pairs

real: $(VENV)/test.stamp ## track the recorded scenarios of docs/real-runs.md anew, with waldnet and a peer (a quarter of an hour)
	$(BIN)/python -m waldnet.benchmarks.figures docs/real-runs.md

clean: ## remove what was made
	rm -rf $(VENV) runs .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis build *.egg-info
