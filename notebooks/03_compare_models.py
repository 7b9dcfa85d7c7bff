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
# # Which model?
#
# One policy, one policy for each time step, two or five options, a meta-policy that may act itself, and
# options of options: fitted to the same demonstrations, compared on those that none of them has seen.

# %%
import os
import warnings
from pathlib import Path

from IPython.display import SVG, Image, Markdown

warnings.filterwarnings("ignore", message="IProgress")  # progress needs no widgets here

from ddco_pyro import load_spec
from ddco_pyro.cli.console import Progress
from ddco_pyro.comparison import compare, write
from ddco_pyro.fitting.fit import fit

RUNS = Path(os.environ.get("NOTEBOOK_RUNS", "../runs/notebooks"))
SMALLER = os.environ.get("NOTEBOOK_SMALLER", "").split()  # a test makes the fits smaller

# %%
with Progress() as watch:
    five = fit(load_spec("../specs/needle.yaml", SMALLER), None, RUNS / "needle", watch)
    two = fit(load_spec("../specs/needle.yaml", ["hierarchy.levels.0.count=2", "compare_with=[]", *SMALLER]),
              None, RUNS / "two-options", watch)  # fmt: skip
    alone = ["compare_with=[]", *SMALLER]
    hybrid = fit(load_spec("../specs/needle_hybrid.yaml", alone), None, RUNS / "hybrid", watch)
    deep = fit(load_spec("../specs/needle_3level.yaml", alone), None, RUNS / "3-levels", watch)

# %% [markdown] At the command line: `ddco-pyro compare runs/needle runs/needle/baselines/flat ...`. The
# columns are those of arviz's `compare`, with trajectories for observations; `dse` is the error of a *paired*
# difference.

# %%
runs = [five, *five.baselines.values(), two, hybrid, deep]
found = compare([run.folder for run in runs])
write(found, RUNS / "comparison")
Markdown((RUNS / "comparison" / "compare.md").read_text())

# %%
SVG(RUNS / "comparison" / "compare.svg")

# %% [markdown]
# ## Against the number of demonstrations
#
# The figure A of the paper's needle experiment (SM 1.3), and dropout (SM 2.5), by cross-validation:

# %%
Image("../docs/results/selection_learning_curve.png")
