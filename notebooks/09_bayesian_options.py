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
# # Bayesian options
#
# The model of this project, an abstract hidden Markov model (AHMM), is a Pyro program. This notebook uses the
# program as a Pyro user would. It compares the compiled inference with Pyro's, puts priors on the weights of
# linear options, samples their posterior, and checks the result.

# %%
import os
import warnings
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from shutil import which

warnings.filterwarnings("ignore", message="IProgress")  # progress needs no widgets here

import matplotlib.pyplot as plt
import networkx as nx
import numpy as np
import pyro
import pyro.distributions as dist
import torch
import yaml
from IPython.display import display
from pyro.infer import MCMC, NUTS, SVI, Predictive, Trace_ELBO, TraceEnum_ELBO, infer_discrete
from pyro.infer.autoguide import AutoLowRankMultivariateNormal, AutoNormal, init_to_value
from pyro.infer.inspect import get_model_relations
from pyro.ops.stats import effective_sample_size
from scipy.stats import chisquare
from torch.func import functional_call

from ddco_pyro import Demonstration, Demonstrations, EliminatedAHMM, fit
from ddco_pyro.fitting.draws import matched
from ddco_pyro.inference import log_likelihood, most_likely_path, posterior, sample_paths
from ddco_pyro.inference.engines import known_controls
from ddco_pyro.inference.marginal import bayesian_ahmm
from ddco_pyro.model.ahmm import Acting, ahmm, choose
from ddco_pyro.model.batch import encode
from ddco_pyro.model.emissions import Gaussian
from ddco_pyro.model.outputs import CallerOutputs, Outputs
from ddco_pyro.model.tables import complete
from ddco_pyro.spec import parse_spec

torch.set_num_threads(1)
plt.rcParams["figure.dpi"] = 80
pyro.enable_validation(False)  # saves time with so small a model
RUNS = Path(os.environ.get("NOTEBOOK_RUNS", "../runs/notebooks"))

# %% [markdown]
# ## Demonstrations
#
# A point on a line has two skills: move towards +1, and move towards −1. A skill ends at each step with
# probability 0.15; then either skill follows. There are 12 demonstrations of 24 steps. The control is the
# velocity.

# %%
random, N, T, SIGMA = np.random.default_rng(0), 12, 24, 0.2
place, velocity, skill = np.zeros((N, T, 1)), np.zeros((N, T, 1)), np.zeros((N, T), dtype=int)
here, active = random.uniform(-1, 1, N), random.integers(1, 3, N)
for t in range(T):
    active = np.where(random.random(N) < 0.15 * (t > 0), random.integers(1, 3, N), active)
    step = 0.4 * (np.where(active == 1, 1.0, -1.0) - here) + SIGMA * random.normal(size=N)
    place[:, t, 0], velocity[:, t, 0], skill[:, t] = here, step, active
    here = here + step
demos = Demonstrations(
    tuple(Demonstration(f"demo_{n}", {"place": place[n]}, velocity[n], {"skill": skill[n]}) for n in range(N))
)

# %% [markdown] The first fit is a point estimate by expectation-maximisation (EM). It has three linear
# options, one more than there are skills. Its σ is in units of the controls' standard deviation.

# %%
STD = SIGMA / velocity.std()
SPEC = f"""
demonstrations: {{path: made_here.hdf5}}
observations: [place]
control: {{std: {STD}}}
hierarchy:
  levels: [{{count: 3, policy: {{network: linear}}, termination: {{network: linear}}}}]
  meta_policy: {{network: linear}}
training: {{optimizer: {{name: em}}, starts: [vq, vq, vq], tune_fraction: 0}}
inference: fused   # or enumerate, Pyro's own: the same numbers, slower
compare_with: []
"""
spec = parse_spec(yaml.safe_load(SPEC))
mine = fit(spec, demos, RUNS / "shuttle")
hierarchy = mine.hierarchy
batch = encode(demos, hierarchy.encoder, hierarchy.scaling)
with torch.no_grad():
    outputs = hierarchy(batch.inputs)
tables = outputs.tables(batch.actions)
fitted = posterior(tables, batch.lengths).u[0]
print("share of the steps by option:", fitted[..., 1:].mean((0, 1)).numpy().round(3))

# %% [markdown]
# ## The AHMM is a Pyro program
#
# `ahmm` samples terminations `b_1_t`, options `h_1_t` and controls `a_t` in a plate over demonstrations. Pyro
# itself finds which site depends on which. The picture has the first four steps; observed sites are filled.
# Graphviz draws it with `pyro.render_model`; where Graphviz is missing, networkx draws the same relations.

# %%
program = (complete(tables, batch.lengths), outputs.emissions, batch.actions)
first = tables.part(torch.tensor([0]), 4)
short = (complete(first, torch.tensor([4])), *known_controls(first))
if which("dot") and find_spec("graphviz"):
    display(pyro.render_model(ahmm, model_args=short))
else:
    relations = get_model_relations(ahmm, short)
    causes = relations["sample_sample"].items()
    graph = nx.DiGraph([(cause, site) for site, own in causes for cause in own])
    figure, axes = plt.subplots(figsize=(8, 3), layout="constrained")
    nx.draw_networkx(
        graph,
        {site: (int(site.split("_")[-1]), "ahb".index(site[0])) for site in graph},
        node_color=["lightgray" if site in relations["observed"] else "white" for site in graph],
        edgecolors="black", node_size=1500, font_size=9, ax=axes,
    )  # fmt: skip
    axes.margins(0.1, 0.25)
    axes.axis("off")
    plt.show()

# %% [markdown] `EliminatedAHMM` is the same program with options and terminations summed out, as one
# distribution. Its `log_prob`, the compiled kernel and `TraceEnum_ELBO` on the program give the same number.

# %%
eliminated = EliminatedAHMM(outputs, batch.lengths)
enumerating = TraceEnum_ELBO(max_plate_nesting=1, strict_enumeration_warning=False)
print(f"EliminatedAHMM {eliminated.log_prob(batch.actions).sum():.6f} nats")
print(f"kernel         {log_likelihood(tables, batch.lengths).sum():.6f}")
print(f"TraceEnum_ELBO {-enumerating.loss(ahmm, pyro.poutine.block(ahmm), *program):.6f}")

# %% [markdown] `infer_discrete` at temperature 0 gives the most likely path: that of the kernel's Viterbi
# pass. At temperature 1 it draws paths; over 2000 draws for one demonstration the options are as frequent as
# the kernel's marginals say.

# %%
pyro.set_rng_seed(0)
decoded = pyro.poutine.trace(infer_discrete(ahmm, first_available_dim=-2, temperature=0)).get_trace(*program)
theirs = torch.stack([decoded.nodes[f"h_1_{t}"]["value"] for t in range(T)], 1)
ours = most_likely_path(tables, batch.lengths).choices[0]
print(f"equal steps of the most likely paths: {int((theirs == ours).sum())} of {N * T}")

SHOWN, DRAWS = 3, 2000
copies = batch.select(torch.full((DRAWS,), SHOWN))
with torch.no_grad():
    repeated = hierarchy(copies.inputs)
copied = (complete(repeated.tables(copies.actions), copies.lengths), repeated.emissions, copies.actions)
sampled = pyro.poutine.trace(infer_discrete(ahmm, first_available_dim=-2, temperature=1)).get_trace(*copied)
paths = torch.stack([sampled.nodes[f"h_1_{t}"]["value"] for t in range(T)], 1)
frequency = torch.nn.functional.one_hot(paths, 4).double().mean(0)
error = (fitted[SHOWN] * (1 - fitted[SHOWN]) / DRAWS).sqrt()
print(f"largest difference of a frequency and a marginal: {(frequency - fitted[SHOWN]).abs().max():.4f}")
print(f"largest standard error of a frequency:            {error.max():.4f}")

figure, axes = plt.subplots(figsize=(9, 2.6), layout="constrained")
for option in (1, 2, 3):
    (line,) = axes.plot(fitted[SHOWN, :, option], label=f"option {option}: marginal")
    axes.plot(frequency[:, option], "o", color=line.get_color(), label="infer_discrete")
axes.set(xlabel="step", ylabel="probability", title=f"demonstration {SHOWN}")
axes.legend(fontsize=8, ncols=3)
plt.show()

# %% [markdown]
# ## Priors on the weights
#
# The weights of linear options get normal priors. Their standard deviations are those that EM's ridges stand
# for: a ridge ρ is the precision of a normal prior, in units of 1/σ² for the policies. So a fit by EM is a
# mode of the posterior density (MAP). One thing differs: EM leaves biases without a prior; here their prior
# is N(0, 1), so that the posterior of an unused option is proper.

# %%
ridge = spec.training.optimizer.ridge
spreads = {
    "levels.0.policy.network.layers.0.weight": STD * ridge.policy**-0.5,
    "levels.0.termination.layers.0.weight": ridge.gate**-0.5,
    "meta_policy.network.layers.0.weight": ridge.gate**-0.5,
}
priors = {
    name: dist.Normal(0.0, spreads.get(name, 1.0)).expand(weight.shape).to_event()
    for name, weight in hierarchy.named_parameters()
}
site = {name: name.replace(".", "_") for name in priors}
start = {site[name]: weight.detach().clone() for name, weight in hierarchy.named_parameters()}
bayesian = partial(bayesian_ahmm, hierarchy, priors)

# %% [markdown] EM stops where a step gains less than 1e-5 nats for each step of the demonstrations. From
# there, gradient ascent of the log-likelihood plus the log-density of the prior on weights gains less than a
# nat, and moves weights by less than their posterior standard deviations below.

# %%
weights = {name: weight.detach().clone().requires_grad_() for name, weight in hierarchy.named_parameters()}
ascent, values = torch.optim.Adam(weights.values(), lr=1e-3), []
for _ in range(400):
    likelihood = EliminatedAHMM(functional_call(hierarchy, weights, (batch.inputs,)), batch.lengths)
    prior = [priors[name].log_prob(weight) for name, weight in weights.items() if not name.endswith("bias")]
    value = likelihood.log_prob(batch.actions).sum() + torch.stack(prior).sum()
    values.append(value.item())
    ascent.zero_grad()
    (-value).backward()
    ascent.step()
moved = {name: (weight - start[site[name]]).abs().max().item() for name, weight in weights.items()}
print(f"gain {values[-1] - values[0]:.3f} nats of {values[-1]:.1f}")
print("largest change of a weight:", {name.replace(".network", "").replace(".layers.0", ""): round(change, 3)
                                      for name, change in moved.items()})  # fmt: skip

# %% [markdown] Three approximations of the posterior begin at EM's fit: independent normals (`AutoNormal`), a
# normal with a low-rank covariance, and NUTS. Options can be exchanged, and the posterior has a mode for each
# numbering; a start at EM's fit chooses one of them.

# %%
samples = {}
for guided in (AutoNormal, AutoLowRankMultivariateNormal):
    pyro.clear_param_store()
    pyro.set_rng_seed(0)
    guide = guided(bayesian, init_loc_fn=init_to_value(values=start), init_scale=0.05)
    svi = SVI(bayesian, guide, pyro.optim.ClippedAdam({"lr": 0.05, "lrd": 0.995}), Trace_ELBO())
    losses = [svi.step(batch) for _ in range(600)]
    print(f"{guided.__name__}: ELBO {-np.mean(losses[-200:]):.1f} nats")
    with torch.no_grad():
        predictive = Predictive(bayesian, guide=guide, num_samples=300, return_sites=[*start])
        samples[guided.__name__] = predictive(batch)

# %%
pyro.set_rng_seed(0)
kernel = NUTS(bayesian, init_strategy=init_to_value(values=start), full_mass=True, max_tree_depth=5)
chain = MCMC(kernel, num_samples=300, warmup_steps=150, disable_progbar=True)
chain.run(batch)
kept = chain.get_samples()
print("divergences:", len(chain.diagnostics()["divergences"]["chain 0"]), "in", chain.num_samples, "draws")

# %% [markdown] A chain can still switch labels. Each draw gives the posterior of the options at every step;
# its options get the numbers of the EM options that act at the same steps, one to one. The draw of a path,
# p(ζ | ξ, w), is for later.

# %%
paths, orders = [], []
for number in range(chain.num_samples):
    with torch.no_grad():
        own = pyro.condition(bayesian, {name: value[number] for name, value in kept.items()})(batch)
    scored = own.tables(batch.actions)
    (order,) = matched([fitted.flatten(0, 1)], [posterior(scored, batch.lengths).u[0].flatten(0, 1)], [4])
    paths.append(order[sample_paths(scored, batch.lengths, 1, number).choices[0][0].numpy()])
    orders.append(torch.from_numpy(order[1:] - 1))
paths, orders = np.stack(paths), torch.stack(orders)
samples["NUTS"] = {
    name: torch.empty(value.shape[0], 3, dtype=value.dtype).scatter(1, orders, value.flatten(1))
    for name, value in kept.items()
}
sizes = torch.cat([effective_sample_size(value[None]) for value in samples["NUTS"].values()])
print("draws with another numbering than EM's:", int((orders != torch.arange(3)).any(1).sum()))
print(f"effective draws of a weight: {sizes.min():.0f} to {sizes.max():.0f}")

# %%
figure, axes = plt.subplots(figsize=(11, 3.8), layout="constrained")
axes.plot(torch.cat([start[name].flatten() for name in start]), "k_", markersize=16, label="EM")
for place_of, (name, drawn) in enumerate(samples.items()):
    every = torch.cat([drawn[own].flatten(1).double() for own in start], 1)
    low, middle, high = every.quantile(torch.tensor([0.05, 0.5, 0.95]).double(), dim=0)
    at = np.arange(every.shape[1]) + 0.2 * (place_of - 1)
    axes.errorbar(at, middle, (middle - low, high - middle), fmt="o", markersize=4, label=name)
parts = [f"{symbol} {kind}" for symbol in "πψη" for kind in ("weight", "bias")]
labels = [f"{part} {option}" for part in parts for option in (1, 2, 3)]
axes.set_xticks(range(18), labels, rotation=60)
axes.set_title("weights and biases by option: median and 90 % interval")
axes.legend()
plt.show()

# %% [markdown] The policies of options 2 and 3 are known well, and the three approximations agree on them.
# Terminations and the meta-policy are known less well: a demonstration has few switches. `AutoNormal` knows
# no correlations, and most of its intervals for ψ and η of options 2 and 3 are narrower than those of NUTS.
# Where the chain has few effective draws, its intervals are rough.
#
# ## How many options are used?
#
# One path was drawn with each draw of weights. The options on it are the used ones.

# %%
shares = (paths[..., None] == [1, 2, 3]).mean((1, 2))
for least in (0.0, 0.02, 0.05, 0.1):
    three = torch.from_numpy((shares > least).all(1)).double()
    error = 0.0 if three.std() == 0 else three.std() / effective_sample_size(three[None]) ** 0.5
    said = f"P = {three.mean():.2f}, standard error {error:.2f}"
    print(f"three options with more than {least:3.0%} of the steps: {said}")

# %% [markdown] There are two skills. Nothing in these priors prefers few options, and many draws give a few
# steps to a third one. It seldom has a tenth of the steps. The chain moves slowly between weights with much
# and with little use of it: the standard errors say how well their shares are known.
#
# ## Predictive checks
#
# The parts of the program, `choose` and `Acting`, also act: each draw of weights controls the point for 12
# new demonstrations from the recorded first places. Two statistics are compared. The correlation of
# successive controls has a measured value. The duration of segments is latent: new paths are compared, draw
# by draw, with paths given the recorded controls. The same weights with options that end after every step are
# a model that has to fail.

# %%
pyro.set_rng_seed(1)
rows = [samples["NUTS"][site[name]].float().repeat_interleave(N, 0) for name in priors]
(policy, policy_bias, termination, termination_bias, meta, meta_bias), D = rows, len(paths)
lengths = {"given the controls": N * T / (N + (np.diff(paths) != 0).sum((1, 2)))}
correlations = {}
for name in ("drawn anew", "drawn anew, memoryless"):
    here, options, chosen, acted = np.tile(place[:, 0], (D, 1)), None, [], []
    for t in range(T):
        x = torch.from_numpy(hierarchy.encoder.scaled(here)).float()
        normal = Gaussian((policy * x + policy_bias)[:, None, :, None], torch.tensor([STD]), torch.zeros(1))
        selection = (meta * x + meta_bias)[:, None, None]
        callers = (CallerOutputs(0, None, normal), CallerOutputs(3, selection, None))
        ending = (termination * x + termination_bias)[:, None] if name == "drawn anew" else None
        now = complete(Outputs(callers, (ending,)).tables(), torch.ones(D * N, dtype=torch.long)).steps()[0]
        options = choose(t, now, options)
        control = hierarchy.scaling.emitted(Acting((normal.steps()[0], None), options).sample()).numpy()
        here = here + control
        chosen.append(options[0])
        acted.append(control[:, 0])
    switches = np.diff(np.stack(chosen, 1).reshape(D, N, T)) != 0
    lengths[name] = N * T / (N + switches.sum((1, 2)))
    acted = np.stack(acted, 1).reshape(D, N, T)
    correlations[name] = np.array([np.corrcoef(a[:, 1:].ravel(), a[:, :-1].ravel())[0, 1] for a in acted])

# %%
measured = np.corrcoef(velocity[:, 1:, 0].ravel(), velocity[:, :-1, 0].ravel())[0, 1]
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.2), layout="constrained")
left.hist(lengths.values(), bins=30, histtype="step", label=[*lengths])
left.axvline(N * T / (N + (np.diff(skill) != 0).sum()), color="black", label="truth")
left.set(xlabel="mean steps of a segment", ylabel="draws")
right.hist(correlations.values(), bins=30, histtype="step", color=["C1", "C2"], label=[*correlations])
right.axvline(measured, color="black", label="measured")
right.set(xlabel="correlation of successive controls")
left.legend(fontsize=8)
right.legend(fontsize=8)
plt.show()
for name, values in correlations.items():
    longer = (lengths[name] > lengths["given the controls"]).mean()
    print(f"{name:23} P(longer than given the controls) = {longer:.2f}, "
          f"P(correlation above the measured) = {(values > measured).mean():.2f}")  # fmt: skip

# %% [markdown] Options that last pass both checks, and memoryless ones fail both. Segments given the controls
# are shorter than the true ones, because the third option divides some of them.
#
# ## Boundaries have intervals
#
# `fit.draws` draws whole paths at EM's weights. `draws.boundaries` has, for each boundary of the most likely
# path, the share of draws that have it and an interval of 90 %. `draws.to_datatree()` gives the draws to
# xarray and ArviZ.

# %%
draws = mine.draws(demos, draws=500)
(level,) = draws.options
figure, axes = plt.subplots(figsize=(9, 3), layout="constrained")
for n in range(5):
    axes.imshow(skill[n][None], extent=(-0.5, T - 0.5, n - 0.35, n + 0.35), cmap="Pastel1", aspect="auto")
    for boundary in draws.boundaries(level, n, ours[n].numpy()):
        axes.plot([boundary.low - 0.6, boundary.high - 0.4], [n, n], color="black", linewidth=1)
        axes.plot(boundary.step - 0.5, n, "k|", markersize=18 * boundary.probability)
axes.set(xlabel="step", ylabel="demonstration", title="skills (colour), boundaries and their intervals")
axes.set_ylim(-0.6, 4.6)
plt.show()

# %% [markdown]
# ## Simulation-based calibration
#
# Weights are drawn from the prior, controls from the model with these weights. The rank of the weights among
# draws from their posterior is then uniform, if and only if prior, model and posterior fit together. One
# posterior for each of 400 replications would take NUTS hours, so the prior here is uniform over 150
# candidates drawn from normals. The first candidate generates the controls. The posterior over candidates is
# exact: the softmax of `log_prob`.
#
# `EliminatedAHMM` takes the outputs of any networks. Here they are written by hand: two linear options for
# each replication and candidate, with constant terminations and meta-policy.

# %%
pyro.set_rng_seed(3)
R, M, STEPS = 400, 150, 15
# slopes, biases, ψ and η: options cannot be exchanged
center = torch.tensor([0.0, 0.0, 1.0, -1.0, -1.0, -1.0, 0.0])
candidates = center + 0.6 * torch.randn(R, M, 7)
slope, bias, ending, first = candidates.reshape(R * M, 1, 7).split([2, 2, 2, 1], dim=-1)
states = torch.randn(R, 1, STEPS, 1).expand(R, M, STEPS, 1).reshape(R * M, STEPS, 1)
lengths = torch.full((R * M,), STEPS)
gaussian = Gaussian((slope * states + bias).unsqueeze(-1), torch.tensor([0.5]), torch.zeros(1))
options = CallerOutputs(0, None, gaussian)
choice = CallerOutputs(2, torch.cat([first, -first], -1).unsqueeze(2).expand(-1, STEPS, 1, 2), None)
ended = ending.expand(-1, STEPS, 2)
lasting = EliminatedAHMM(Outputs((options, choice), (ended,)), lengths)
memoryless = EliminatedAHMM(Outputs((options, choice), (None,)), lengths)
first_of_each = lasting.sample().float().reshape(R, M, STEPS, 1)[:, :1]
simulated = first_of_each.expand(R, M, STEPS, 1).reshape(R * M, STEPS, 1)

figure, panels = plt.subplots(1, 2, figsize=(10, 2.8), sharey=True, layout="constrained")
for axes, name, model in zip(panels, ("EliminatedAHMM", "memoryless"), (lasting, memoryless), strict=True):
    scores = model.log_prob(simulated).reshape(R, M)
    values = torch.cat([candidates.double(), scores.unsqueeze(-1)], -1)
    share = scores.softmax(1).unsqueeze(-1)
    rank = (share * (values < values[:, :1])).sum(1) + share[:, 0] * torch.rand(R, 8)  # ties at random
    counts = [np.histogram(column, 20, (0, 1))[0] for column in rank.T.numpy()]
    print(f"{name}: p-values of uniform ranks", [f"{chisquare(count).pvalue:.2g}" for count in counts])
    axes.stairs(counts[6], np.linspace(0, 1, 21), label="weight of η")
    axes.stairs(counts[7], np.linspace(0, 1, 21), label="log-likelihood")
    axes.axhline(R / 20, color="black", linewidth=0.5)
    axes.set(title=name, xlabel="rank")
panels[0].legend()
plt.show()

# %% [markdown] The p-values are those of seven weights and of the log-likelihood. With the right model none
# is small. A posterior with memoryless options is rejected.
