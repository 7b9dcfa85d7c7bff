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
# A da Vinci-like arm with inexact encoders takes pins, needles and wires out of a foam bin and sorts them into two cups
# (Physical Experiment 2, SM 1.4). It sees masks of the objects, the shape of what it holds in them, a grasp candidate
# and what its encoders read. Do options learned from 60 demonstrations clear the bin, and what are they?
#
# This page draws one demonstration; all else shows what `studies/bin_picking*.py` measured, each by the command above
# its table.

# %%
from pathlib import Path

import matplotlib.pyplot as plt
from IPython.display import Image, Markdown, display

from ddco_pyro.simulation.episodes import run_episode
from ddco_pyro.simulation.task import find_task

FOLDER = "../docs/results/bin_picking"
pages = {path.stem: path.read_text().replace("](", f"]({FOLDER}/") for path in Path(FOLDER).glob("*.md")}
pictures = {path.stem: Image(str(path)) for path in Path(FOLDER).glob("*.png")}

# %% [markdown]
# ## A demonstration
#
# The first trial of a bin: approach, grasp, show what is held over the far end of the bin, carry it to its cup. Above,
# the scene; below, what the left eye's mask shows.

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
# How often the demonstrator's grasps took something, and what became of its bins:

# %%
Markdown(pages["supervisor"])

# %% [markdown]
# ## Policies
#
# The paper's four criteria, beside flat policies with the same branches and gradient steps.

# %%
Markdown(pages["summary"])

# %% [markdown]
# Recovery counts what is held when the jaws open, and so what slipped on the way to a cup, which the demonstrator, who
# does not look again, does not take back either. By what is held where it is shown, when it is decided where to go:

# %%
Markdown(pages.get("recovery", "Not measured yet."))

# %% [markdown]
# ## What the options are
#
# Which option is active in each step of a demonstrated trial, and which inputs move it.

# %%
display(Markdown(pages["options"].partition("![")[0]), pictures["options"])

# %% [markdown]
# ## How trials end
#
# The first trial of each ending, every picture framed in the colour of the active option.

# %%
display(Markdown(pages.get("films", "Not measured yet.").partition("![")[0]), *filter(None, [pictures.get("films")]))

# %% [markdown]
# ## What matters
#
# Other numbers of options, fewer demonstrations, coarser pictures, and the gripper's pose for the control, as a
# rotation vector and as a matrix. Of eight objects, the paper's robot took singly 7 with joint angles, 3 with tooltip
# poses and 2 with rotation matrices.

# %%
Markdown(pages.get("variants", "Not measured yet."))

# %% [markdown]
# With ten, twenty and forty demonstrations again, four and three training seeds:

# %%
Markdown(pages.get("fewer", "Not measured yet."))

# %% [markdown]
# ## Objects that no demonstration has shown
#
# Each alone in the bin, and the known ones for comparison.

# %%
Markdown(pages.get("unseen", "Not measured yet."))
