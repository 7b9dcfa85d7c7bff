"""The page's sections, each made of what the run has; None where a section does not apply."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from ddco_pyro.drawing import scores, words
from ddco_pyro.drawing.pictures import Picture, keep
from ddco_pyro.evaluation.diagnostics import diagnose
from ddco_pyro.fitting.fit import Fit
from ddco_pyro.report import (
    film,
    plot_branches,
    plot_learning,
    plot_likelihood,
    plot_success,
    tables,
)
from ddco_pyro.report.signs import warning
from ddco_pyro.spec import Spec, dump_spec


@dataclass(frozen=True)
class Header:
    """What was fitted to what, and the verdict."""

    model: str
    name: str
    verdict: str
    success: str
    facts: Mapping[str, str]


@dataclass(frozen=True)
class Figures:
    """A section of figures, with a table and a sentence where they apply."""

    pictures: list[Picture]
    table: tables.Table | None = None
    text: str = ""


@dataclass(frozen=True)
class Agreement:
    """Measures of all levels with ground-truth labels; for each level where the steps of each label lie, ``confusion``,
    with what that is called, of ``part``.
    """

    labels: str
    measures: tables.Table
    explained: str
    confusion: list[tuple[str, tables.Table]]
    part: str


@dataclass(frozen=True)
class Rollouts:
    """Success of the methods in the task."""

    episodes: int
    seed: int
    measures: tables.Table
    against: tables.Table | None
    picture: Picture | None


@dataclass(frozen=True)
class Warnings:
    """Signs of a degenerate solution, each in words with what usually helps; None for a policy without options. Stages
    of training that had not converged, likewise.
    """

    found: list[tuple[str, str]] | None
    unconverged: list[tuple[str, str]]


@dataclass(frozen=True)
class Films:
    """Filmed rollouts."""

    strip: Picture | None
    films: list[film.Film]


@dataclass(frozen=True)
class Particulars:
    """How the run was made."""

    spec: str
    check: Mapping[str, str]
    seconds: Mapping[str, str]
    versions: Mapping[str, str]


def header(fit: Fit, metrics: Mapping[str, Any]) -> Header:
    """Model, spec, verdict, demonstrations, supervisor."""
    counts = metrics["demonstrations"]
    facts = {
        "Demonstrations": f"{counts['train']} for training, {counts['tune']} for tuning, {counts['valid']} held out",
        "Parameters": str(metrics["parameters"]),
    }
    if "training" in metrics:
        facts["Training"] = words.spent(metrics["training"])
    own = counts.get("supervisor", {}).get("success")
    if own and "successes" in own:
        facts["Supervisor’s own success"] = f"{words.rate(own, 'demonstrations')}, 95 % interval"
    name = fit.run_folder.resolve().name
    return Header(words.method(fit.name), name, words.verdict(metrics), words.success(metrics), facts)


def likelihood(fit: Fit, metrics: Mapping[str, Any]) -> Figures:
    """Held-out log-likelihood."""
    rows = plot_likelihood.likelihoods(metrics, {name: baseline.metrics for name, baseline in fit.baselines.items()})
    alt = "; ".join(f"{words.method(row.name)}: {words.number(row.valid)} nats per step held out" for row in rows)
    caption = "Log-likelihood of the model."
    if len(rows) > 1:
        caption = (
            "Left: log-likelihood of each method. Right: the model’s minus each baseline’s on the same held-out "
            "demonstrations; diamond: mean with one standard error, dots: single demonstrations."
        )
    picture = keep(plot_likelihood.draw(rows), fit.run_folder / "figures" / "likelihood.png", alt, caption)
    return Figures([picture], tables.likelihood(rows), words.about(row.name for row in rows))


def rollouts(fit: Fit, metrics: Mapping[str, Any]) -> Rollouts | None:
    """Success in the task."""
    record = metrics.get("rollouts")
    if not record:
        return None
    methods = record["methods"]
    success = {name: results["measures"].get("success", {}) for name, results in methods.items()}
    rates = {name: rate for name, rate in success.items() if rate.get("interval") and "rate" in rate}
    picture = None
    if rates:
        alt = "; ".join(f"{words.method(name)}: {words.rate(rate)}" for name, rate in rates.items())
        caption = "Success rate of each method with its Wilson 95 % interval."
        picture = keep(plot_success.draw(rates), fit.run_folder / "figures" / "success.png", f"Success. {alt}", caption)
    against = tables.against(methods, metrics["model"])
    return Rollouts(record["episodes"], record["seed"], tables.measures(methods), against, picture)


def learning(fit: Fit) -> Figures | None:
    """Learning curves of the model and its baselines."""
    folders = {fit.name: fit.run_folder} | {name: baseline.run_folder for name, baseline in fit.baselines.items()}
    paths = {name: folder / "history.csv" for name, folder in folders.items()}
    stages = plot_learning.stages({name: path for name, path in paths.items() if path.exists()})
    if not stages:
        return None
    caption = (
        "Log-likelihood per step over epochs, each stage of training in its own panel and on its own scale; a pair of "
        "lines for each restart. A steep start may be cut off."
    )
    alt = "Learning curves of the stages " + ", ".join(stage.title for stage in stages)
    names = list(dict.fromkeys(stage.name for stage in stages))
    kinds = dict.fromkeys(name.partition("-")[0] for name in names)
    text = " ".join([*(STAGES[kind] for kind in kinds if kind in STAGES), STAGE_NAMES.format(", ".join(names))])
    picture = keep(plot_learning.draw(stages), fit.run_folder / "figures" / "learning.png", alt, caption)
    return Figures([picture], text=text)


STAGES = {
    "vq": "“From clusters” trains each option of a level on a cluster of steps of its own, so that options differ from "
    "the beginning; it maximises another quantity, to be compared within its panel only.",
    "parts": "“From equal parts” trains each option of a level on a part of its own of every demonstration, equally "
    "long; it maximises another quantity, to be compared within its panel only.",
    "level": "“Alone” trains a level’s options before anything selects among them: each is as likely as any other.",
    "meta": "“Meta-policy alone” then trains the policy that selects the options.",
    "joint": "“All together” trains everything once more.",
}
STAGE_NAMES = "In history.csv and on the console the stages are {}."


def branches(fit: Fit, metrics: Mapping[str, Any]) -> Figures | None:
    """Which inputs matter; None where no network has branches."""
    uses = metrics.get("branches")
    if not uses:
        return None
    levels = fit.spec.hierarchy.levels if fit.spec.hierarchy else ()
    names = [
        [f"{levels[use['level']].name} {number + 1}" for number in range(len(use["loss"]))]
        if use["level"] < len(levels)
        else ["meta-policy" if levels else "policy"]
        for use in uses
    ]
    caption = (
        "Left: the mean size of what each branch gives the joint layer, while the option is active. Right: by how many "
        "nats per step its control is less likely where the branch reads what was observed at another step."
    )
    picture = keep(plot_branches.draw(uses, names), fit.run_folder / "figures" / "branches.png", "Branches", caption)
    return Figures([picture], tables.branches(uses, names))


def quoted(names: Iterable[str]) -> str:
    """Labels by their names."""
    return "label " + " and ".join(f"“{name}”" for name in names)


def agreement(fit: Fit, metrics: Mapping[str, Any]) -> Agreement | None:
    """How well the options agree with ground-truth labels; None where there are none."""
    record = metrics.get("agreement")
    if not record or fit.spec.hierarchy is None:
        return None
    names = [level.name for level in fit.spec.hierarchy.levels]
    part = "valid" if "valid" in record else "train"
    confusion = [
        (f"level “{level}”, label “{labels}”", tables.confusion(own))
        for level, labels, own in zip(names, record["labels"], record.get("confusion", ()), strict=False)
    ]  # runs of before have none
    labels = quoted(dict.fromkeys(record["labels"]))
    return Agreement(labels, tables.agreement(names, record), scores.EXPLAINED, confusion, PART_NAMES[part])


PART_NAMES = {"valid": "held-out", "train": "training"}


def warnings(fit: Fit, metrics: Mapping[str, Any]) -> Warnings | None:
    """Signs of a degenerate solution, and of too short a training."""
    unconverged = words.unconverged(metrics)
    if fit.spec.hierarchy is None:
        return Warnings(None, unconverged) if unconverged else None
    return Warnings(degeneracies(fit.spec, metrics), unconverged)


def degeneracies(spec: Spec, metrics: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Signs of a degenerate solution in ``metrics.json``, each in words with its number, and what usually helps."""
    if spec.hierarchy is None:
        return []
    levels = spec.hierarchy.levels
    findings = diagnose(metrics["options"], metrics.get("divergences", ()))  # runs of before have no divergences
    return [
        (warning(finding, levels[finding.level - 1].name), finding.advice)
        for finding in findings
        if finding.kind != "never_persisting" or levels[finding.level - 1].lasts
    ]


def films(fit: Fit) -> Films | None:
    """Filmed rollouts, the model's first."""
    clips = film.films(fit.run_folder, first=fit.name)
    if not clips:
        return None
    strip = None
    if clips[0].method == fit.name:
        clip = clips[0]
        outcome = f" ({clip.outcome})" if clip.outcome else ""
        caption = (
            f"Frames of {words.method(clip.method)}, seed {clip.seed}{outcome}. The border has the colour of the "
            "lowest level’s option; h1 is its number."
        )
        figure = film.draw_strip(fit.run_folder / clip.link)
        strip = keep(
            figure, fit.run_folder / "figures" / "film.png", f"Film strip of one rollout, seed {clip.seed}", caption
        )
    return Films(strip, clips)


def particulars(fit: Fit, metrics: Mapping[str, Any]) -> Particulars:
    """Spec, engine check, seconds and versions."""
    check = {name: f"{value:.1e}" for name, value in metrics["engine_check"].items()}
    seconds = {name: words.number(value, 1) for name, value in metrics["seconds"].items()}
    return Particulars(dump_spec(fit.spec), check, seconds, metrics["versions"])
