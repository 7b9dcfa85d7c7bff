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
# # Surgical bin picking
#
# A da Vinci-like arm with inexact encoders takes pins, needles and wires out of a foam bin and sorts them
# into two cups (Physical Experiment 2, SM 1.4). It sees masks of the objects, the shape of what it holds in
# them, a grasp candidate and what its encoders read. Do options learned from 60 demonstrations clear the bin,
# and what are they?
#
# This page draws one demonstration; all else is what `studies/bin_picking.py` of commit a6c01719 measured.

# %%
from pathlib import Path

import matplotlib.pyplot as plt
from IPython.display import Image, Markdown

from ddco_pyro.simulation.episodes import run_episode
from ddco_pyro.simulation.task import find_task

RESULTS = Path("../docs/results")

# %% [markdown]
# ## A demonstration
#
# The first trial of a bin: approach, grasp, show what is held over the far end of the bin, carry it to its
# cup. Above, the scene; below, what the left eye's mask shows.

# %%
PHASES = ("approach", "grasp", "show", "recover", "carry", "release")
demonstration = run_episode(find_task("bin_picking"), "supervisor", seed=2, film=True)
steps, record = range(0, 10), demonstration.record
figure, axes = plt.subplots(2, len(steps), figsize=(16, 3.4), layout="constrained")
for step, (above, below) in zip(steps, axes.T, strict=True):
    above.imshow(demonstration.frames[step][40:280, 60:420])
    above.set_title(f"{step}: {PHASES[record.labels['phase'][step]]}", fontsize=9)
    below.imshow(record.observations["image"][step][..., 0], cmap="gray")
    above.axis("off")
    below.axis("off")
plt.show()

# %% [markdown]
# ## Policies
#
# The paper's four criteria beside flat policies with the same branches and gradient steps, and what else was
# measured.

# %%
Markdown((RESULTS / "bin_picking.md").read_text().replace("](", "](../docs/results/"))

# %% [markdown]
# ## What the options are
#
# Which option is active in each step of a demonstrated trial, and which inputs move it.

# %%
Image(str(RESULTS / "bin_picking_options.png"))

# %% [markdown]
# ## How trials end
#
# The first trial of each ending, every picture framed in the colour of the active option.

# %%
Image(str(RESULTS / "bin_picking_films.png"))
