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
# # Planar pushing: how many options?
#
# Goals and held-out log-likelihood against the number of options (§5.1, figures Top-B and Top-C). The paper picks k by
# the likelihood; that works as far as the two curves agree.
#
# This page only shows what `python studies/pushing_studies.py number_of_options` measured; the command resumes, so
# it also adds seeds and settings that are still missing.

# %%
import csv
from pathlib import Path

import matplotlib.pyplot as plt
from IPython.display import Image, Markdown

RESULTS = Path("../docs/results/pushing")
with (RESULTS / "number_of_options.csv").open() as file:
    rows = list(csv.DictReader(file))
Markdown((RESULTS / "number_of_options.md").read_text())

# %%
Image(str(RESULTS / "number_of_options.png"))

# %% [markdown]
# Every fit on its own, instead of means: the seeds differ, in the demonstrations and in the training.

# %%
figure, axes = plt.subplots(figsize=(7, 3), layout="constrained")
for method in dict.fromkeys(row["method"] for row in rows):
    own = [row for row in rows if row["method"] == method]
    across, goals = ([float(row[key]) for row in own] for key in ("options", "goals"))
    axes.plot(across, goals, "o", alpha=0.6, label=method)
axes.set(xlabel="options k", ylabel="goals in 2000 steps")
axes.legend(fontsize=8)
plt.show()
