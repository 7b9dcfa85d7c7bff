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
# # Your own demonstrations
#
# Anything in robomimic's HDF5 layout can be fitted. Here: 50 demonstrations of Meta-World's scripted expert,
# which were recorded by somebody else. Their file is not part of this repository;
# `specs/metaworld_pick_place.yaml` says what it holds and how to record one, and `NOTEBOOK_METAWORLD=FILE` in
# the environment says where it is. Without it generated demonstrations of picking and placing take their
# place.

# %%
import os
import warnings
from pathlib import Path

from IPython.display import SVG, Markdown

warnings.filterwarnings("ignore", message="IProgress")  # progress needs no widgets here

from ddco_pyro import Demonstrations, load_spec
from ddco_pyro.cli.console import Progress
from ddco_pyro.data.planted import pick_and_place
from ddco_pyro.evaluation import verdicts
from ddco_pyro.fitting.fit import fit
from ddco_pyro.report import write_report

RUNS = Path(os.environ.get("NOTEBOOK_RUNS", "../runs/notebooks"))
RUNS.mkdir(parents=True, exist_ok=True)
SMALLER = os.environ.get("NOTEBOOK_SMALLER", "").split()  # a test makes the fits smaller

# %%
METAWORLD = Path(os.environ.get("NOTEBOOK_METAWORLD", "../../shared/data/metaworld_pick_place.hdf5"))
if METAWORLD.exists():
    path, observations = METAWORLD, ["hand_pos", "gripper", "object_pos", "goal_pos"]
else:
    path, observations = RUNS / "pick_and_place.hdf5", ["gripper", "jaw", "object", "goal"]
    pick_and_place(12).write(path)

# %% [markdown]
# What is in the file?

# %%
demos = Demonstrations.read(path, labels=["phase"])
print(len(demos), "demonstrations of", min(demos.lengths), "to", max(demos.lengths), "steps")
print("observations:", demos.observation_shapes)
print("control:", demos.control_size, "dimensions; labels:", list(demos[0].labels))

# %% [markdown]
# A spec for it. Observations that change quickly get their differences too.

# %%
SPEC = f"""
demonstrations: {{path: {path}, labels: phase}}
observations: [{", ".join(f"{{key: {key}, differences: true}}" for key in observations)}]
control: {{std: {{learn: true, floor: 0.01}}}}
hierarchy:
  levels:
    - {{count: 4, policy: {{network: linear}}, termination: {{network: linear}}}}
  meta_policy: {{network: linear}}
training: {{starts: [vq_controls], optimizer: {{lr: 1.0e-2}}, epochs: 400}}
compare_with: [flat]
report: {{trajectory: {observations[0]}}}
"""
(RUNS / "mine.yaml").write_text(SPEC)
spec = load_spec(RUNS / "mine.yaml", [one for one in SMALLER if not one.startswith("demonstrations.")])

# %%
with Progress() as progress:
    mine = fit(spec, None, RUNS / "mine", progress)
write_report(mine, demos)
Markdown(verdicts.verdict(mine.metrics))

# %% [markdown]
# The way of the hand, coloured by the most likely option; the report beside it has the options over time:

# %%
SVG(mine.folder / "figures" / "trajectories.svg")

# %%
agreement = mine.metrics.agreement
print("normalised mutual information with the expert's phases:",
      f"train {agreement.train[0].nmi:.2f} valid {agreement.valid[0].nmi:.2f}")  # fmt: skip

# %% [markdown]
# As a policy that acts, one observation at a time:

# %%
controller = mine.controller(seed=0)
controller.reset()
controller.act({key: demos[0].observations[key][0] for key in observations})
