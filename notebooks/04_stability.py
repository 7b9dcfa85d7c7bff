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
# # Do other seeds find the same options?
#
# The paper (SM 2.4) fits the same demonstrations from ten initialisations, each in four ways: parameters drawn at
# random or from clusters of the observations (VQ), all levels at once or from the lowest up (layer-wise). Here is the
# same for the needle task, for demonstrations of Meta-World's expert and for planar pushing, with the numbers behind
# the picture.

# %%
from pathlib import Path

from IPython.display import Image, Markdown

RESULTS = Path("../docs/results")

# %%
Image(RESULTS / "stability.png")

# %% [markdown]
# Left: a dot is a seed, the bar their mean; the closer the dots, the more stable. Middle: a dot is a pair of seeds,
# and 1 means that both divide every demonstration alike. Right: near 1 the meta-policy leaves control to its options.

# %%
Markdown((RESULTS / "stability.md").read_text())

# %% [markdown]
# What the paper found, a variance halved by VQ and layer-wise training and segments that agree more, is seen on
# pushing. On the needle and Meta-World segments agree more too, the variances are no smaller; see the p-values for how
# well a ratio of two variances of ten seeds is known. On the needle a meta-policy that is trained jointly from random
# parameters keeps more of the control to itself than any other: the beginning of what the paper calls high-fitting.
# None of the fits is degenerate.
