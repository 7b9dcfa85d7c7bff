# The environment is made once and remade when what it is made from changes.
#   make demo     fit the needle spec on this machine's CPU and write its report
#   make test     lint, then the tests
#   make bench    what exact inference costs, beside other tools
#   make docs     the documentation site, in build/site; the commands of its tutorial are run meanwhile
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
STAMP := .venv/.installed
# A torch wheel without the several GB of CUDA packages. Where this page cannot be reached pip takes torch from its usual index.
TORCH_CPU := https://download.pytorch.org/whl/cpu/torch/

.PHONY: demo test bench docs lint format clean .venv

# --resume: an interrupted demo goes on where it stopped, a finished one shows its result again.
demo: $(STAMP)
	$(BIN)/ddco-pyro fit specs/needle.yaml --out runs/needle --resume
	$(BIN)/ddco-pyro rollout runs/needle --episodes 50 --video

test: lint
	$(BIN)/pytest -n 2 -q

# Ratios against other tools, measured side by side; writes benchmarks/latest.json and docs/performance.md.
bench: $(STAMP)
	$(BIN)/pip install -q -c constraints.txt -e '.[bench]'
	$(BIN)/python benchmarks/performance.py

docs: $(STAMP)
	$(BIN)/pip install -q -c constraints.txt -e '.[docs,export]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf .venv build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

.venv: $(STAMP)

$(STAMP): pyproject.toml setup.py constraints.txt
	@test -n "$(PYTHON)" && $(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "Python 3.11 or newer is needed; name it with: make PYTHON=/path/to/python3.11"; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null \
		|| { echo "Python's venv module is missing; on Debian: sudo apt-get install python3-venv"; exit 1; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -c 'import torch' 2>/dev/null \
		|| $(BIN)/pip install -q --retries 1 --timeout 20 -c constraints.txt --find-links $(TORCH_CPU) --no-deps torch
	$(BIN)/pip install -q -c constraints.txt -e '.[dev]'
	@touch $(STAMP)
