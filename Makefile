# Everything here sets itself up: git, make and Python 3.11 or later are all it asks for.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
PIP_INSTALL := $(BIN)/python -m pip install -c constraints.txt

PAGE := docs/performance.md

.PHONY: demo test lint bench bench-check profile web
.DELETE_ON_ERROR:

demo: .venv/stamp-run  ## make an object, photograph it in two states, rebuild it as a moving twin in demo/
	$(BIN)/hingesplat demo --out demo

test: .venv/stamp-dev .venv/mujoco-3.3
	$(BIN)/python -m pytest

lint: .venv/stamp-dev
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/pyright
	$(BIN)/lint-imports

bench: .venv/stamp-bench  ## measure everything, write benchmarks/results/, set the tables in README.md and docs/performance.md
	$(BIN)/python benchmarks/rasteriser.py --page $(PAGE)
	$(BIN)/python benchmarks/start.py --page $(PAGE)
	$(BIN)/python benchmarks/growth.py --page $(PAGE)
	$(BIN)/python benchmarks/run.py --readme README.md --page $(PAGE)

bench-check: .venv/stamp-bench  ## measure the rasteriser again; fail where a ratio is over 15 % worse than recorded
	$(BIN)/python benchmarks/rasteriser.py --check

profile: .venv/stamp-dev  ## where the time of a whole run goes, stage by stage, into docs/performance.md
	$(BIN)/python benchmarks/stages.py --page $(PAGE)

web:  ## bundle the moving part of report.html anew, after a change in web/; needs Node.js
	cd web && npm ci && npm run build

# torch first, by itself and pinned: a looser wish of another package must not pick a different build.
.venv/stamp-torch: constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "hingesplat needs Python 3.11 or later")'
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --upgrade pip
	$(PIP_INSTALL) torch
	@touch $@

.venv/stamp-run: .venv/stamp-torch pyproject.toml
	$(PIP_INSTALL) -e .
	@touch $@

.venv/stamp-dev: .venv/stamp-torch pyproject.toml
	$(PIP_INSTALL) -e '.[dev,sim,usd,splats,view,video]'
	@touch $@ .venv/stamp-run

.venv/stamp-bench: .venv/stamp-dev
	$(PIP_INSTALL) -e '.[bench]'
	@touch $@

# The oldest MuJoCo that exports are promised to open in, beside the current one; without it its tests are skipped.
.venv/mujoco-3.3: .venv/stamp-dev
	$(BIN)/python -m pip install --no-deps --upgrade --target $@ mujoco==3.3.7 || echo "could not be installed: MuJoCo 3.3"
	@mkdir -p $@; touch $@
