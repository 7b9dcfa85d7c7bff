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
# # Which options are in the needle demonstrations?
#
# A simulated surgical arm picks up a needle and pushes it into a phantom, 15 steps each time. Five options
# under a meta-policy are fitted to 100 demonstrations; nobody says where one skill ends and the next begins.

# %%
import os
import warnings
from pathlib import Path

from IPython.display import SVG, Markdown

warnings.filterwarnings("ignore", message="IProgress")  # progress needs no widgets here

from ddco_pyro import load_spec
from ddco_pyro.cli.console import Progress
from ddco_pyro.evaluation import verdicts
from ddco_pyro.fitting.fit import fit
from ddco_pyro.report import write_report
from ddco_pyro.report.options import use_table
from ddco_pyro.training.data import demonstrations

RUNS = Path(os.environ.get("NOTEBOOK_RUNS", "../runs/notebooks"))
SMALLER = os.environ.get("NOTEBOOK_SMALLER", "").split()  # a test makes the fits smaller

# %% [markdown]
# A fit that is in its folder already is read back, not done again. The same at the command line:
# `ddco-pyro fit specs/needle.yaml --out runs/needle --resume`.

# %%
spec = load_spec("../specs/needle.yaml", SMALLER)
with Progress() as progress:
    needle = fit(spec, None, RUNS / "needle", progress)
demos = demonstrations(spec)
write_report(needle, demos)
figures = needle.folder / "figures"

# %% [markdown]
# ## When is which option active?
#
# Each colour is an option of the most likely path, along the way of the gripper:

# %%
SVG(figures / "trajectories.svg")

# %% [markdown]
# ## How are they used?

# %%
Markdown(use_table(needle).markdown())

# %% [markdown]
# ## Does the hierarchy explain what it has not seen?

# %%
Markdown(verdicts.verdict(needle.metrics))

# %%
SVG(figures / "likelihood.svg")
