# Two commands do all the set-up on a fresh machine: `make run` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.DEFAULT_GOAL := help
.PHONY: help setup run test coverage nightly mutation lint docs benchmark clean

help:            ## list the targets
	@sed -n 's/^\([a-z]*\):.*## /\1\t/p' $(MAKEFILE_LIST)

setup: $(STAMP)  ## create .venv and install everything into it

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "pumpbench needs Python 3.11 or newer; this is %s (set PYTHON=...)" % sys.version.split()[0])'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

run: setup       ## one closed-loop day over the embedded bus, with a recording
	$(BIN)/pumpbench run

test: setup      ## linters, then all tests: on the embedded bus here, on a real vcan through tools/with_vcan
	tools/run_tests

coverage: setup  ## lines and branches of the firmware that no test runs: none may be left
	$(BIN)/python -m pytest -m "not vcan" -n logical --dist loadfile --cov --cov-report=term-missing

nightly: setup   ## the long tests: hostile sequences, random frames, oracle and compiled loop, matrix, hunt and kills in full
	PUMPBENCH_NIGHTLY=1 PUMPBENCH_SEQUENCES=10000 PUMPBENCH_RANDOM_FRAMES=1000000 PUMPBENCH_KILLS=1000 \
	  $(BIN)/python -m pytest --timeout 5400 -n logical --dist loadfile tests/test_hostile.py tests/test_float_oracle.py \
	  tests/test_compiled_loop.py tests/test_catalogue.py tests/test_hunt.py tests/test_kills.py tests/test_conformance_variants.py
	PUMPBENCH_NIGHTLY=1 $(BIN)/python -m pytest --timeout 5400 -n logical --dist loadfile -m "nightly and not vcan"

mutation: setup  ## mutation score of the dosing, limits, protocol and memory modules (about an hour)
	$(BIN)/mutmut run
	$(BIN)/mutmut results

lint: setup      ## ruff, mypy, import-linter, generated files up to date
	tools/run_lint

docs: setup      ## regenerate the generated pages of docs/
	$(BIN)/python tools/generate_docs.py

benchmark: setup ## the speed figures, each beside its ceiling
	$(BIN)/pumpbench benchmark

clean:           ## remove what was built, runs/ too
	rm -rf $(VENV) build dist runs .pytest_cache .mypy_cache .ruff_cache .hypothesis
