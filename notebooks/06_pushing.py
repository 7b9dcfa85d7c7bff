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
# # Planar pushing
#
# A 3-link arm pushes a box to goals on its left and right (§5.1). How many demonstrations of one goal each
# does a policy need, with and without options, and how many options? Every method has the same observations,
# gradient steps and sweep. This page shows what `studies/pushing.py` of commit a6c01719 measured.

# %%
import csv
from pathlib import Path

import matplotlib.pyplot as plt
from IPython.display import Image, Markdown

RESULTS = Path("../docs/results")
Markdown((RESULTS / "pushing.md").read_text().replace("](", "](../docs/results/"))

# %% [markdown]
# Every fit on its own, instead of means: the seeds differ, in the demonstrations and in the training.

# %%
with (RESULTS / "pushing.csv").open() as file:
    rows = [row for row in csv.DictReader(file) if row["measure"] == "goals"]
figure, axes = plt.subplots(figsize=(7, 3), layout="constrained")
for method in dict.fromkeys(row["method"] for row in rows if row["study"] == "sample_complexity"):
    own = [row for row in rows if (row["study"], row["method"]) == ("sample_complexity", method)]
    across, goals = ([float(row[key]) for row in own] for key in ("demonstrations", "value"))
    axes.plot(across, goals, "o", alpha=0.6, label=method)
axes.set(xlabel="demonstrations", ylabel="goals in 2000 steps")
axes.legend(fontsize=8)
plt.show()

# %% [markdown]
# The number of options (figures Top-B and Top-C), five seeds each:

# %%
Image(str(RESULTS / "pushing_options.png"))
