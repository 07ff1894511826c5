# What a person and CI run. `make` alone lists it.

# The Python of .venv, 3.11.5 to 3.13, by version or path: 3.11, where the figures come from, if none is named and it is
# there; else uv takes another, or fetches one. Pages of the site need 3.11.5.
PYTHON ?=
# A folder of wheels or a page of links to them, pip's by default. Without one, torch's CPU build comes from the index
# that uv knows; `make env TORCH=cuda` takes the build of the package index.
WHEELS := $(or $(WHEELS),$(PIP_FIND_LINKS))
TORCH ?= $(if $(WHEELS),,cpu)

# Commands of dvc.yaml say `python`: they get the one of .venv. Not exported to every recipe, since the one that
# makes .venv must not find its Python there.
RUN = PATH="$(CURDIR)/.venv/bin:$$PATH" .venv/bin/python -m

export MLFLOW_DISABLE_TELEMETRY := true
export DO_NOT_TRACK := 1
export DVC_NO_ANALYTICS := 1
# The systems are small: BLAS threads wait for each other, up to 100 times longer than they work on busy cores. A stage of
# the pipeline sees to it itself; scripts of studies don't.
export OPENBLAS_NUM_THREADS ?= 1
export OMP_NUM_THREADS ?= 1
# An activated conda or another project's settings must not reach .venv. Containers often keep Python from writing what it
# compiles: each of a hundred stages would compile two thousand modules, for five seconds.
unexport PYTHONHOME PYTHONPATH PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help env demo reproduce experiments-a-l experiments-m-z test test-quick test-nightly comparison ablation paper-study studies promote dashboard bench tables measured house size docs site reference lint lock audit clean

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-12s %s\n", $$1, $$2 }' Makefile

env: .venv/.installed  ## make or update .venv (minutes the first time, nothing after that)

# Two processes: a file of tests stays in one of them.
PYTEST = $(RUN) pytest -n 2 --dist loadfile

demo: env  ## from synthetic recordings of a machine to its results on one screen and in one picture
	$(RUN) pipeline 'stage=[ingest,train,evaluate,predict,summary]' experiment=measured_demo \
		output=artifacts/demo tracking=none

# `dvc repro` alone makes the same, one stage after the other. Here two of it run at once, on different experiments, each
# stage by itself (a stage that all depend on can't be looked at by both), and all share one import of MLflow.
reproduce: env  ## run every experiment whose inputs changed (dvc repro), then the check
	$(RUN) dvc repro configure
	.venv/bin/python docs/recorder.py $(MAKE) -j2 experiments-a-l experiments-m-z
	$(RUN) dvc repro
	$(RUN) pipeline stage=check tracking=none

experiments-a-l:
	$(RUN) dvc --wait-for-lock repro --single-item --glob '*@[a-l]*'

experiments-m-z:
	$(RUN) dvc --wait-for-lock repro --single-item --glob '*@[m-z]*' ordinary

test: reproduce  ## make what changed and check it, run the tests (all but the nightly ones), and check again
	$(PYTEST)
	$(RUN) pipeline stage=check tracking=none

test-quick: env  ## run the tests that take no training
	$(PYTEST) -m "not slow and not nightly"

test-nightly: env  ## run the tests that take long: every combination, kill and restart
	$(RUN) dvc repro
	$(PYTEST) -m nightly

# One process each and few speeds: ten data sets an entry within a quarter of an hour. Interrupted, it goes on from there. Trained
# networks take ten times as long as the others: they are on the realistic machine alone.
COMPARE = $(RUN) pipeline stage=compare tracking=none comparison.workers=1 comparison.data_sets=10 \
	comparison.other_data_sets=10
AT_BEARINGS = 'comparison.sensors=[bearings]' 'comparison.speeds=[100]' 'comparison.noise=[0.01]'
ANSWER_SOON = 'comparison.methods=[least_squares,least_squares_expanded,smoothed,tikhonov,total_least_squares,$\
	multi_frequency,kalman,spline,residual,preconditioned,response]'
comparison: env  ## every method on ten data sets, into docs/measured/comparison.md (a quarter of an hour)
	$(COMPARE) experiment=hydrostatic_stiffness output=artifacts/comparison/hydrostatic_stiffness $(ANSWER_SOON) \
		'comparison.noise=[0,0.01]' 'comparison.sensors=[bearings,all,location]' 'comparison.speeds=[10,100]'
	$(COMPARE) experiment=hydrostatic_stiffness output=artifacts/comparison/kriging $(AT_BEARINGS) \
		'comparison.methods=[smoothed,kriging,response]' comparison.data_sets=3
	$(COMPARE) experiment=hydrostatic_damping output=artifacts/comparison/hydrostatic_damping $(ANSWER_SOON) $(AT_BEARINGS)
	$(COMPARE) experiment=noisy_all output=artifacts/comparison/noisy_all $(ANSWER_SOON) $(AT_BEARINGS) \
		'comparison.speeds=[60]'
	$(COMPARE) experiment=realistic machine=overhung '~identify.model_parameters' output=artifacts/comparison/realistic \
		$(AT_BEARINGS) 'comparison.speeds=[40]' 'comparison.noise=[0.005]' 'comparison.floor=0.05 um'
	$(COMPARE) experiment=all_coefficients output=artifacts/comparison/tikhonov \
		'comparison.methods=[least_squares,least_squares_expanded,smoothed,tikhonov]' \
		'comparison.sensors=[bearings,all]' 'comparison.speeds=[100]' 'comparison.noise=[0.0001,0.001]'
	$(COMPARE) experiment=all_coefficients output=artifacts/comparison/all_coefficients $(ANSWER_SOON) $(AT_BEARINGS) \
		'comparison.speeds=[40]' 'comparison.noise=[0.001]'
	$(COMPARE) experiment=impulses output=artifacts/comparison/impulses $(ANSWER_SOON) $(AT_BEARINGS) 'comparison.speeds=[20]'
	$(COMPARE) experiment=ball_bearing output=artifacts/comparison/ball_bearing $(AT_BEARINGS) \
		+comparison.most_data_sets.kriging=3 +comparison.most_data_sets.critical_speeds=3
	$(MAKE) ablation
	.venv/bin/python docs/comparison_tables.py artifacts/comparison docs/measured/comparison.md

ablation: env  ## the paper's residual, and its improvements one at a time and together, into artifacts/comparison/ablation
	$(COMPARE) experiment=hydrostatic_stiffness output=artifacts/comparison/ablation \
		'comparison.methods=[paper,paper_scaling,paper_logarithm,paper_second_order,residual]' \
		'comparison.noise=[0,0.01]' 'comparison.sensors=[bearings]' 'comparison.speeds=[100]' comparison.data_sets=3

# One worker: with more, a study's trials hang on which of them ends first.
studies: env  ## repeat the hyperparameter studies, into artifacts/studies/NAME (half an hour)
	for name in $(STUDIED); do $(STUDY_OF) experiment=$$name || exit; done
	$(STUDY_OF) experiment=realistic training.holdout_every=10
STUDIED = ball_bearing hydrostatic_stiffness hydrostatic_damping
STUDY_OF = $(RUN) pipeline stage=tune tuning.changed=restart

paper-study: env  ## Adam's rate and epochs alone, for the paper's settings, into artifacts/studies/hydrostatic_stiffness_paper
	$(STUDY_OF) experiment=hydrostatic_stiffness tuning=paper tuning.study=hydrostatic_stiffness_paper \
		tuning.n_trials=20 tuning.startup_trials=8 tuning.finalists=2 'tuning.seeds=[0,1,2]'

promote: env  ## let training use a study: make promote STUDY=NAME [EXPERIMENT=NAME]
	$(RUN) pipeline stage=promote experiment=$(or $(EXPERIMENT),$(STUDY)) tuning.study=$(STUDY) tracking=none

PORT ?= 8080
dashboard: env  ## look at all studies at http://127.0.0.1:8080, the committed ones and those of this machine
	.venv/bin/python studies/dashboard/dashboard.py
	PATH="$(CURDIR)/.venv/bin:$$PATH" optuna-dashboard sqlite:///studies/optuna.db --port $(PORT)

bench: env  ## measure ratios of speed and write docs/measured/benchmarks.md; no time fails it
	$(RUN) benchmarks --write docs/measured/benchmarks.md

tables: env  ## write the tables of README and docs from what make reproduce made
	.venv/bin/python docs/tables.py

measured: env  ## repeat what no make reproduce makes (docs/measured/NAME.json): make measured NAME=model_error
	.venv/bin/python docs/tables.py measure $(NAME)

house: env  ## draw who imports whom, docs/figures/house.png
	.venv/bin/python docs/house.py docs/figures/house.png

size: env  ## measure the house: statements, files, classes, names, and the budget of each room
	.venv/bin/python docs/size.py

reference: env  ## write docs/configuration.md from the schema and docs/meanings.yaml
	.venv/bin/python docs/reference.py

docs: env  ## serve the documentation at http://127.0.0.1:8000
	NO_MKDOCS_2_WARNING=1 $(RUN) mkdocs serve

site: env  ## build the documentation into site/, notebooks run with their outputs and figures (minutes)
	EXECUTE_NOTEBOOKS=true NO_MKDOCS_2_WARNING=1 $(RUN) mkdocs build --strict

lint: env  ## ruff and mypy, strict where the numbers are made
	$(RUN) ruff check .
	$(RUN) ruff format --check .
	$(RUN) mypy
	$(RUN) mypy --strict --follow-imports=silent -p pipeline.problem -p pipeline.identification

lock: .cache/uv/bin/uv  ## write requirements.lock, the packages of the container with their hashes, after a change of constraints.txt
	mkdir -p .cache/lock
	$(UV) pip compile -q pyproject.toml -c constraints.txt --python-version 3.11 \
		--python-platform x86_64-manylinux_2_34 --generate-hashes --no-strip-extras --no-annotate --no-header \
		--no-emit-index-url --torch-backend=cpu -o .cache/lock/made
	{ echo "# The packages that pyproject.toml needs to run, at the versions of constraints.txt, on Linux x86-64 with"; \
	  echo "# Python 3.11 and torch's CPU build; each is held by its hashes. Written by \`make lock\`."; \
	  cat .cache/lock/made; } > .cache/lock/new
	mv .cache/lock/new requirements.lock

audit: env .cache/audit/bin/pip-audit  ## ask the advisory database of Python packages about those of requirements.lock (needs the network)
	@sed 's/+cpu / /' requirements.lock > .cache/audit/requirements.txt
	@.cache/audit/bin/pip-audit -r .cache/audit/requirements.txt --disable-pip --require-hashes --strict 2> .cache/audit/said \
		|| { tail -n 1 .cache/audit/said >&2; \
			echo "Each package of requirements.lock must be known to the advisory database, without an advisory, but it is" \
				"not (the line above says why): update the package, or try again where pypi.org can be reached" >&2; \
			exit 1; }

.cache/audit/bin/pip-audit:
	.venv/bin/python -m venv .cache/audit
	.cache/audit/bin/python -m pip install -qq --disable-pip-version-check pip-audit==2.10.1

# Any Python 3 will do to get uv.
.cache/uv/bin/uv:
	@python3 -m venv .cache/uv
	@.cache/uv/bin/python -m pip install -qq --disable-pip-version-check uv==0.13.9

clean:  ## remove .venv, caches and Hydra's run folders; artifacts, studies and tracking stay
	rm -rf .venv .cache build dist site *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis outputs multirun dvc_plots
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The stamp is written last. Without one, what lies in .venv is an interrupted install and is made anew;
# with one, an edited pyproject.toml or constraints.txt updates the environment in place.
.venv/.installed: export UV_FIND_LINKS = $(WHEELS)
.venv/.installed .cache/uv/bin/uv: export PIP_FIND_LINKS = $(WHEELS)
.venv/.installed: pyproject.toml constraints.txt | .cache/uv/bin/uv
	@test -e $@ || rm -rf .venv
	@test -e $@ || $(UV) venv -q --seed --no-python-downloads -p '$(or $(PYTHON),>=3.11.5,<3.12)' .venv 2>/dev/null \
		|| $(UV) venv -q --seed --clear -p '$(or $(PYTHON),>=3.11.5,<3.14)' .venv
	@rm -f $@
	@.venv/bin/python -c 'import sys; sys.exit(not (3, 11, 5) <= sys.version_info[:3] < (3, 14))' || { \
		echo "Python 3.11.5 to 3.13 is needed, and '$(PYTHON)' is `.venv/bin/python --version`." \
			"Leave PYTHON out, or name one of these: make env PYTHON=3.13" >&2; \
		exit 1; }
	@echo "Installing the pinned packages into .venv (2.7 GB and some minutes the first time) ..."
	@$(UV) pip install -q -p .venv $(addprefix --torch-backend=,$(filter cpu,$(TORCH))) $(PACKAGES) || { \
		echo "uv could not install them (its reason stands above); pip tries." >&2; \
		.venv/bin/python -m pip install -qq --disable-pip-version-check $(PACKAGES); }
	@touch $@
UV = .cache/uv/bin/uv --system-certs
PACKAGES = -c constraints.txt -e '.[test,docs]'
