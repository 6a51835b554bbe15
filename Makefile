# make demo   (greybox demo) own environment, install, fit the shipped real flights, write a report, print where it is
# make demo-mpc   the same for control: identify a simulated vehicle from one flight, fly it inside limits; once installed,
#             either takes one and a half to four minutes on two idle cores, as these are fast or slow
# make test   own environment, install, lint, type check, the quick tests
# make test-long   whole commands, fits, searches and exports: the other half of what every change is held against
# make test-slow   the long studies, and the other cases of what one case holds in the two above
# make test-releases   wheel and sdist in clean environments on Python 3.11 to 3.13 (PYTHONS="/path/python3.12 ..."),
#             oldest and newest versions of what they need; about twenty minutes, asks PyPI
# make site   the documentation as pages with search, in site/
# make docs   write the pages that are generated from the code: reference, functions, types and effects in docs
PYTHON ?= python3
VENV ?= .venv
OUT ?= demo_out
COMMA := ,
BIN = $(VENV)/bin
STAMP = $(VENV)/.installed
DEMO_STAMP = $(VENV)/.installed-demo
PIP = $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt
# Training a GP needs PyTorch. Its CPU build is small, but there for Python 3.11 only; elsewhere pip would fetch CUDA, and
# the tests that train are skipped.
EXTRAS := $(shell $(PYTHON) -c 'import sys; print("test,dev,logs" + (",gp" if sys.version_info < (3, 12) else ""))')
# CONSUMERS=1 also installs do-mpc, rockit and FMPy, with which exports are tried; without them those tests are skipped.
CONSUMERS ?=
# JUDGE=1 also installs RotorPy, MuJoCo and drone-models, which fly craft that greybox is judged on (scenarios/foreign).
JUDGE ?=
override EXTRAS := $(EXTRAS)$(if $(CONSUMERS),$(COMMA)consumers)$(if $(JUDGE),$(COMMA)judge)
JOBS ?= 2

# Small matrices: one BLAS thread is faster than many, and the results do not depend on the machine.
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1
export MKL_NUM_THREADS ?= 1
# Containers often forbid Python to keep what it compiled. Each command that a test starts would then compile it again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo demo-mpc test test-long test-slow test-releases docs site lint clean install

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(if $(findstring gp,$(EXTRAS)),$(PIP) torch)
	$(PIP) -e ".[$(EXTRAS)]"
	touch $(STAMP)

# What the control demo needs, and no more: whoever only wants to see it does not wait for test tools and readers of logs.
$(DEMO_STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(if $(findstring gp,$(EXTRAS)),$(PIP) torch)
	$(PIP) -e ".$(if $(findstring gp,$(EXTRAS)),[gp])"
	touch $(DEMO_STAMP)

install: $(STAMP)

demo: $(STAMP)
	$(BIN)/python -m greybox demo --out $(OUT)

demo-mpc: OUT = demo_mpc_out
demo-mpc: $(DEMO_STAMP)
	$(BIN)/python -m mpc_export.mission.demo --out $(OUT) --jobs $(JOBS)

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

test: lint
	$(BIN)/python -m pytest --part quick -n $(JOBS) --dist loadfile -rs

test-long: $(STAMP)
	$(BIN)/python -m pytest --part long -n $(JOBS) --dist loadfile -rs

test-slow: $(STAMP)
	$(BIN)/python -m pytest -m slow -n $(JOBS) --dist loadfile

test-releases: $(STAMP)
	$(BIN)/python -m pytest -m slow -n 0 -s -rs tests/packaging

docs: $(STAMP)
	$(BIN)/python -m docs.tools.reference docs
	$(BIN)/python -m greybox.commands.effects --markdown > docs/effects.new && mv docs/effects.new docs/effects.md

# The documentation as a site that asks nothing of a network: python -m http.server -d site
site: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --site-dir site

clean:
	rm -rf $(VENV) $(OUT) demo_mpc_out build site *.egg-info
