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
# # Pushing from pictures
#
# An arm of three joints pushes a box to one goal after another, and sees nothing but the pictures of a camera
# (§5.1, SM 1.2). Can policies be learned that read box, arm and goal from them, and do options help?
#
# This page draws a demonstration; all else is what `studies/pushing_pictures.py` of commit a6c01719 measured.

# %%
from pathlib import Path

import matplotlib.pyplot as plt
from IPython.display import Image, Markdown

from ddco_pyro.data.pictures import Transform
from ddco_pyro.simulation.episodes import run_episode
from ddco_pyro.simulation.task import find_task

RESULTS = Path("../docs/results")

# %% [markdown]
# ## What is seen
#
# Above, the camera's picture of 640 × 480; below, what the networks see of it, 64 × 48. The goal is the pale
# outline; when the box has reached it a demonstration ends. The demonstrator sees the state, and its hand
# trembles.

# %%
demonstration = run_episode(find_task("pushing_goal"), "scripted_noisy_0.3", seed=0, observed=["camera"])
pictures = demonstration.record.observations["camera"]
steps = range(0, len(pictures), max(1, len(pictures) // 6))
figure, axes = plt.subplots(2, len(steps), figsize=(16, 4.4), layout="constrained")
for step, (above, below) in zip(steps, axes.T, strict=True):
    above.imshow(pictures[step])
    above.set_title(f"step {step}", fontsize=9)
    below.imshow(Transform(resize=(48, 64))(pictures[step : step + 1])[0])
    above.axis("off")
    below.axis("off")
plt.show()

# %% [markdown]
# ## What policies reach
#
# Goals in 2000 steps, from the same initial states for all, beside full-size pictures, numbers of options, a
# meta-policy that may act itself, and options over what a flat policy sees.

# %%
Markdown((RESULTS / "pushing_pictures.md").read_text().replace("](", "](../docs/results/"))

# %%
Image(str(RESULTS / "pushing_pictures.png"))

# %% [markdown]
# ## What a policy looks at
#
# How much the control of the active option changes with each pixel, in the first episode of the evaluation.

# %%
Image(str(RESULTS / "pushing_pictures_looks.png"))
