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
# # Planar pushing: how many demonstrations?
#
# A 3-link arm pushes a box to goals on its left and right. How many demonstrations of one goal each does a policy
# need, with and without options (§5.1, figure Top-A)? Every method has the same observations, gradient steps and sweep.
#
# This page only shows what `python studies/pushing_studies.py sample_complexity` measured; the command resumes, so
# it also adds seeds and settings that are still missing.

# %%
import csv
from pathlib import Path

import matplotlib.pyplot as plt
from IPython.display import Image, Markdown

RESULTS = Path("../docs/results/pushing")
with (RESULTS / "sample_complexity.csv").open() as file:
    rows = list(csv.DictReader(file))
Markdown((RESULTS / "sample_complexity.md").read_text())

# %%
Image(str(RESULTS / "sample_complexity.png"))

# %% [markdown]
# Every fit on its own, instead of means: the seeds differ, in the demonstrations and in the training.

# %%
figure, axes = plt.subplots(figsize=(7, 3), layout="constrained")
for method in dict.fromkeys(row["method"] for row in rows):
    own = [row for row in rows if row["method"] == method]
    across, goals = ([float(row[key]) for row in own] for key in ("demonstrations", "goals"))
    axes.plot(across, goals, "o", alpha=0.6, label=method)
axes.set(xlabel="demonstrations", ylabel="goals in 2000 steps")
axes.legend(fontsize=8)
plt.show()

# %% [markdown]
# What else matters? One thing changed at a time, for every method alike
# (`python studies/pushing_studies.py variants`).

# %%
Image(str(RESULTS / "variants.png"))
