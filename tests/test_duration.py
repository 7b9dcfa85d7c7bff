"""The prior on how long options last."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from made_metrics import made_metrics
from planted import LINEAR, make_spec, make_trainer, make_truth, plant, tabulated
from scipy import stats

import ddco_pyro
from ddco_pyro.evaluation.options import durations
from ddco_pyro.inference import log_likelihood, posterior
from ddco_pyro.model.outputs import log_termination
from ddco_pyro.spec import DurationSpec, with_overrides
from ddco_pyro.training.checkpoint import Progress
from ddco_pyro.training.loop import backward
from ddco_pyro.training.objective import Objective, log_duration_prior
from ddco_pyro.training.stages import plan

LENGTHS = torch.tensor([4, 3])


def prior(mean, weight=1.0):
    return DurationSpec.model_validate({"mean": mean, "weight": weight})


def random_logits(*counts, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return [torch.randn(2, 4, count, generator=generator, dtype=torch.float64) for count in counts]


@pytest.mark.parametrize("mean", [20, [20, 3]])
def test_it_is_a_beta_density_of_each_logit_summed_over_steps(mean):
    """Differences of scipy's Beta log-densities, with the Jacobian dψ/dx = ψ (1 - ψ): constants cancel."""
    means = mean if isinstance(mean, list) else [mean, mean]
    values, expected = [], []
    for seed in (0, 1):
        logits = random_logits(2, 3, seed=seed)
        values.append(log_duration_prior([log_termination(x) for x in logits], LENGTHS, prior(mean, 2.5)))
        total = np.zeros(len(LENGTHS))
        for level, m, lasts in zip(logits, means, np.cumprod(means), strict=True):
            psi, steps = (12 * torch.tanh(level / 12)).sigmoid().numpy(), int(LENGTHS.sum())
            v = 2.5 * steps / (level.shape[2] * lasts)  # selections of each option under these means, times the weight
            density = stats.beta(v, v * (m - 1)).logpdf(psi) + np.log(psi) + np.log(1 - psi)
            total += [density[n, :length].sum() / steps for n, length in enumerate(LENGTHS.tolist())]
        expected.append(total)
    assert (values[0] - values[1]).numpy() == pytest.approx(expected[0] - expected[1], rel=1e-9)


def test_no_weight_is_no_prior_and_lower_levels_alone_have_theirs():
    tables = [log_termination(x) for x in random_logits(2, 3)]
    assert log_duration_prior(tables, LENGTHS, prior(20, 0)).tolist() == [0, 0]
    alone = log_duration_prior(tables[:1], LENGTHS, prior([20, 3]))
    assert alone.tolist() == log_duration_prior(tables[:1], LENGTHS, prior(20)).tolist()


def test_its_gradient_is_that_of_finite_differences():
    assert torch.autograd.gradcheck(
        lambda *logits: log_duration_prior([log_termination(x) for x in logits], LENGTHS, prior([20, 3], 0.7)),
        [x.requires_grad_() for x in random_logits(2, 3)],
    )


# --- in training ------------------------------------------------------------------------------------------------------

TRAINING = {"epochs": 80, "patience": None, "starts": ["vq_controls"], "batch_size": 4, "optimizer": {"lr": 0.1}}


@pytest.fixture(scope="module")
def demos():
    """Short options: each ends with a probability of a half."""
    return plant(make_truth(make_spec((2,)), ending=0.0), 12, 20, seed=1)[0]


def test_all_training_demonstrations_together_have_it_once(demos, tmp_path):
    """Whatever the minibatches; the tuning demonstrations in the same proportion to their likelihood."""
    spec = make_spec((2,), duration={"mean": 20, "weight": 3})
    material = make_trainer(spec, demos, tmp_path).data
    model, objective = material.hierarchy(0), Objective(material, Progress(0), plan(spec, 1)[-1])
    for batch in (material.train, material.tune):
        with torch.no_grad():
            tables = model.tabulate(batch)
        likelihood = float(log_likelihood(tables, batch.lengths).sum())
        share = 3 / (2 * 20)  # of two options that are to last 20 steps
        means = sum(
            float((table.double().sum((0, 1)) @ torch.tensor([19 * share, share]).double()).sum())
            for table in tables.termination
        )
        if batch is material.tune:
            assert objective.tune(model) == pytest.approx((likelihood + means) / batch.steps, rel=1e-6)
            continue
        parts = [backward(objective, model, material.train, rows) for rows in torch.arange(len(batch)).split(4)]
        assert sum(parts) == pytest.approx(likelihood + means, rel=1e-6)


def fitted_psi(demos, tmp_path, **training):
    """ψ of every demonstration, step and option."""
    model = make_trainer(make_spec((2,), **TRAINING, **training), demos, tmp_path).run()
    return tabulated(model, demos)[0].termination[0][..., 1].exp()


def test_it_lengthens_options_and_much_of_it_makes_them_geometric(demos, tmp_path):
    free = fitted_psi(demos, tmp_path / "free")
    some = fitted_psi(demos, tmp_path / "some", duration={"mean": 12, "weight": 1.0})
    much = fitted_psi(demos, tmp_path / "much", duration={"mean": 12, "weight": 1e5})
    lasted, last = (1 / psi.mean((0, 1)) for psi in (free, some))
    assert (lasted < 3).all()
    assert (last > 1.3 * lasted).all()
    assert (last < 12).all()
    assert (much - 1 / 12).abs().max() < 0.02  # at every step, whatever is seen


@pytest.mark.parametrize("number", [3, 12])
def test_its_weight_counts_as_much_whatever_the_number_of_demonstrations(demos, number):
    """By EM, of constants ψ: the M-step's fixed point, Σ_h ψ_h (steps_h + w N / k) = ends + w N / m, with counts that
    the posterior expects."""
    few, constant, weight = demos.select(demos.names[:number]), {"network": "constant"}, 1.5
    spec = make_spec((2,), starts=["vq_controls"], duration={"mean": 12, "weight": weight}, tune_fraction=0)
    changed = {"hierarchy.meta_policy": constant, "hierarchy.levels.0.termination": constant, "training.epochs": 300}
    changed |= {"training.optimizer": {"name": "em"}, "demonstrations.valid_fraction": 0}
    fit = ddco_pyro.fit(with_overrides(spec, changed), few)
    tables, batch = tabulated(fit.hierarchy, few)
    psi = tables.termination[0][0, 0, :, 1].double().exp()
    found, steps = posterior(tables, batch.lengths), sum(few.lengths)
    going_on = found.u[0][:, :-1, 1:].sum((0, 1))  # what ends with a demonstration does not terminate there
    ends = float(found.v[0][:, :, 1:].sum()) - number
    assert float(psi @ (going_on + weight * steps / 2)) == pytest.approx(ends + weight * steps / 12, rel=1e-3)
    assert (psi < 0.3).all()


@pytest.mark.parametrize(("mean", "short"), [(20.0, True), (6.0, False)])
def test_what_was_asked_stands_beside_what_came_of_it(mean, short):
    """On the console and the page, for each level; above the lowest in segments of the level below."""
    use = dict.fromkeys(
        ("choice", "share", "selected", "demonstrations", "duration", "segments", "length", "within"), 1.0
    )
    use |= {"choice": 1, "segments": 1, "having": 2}
    segments = [{"median": 4.0, "number": n, "demonstrations": 2} for n in (20, 5)]
    found = made_metrics(options=[[use | {"steps": 60}, use | {"steps": 40}]] * 2, segments=segments)
    level = {"count": 2, "policy": LINEAR}
    levels = [{**level, "name": "move"}, {**level, "name": "skill"}]
    changed = {"hierarchy.levels": levels, "training.duration": {"mean": [mean, 3]}}
    said = durations(found, with_overrides(make_spec((2,)), changed))
    low, high = said.values()
    assert [*said] == ["Mean duration, level “move”", "Mean duration, level “skill”"]
    assert low.startswith(f"{mean:.1f} steps asked by training.duration, 5.0 on the most likely paths")
    assert ("outweighs the prior" in low) == short
    assert high == "3.0 segments of the level below asked by training.duration, 4.0 on the most likely paths"
    assert durations(found, make_spec((2,))) == {}


def test_what_is_reported_is_the_likelihood_alone(demos):
    spec = make_spec((2,), **{**TRAINING, "epochs": 4}, duration={"mean": 50, "weight": 1e3})
    fit = ddco_pyro.fit(spec, demos)
    tables, batch = tabulated(fit.hierarchy, demos)
    values = log_likelihood(tables, batch.lengths).numpy()
    for part in ("train", "valid"):
        names = [row.name for row in fit.metrics.demonstrations_by_likelihood if row.part == part]
        expected = sum(values[demos.names.index(name)] for name in names) / (20 * len(names))
        assert getattr(fit.metrics.log_likelihood_per_step, part) == pytest.approx(expected, rel=1e-4)
