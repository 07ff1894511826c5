# What a person and CI run. `make` alone lists it.
PYTHON ?= python3.11

# Commands of dvc.yaml say `python`: they get the one of .venv. Not exported to every recipe, since the one that
# makes .venv must not find its Python there.
RUN = PATH="$(CURDIR)/.venv/bin:$$PATH" .venv/bin/python -m

export MLFLOW_DISABLE_TELEMETRY := true
export DO_NOT_TRACK := 1
export DVC_NO_ANALYTICS := 1
# An activated conda or another project's settings must not reach .venv.
unexport PYTHONHOME PYTHONPATH

.DEFAULT_GOAL := help
.PHONY: help env reproduce demo bench test test-quick lint clean

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-12s %s\n", $$1, $$2 }' Makefile

env: .venv/.installed  ## make or update .venv (minutes the first time, nothing after that)

reproduce: env  ## run every experiment whose inputs changed, then the check (dvc repro)
	$(RUN) dvc repro

demo: env  ## from recordings of a machine to its results on one screen and in one picture
	$(RUN) pipeline 'stage=[ingest,train,evaluate,predict,summary]' experiment=measured_demo \
		output=artifacts/demo tracking=none

bench: env  ## measure ratios of speed and write docs/benchmarks.md; no time fails it
	$(RUN) benchmarks --write docs/benchmarks.md

test: env  ## run all tests, the slow ones too
	$(RUN) pytest

test-quick: env  ## run the tests that take no training
	$(RUN) pytest -m "not slow"

lint: env  ## ruff and mypy
	$(RUN) ruff check .
	$(RUN) mypy

clean:  ## remove .venv, caches and Hydra's run folders; artifacts, studies and tracking stay
	rm -rf .venv build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis outputs multirun dvc_plots
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The stamp is written last. Without one, what lies in .venv is an interrupted install and is made anew;
# with one, an edited pyproject.toml or constraints.txt updates the environment in place.
.venv/.installed: pyproject.toml constraints.txt
	@test -e $@ || rm -rf .venv
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' 2>/dev/null || { \
		echo "Python 3.11 is needed and '$(PYTHON)' is not one." \
			"Install it, or name it: make PYTHON=/path/to/python3.11" >&2; \
		exit 1; }
	@test -e $@ || "$(PYTHON)" -m venv .venv
	@rm -f $@
	@echo "Installing the pinned packages into .venv (2.4 GB and some minutes the first time) ..."
	@.venv/bin/python -m pip install -qq --disable-pip-version-check -c constraints.txt -e '.[test]'
	@touch $@
