# The environment is made once and remade when what it is made from changes.
#   make demo     fit the needle spec on this machine's CPU and write its report
#   make test     lint, then the tests that take seconds
#   make test-all lint, all tests, all notebooks, and the documentation site
#   make bench    what exact inference costs, beside other tools
#   make tools    LeRobot and other tools that tests of segments' formats read back with, where they can be installed
#   make release-check  build the sdist and the wheel, and use each in an environment of its own, without a clone
#   make docs     the documentation site, in build/site; the commands of its tutorial are run meanwhile
#   make .venv    the environment alone: what the demo needs
#   make dev      the environment with what tests and lint need besides
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
DEMO := .venv/.demo
DEV := .venv/.dev
# Python compiles what it imports, once; to do that beforehand for everything takes longer than all the rest.
PIP := $(BIN)/pip install -q --no-compile -c constraints.txt
# A torch wheel without the several GB of CUDA packages. Where this page cannot be reached pip takes torch from its usual index.
TORCH_CPU := https://download.pytorch.org/whl/cpu/torch/
# Measured with that wheel: on disk once it has been used, and to download.
SIZE := 1.9 GB (0.6 GB to download)

# Where images set it, each command would compile what it imports anew: 4 s more.
unexport PYTHONDONTWRITEBYTECODE

.NOTPARALLEL:
.PHONY: demo test test-all bench release-check tools docs lint format clean dev .venv python opengl

# --resume: an interrupted demo goes on where it stopped, a finished one shows its result again.
demo: opengl $(DEMO)
	$(BIN)/ddco-pyro fit specs/needle.yaml --out runs/needle --resume
	$(BIN)/ddco-pyro rollout runs/needle --episodes 50 --video --resume

test: lint
	$(BIN)/pytest -n 2 --dist worksteal -q

# 25 minutes on two cores: planted recoveries, many kills, more processes, every notebook, dynamax, and the site besides.
test-all: lint
	$(BIN)/pytest -n 2 --dist worksteal -q -m ''
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# Measured side by side with other tools; writes benchmarks/results and the tables of docs/performance.md. What is known of
# this very code is not measured again; one part alone: .venv/bin/python benchmarks/performance.py inference
# DEMONSTRATIONS=FILE: the file that `init` writes a spec for, instead of made-up demonstrations.
bench: $(DEMO)
	$(PIP) -e '.[bench]'
	$(BIN)/python benchmarks/performance.py
	$(BIN)/python -m studies render README.md docs/results/*.md

# What reads the formats of segments, in an environment of its own: LeRobot needs Python 3.12. About 8 GB with CUDA.
tools:
	test -x .venv-tools/bin/python || python3.12 -m venv .venv-tools
	.venv-tools/bin/pip install -q 'lerobot[dataset,evaluation]>=0.6' label-studio-sdk 'rerun-sdk>=0.41' pympi-ling \
		./lerobot_policy_ddco
	.venv-tools/bin/pip install -q --no-deps isaaclab 'mimicgen @ git+https://github.com/NVlabs/mimicgen'
	$(PIP) -e '.[rerun]'

# CHECK='--packages FOLDER': dependencies that are installed already, instead of those that pip finds.
release-check: $(DEV)
	$(PIP) build
	rm -rf dist
	$(BIN)/python -m build
	$(BIN)/python tests/release_check.py $(CHECK) dist/*

docs: $(DEMO)
	$(PIP) -e '.[docs,export]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

lint: $(DEV)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(DEV)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf .venv build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

.venv: $(DEMO)

dev: $(DEV)

python:
	@test -n "$(PYTHON)" && $(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "Python 3.11 or newer is needed; name it with: make PYTHON=/path/to/python3.11"; exit 1; }

# Before anything is installed: the camera of the needle task draws with OpenGL.
opengl: python
	@$(PYTHON) tasks/opengl.py

$(DEMO): pyproject.toml setup.py constraints.txt | python
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null \
		|| { echo "Python's venv module is missing; on Debian: sudo apt-get install python3-venv"; exit 1; }
	@echo "Installing into .venv: $(SIZE)"
	$(PYTHON) -m venv .venv
	$(BIN)/python -c 'import torch' 2>/dev/null \
		|| $(PIP) --retries 1 --timeout 20 --find-links $(TORCH_CPU) --no-deps torch
	$(PIP) -e .
	$(BIN)/python -c 'from ddco_pyro.inference import compile_all; compile_all()'
	@touch $@

$(DEV): $(DEMO)
	$(PIP) -e '.[dev]'
	@touch $@
