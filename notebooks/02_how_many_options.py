# ---
# jupyter:
#   jupytext:
#     cell_metadata_filter: -all
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#       format_version: '1.3'
#       jupytext_version: 1.19.6
# ---

# %% [markdown]
# # How many options?
#
# Cross-validation answers it without a robot. Ten folds and the paper's perceptrons are the default; five
# folds and linear networks keep this page quick. Every number of options sees the same folds, so candidates
# are compared by their *paired* differences.

# %%
import os
import warnings
from pathlib import Path

from IPython.display import SVG, Markdown

warnings.filterwarnings("ignore", message="IProgress")  # progress needs no widgets here

from ddco_pyro import load_spec
from ddco_pyro.cli.console import Progress
from ddco_pyro.selection import Workers, select

RUNS = Path(os.environ.get("NOTEBOOK_RUNS", "../runs/notebooks"))
SMALLER = os.environ.get("NOTEBOOK_SMALLER", "").split()  # a test makes the fits smaller

# %% [markdown]
# Anything in the spec can be a grid. At the command line:
# `ddco-pyro select specs/needle.yaml --set selection.grid.hierarchy.levels.0.count=[1,2,3,5,8] --folds 5`.

# %%
PLACES = ("levels.0.policy", "levels.0.termination", "meta_policy")
LINEAR = [f"hierarchy.{place}.network=linear" for place in PLACES]
GRID = ["selection.folds=5", "selection.grid.hierarchy.levels.0.count=[1, 2, 3, 5, 8]", "training.epochs=600"]
spec = load_spec("../specs/needle.yaml", [*LINEAR, *GRID, "compare_with=[]", *SMALLER])

# %%
with Progress() as progress:
    found = select(spec, RUNS / "how-many", progress, Workers(1))

# %%
SVG(found.folder / "figures" / "selection.svg")

# %% [markdown] Where the best is the largest that was tried, the grid is too small to say how many are
# enough: try more. On the needle task every step has its own way point, so with linear options more of them
# keep helping.

# %%
Markdown((found.folder / "selection.md").read_text())

# %% [markdown]
# ## Does the rule find what was planted?
#
# On demonstrations that were drawn from k skills, how often does the one-standard-error rule choose k?

# %%
Markdown(Path("../docs/results/selection.md").read_text().replace("](", "](../docs/results/"))
