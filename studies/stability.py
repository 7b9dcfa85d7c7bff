"""How much do quality and structure of a fit depend on its initialisation (SM 2.4)?

    python studies/stability.py [--seeds 10] [--specs needle metaworld_pick_place] [--jobs 1] [--set KEY=VALUE]...

Fits each spec with {random, vq} initialisation × {joint, layer-wise} training and a hybrid meta-policy (which may also
emit the control itself, or high-fitting could not be seen), for each training seed. The demonstrations, and which of
them are trained with, tuned with and held out, are the same for all. A fit that is done (``runs/stability``) is not
done again, all settings of a seed come before the next seed, and only complete seeds count. Writes
``docs/results/stability.json``, ``.md`` and ``.png``.
"""

from __future__ import annotations

import argparse
import json
import time
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from joblib import Parallel, delayed
from matplotlib.axes import Axes
from provenance import Record, record, sentence, text
from scipy import stats
from sklearn.metrics import normalized_mutual_info_score

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import write_text
from ddco_pyro.drawing.figures import FAINT, INK, blank, save, style
from ddco_pyro.evaluation.options import (
    DOMINATING_SHARE,
    HIGH_FITTING_SHARE,
    SMALLEST_DIVERGENCE,
    divergences,
    option_use,
)
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.spec import Spec, load_spec
from ddco_pyro.training.data import demonstrations, parts
from ddco_pyro.training.networks import Dimensions
from ddco_pyro.training.restarts import train_model

OUT = Path("docs/results")
RUNS = Path("runs/stability")
SETTINGS = tuple(product(("random", "vq"), (False, True)))
DATA_SEED = 0  # of what is held out and tuned with, whatever the training seed
REPORTED = {
    "valid": "held-out nats/step",
    "train": "training nats/step",
    "selects_option": "P(meta-policy selects an option)",
    "control": "high-fitting: control's share",
    "largest": "imbalance: largest option's share",
    "divergence": "redundancy: smallest divergence, nats/step",
}


def name_of(initialize: str, layerwise: bool) -> str:
    """What a setting is called."""
    return f"{initialize}, {'layer-wise' if layerwise else 'joint'}"


def spec_of(name: str, initialize: str, layerwise: bool, seed: int, changes: list[str]) -> Spec:
    """A spec of the study."""
    own = [f"training.initialize={initialize}", f"training.layerwise={str(layerwise).lower()}", f"seed={seed}"]
    hybrid = ["hierarchy.meta_policy.emits=[options, control]", "compare_with=[]", "training.restarts=1"]
    return load_spec(f"specs/{name}.yaml", [*hybrid, *changes, *own])


def divide(spec: Spec) -> tuple[Demonstrations, dict[str, Demonstrations]]:
    """All demonstrations, and those of ``train`` (with a mask of what is tuned with) and ``valid``."""
    demos = demonstrations(spec)
    found = parts(spec.model_copy(update={"seed": DATA_SEED}), demos)
    _, tune = found["train"].split(spec.training.tune_fraction, DATA_SEED)
    found["train"] = Demonstrations(found["train"].demonstrations, {"valid": tune.names})
    return demos, found


def run(name: str, initialize: str, layerwise: bool, seed: int, changes: list[str], made_by: Record) -> Path:
    """One fit, unless it is done; where its numbers are."""
    layers = "layerwise" if layerwise else "joint"
    path = RUNS / name / f"{seed:02d}-{initialize}-{layers}.json"
    if path.exists():
        if json.loads(path.read_text())["changes"] != changes:
            raise SystemExit(f"{path} was made with other --set; remove {RUNS}")
        return path
    start = time.process_time()
    spec = spec_of(name, initialize, layerwise, seed, changes)
    demos, divided = divide(spec)
    hierarchy = train_model(spec, Dimensions.of(demos), divided["train"]).hierarchy
    found = measure(Fit(spec, hierarchy), demos, divided)
    found |= {"spec": name, "setting": name_of(initialize, layerwise), "seed": seed, "changes": changes}
    found |= {"made_by": made_by}
    write_text(path, json.dumps(found | {"cpu_seconds": time.process_time() - start}) + "\n")
    return path


def measure(fit: Fit, demos: Demonstrations, divided: dict[str, Demonstrations]) -> dict[str, Any]:
    """The numbers of a fit, its segmentation of all demonstrations among them."""
    posterior = fit.posterior(demos)
    with torch.no_grad():
        outputs = fit.hierarchy(fit.hierarchy.encoder.inputs(demo.observations for demo in demos))
    selection = outputs.callers[-1].selection
    assert selection is not None  # the meta-policy emits options
    steps = torch.arange(selection.shape[1]) < torch.tensor(demos.lengths)[:, None]
    control, *options = [one.share for one in option_use(posterior)[0]]
    apart = [one.divergence for one in divergences([(outputs, posterior)])[0]]
    segments = fit.segment(demos)[0]
    return {
        **{part: float(fit.log_likelihood(own).sum() / sum(own.lengths)) for part, own in divided.items()},
        "selects_option": float(1 - selection[:, :, 0, 0].exp()[steps].mean()),
        "control": control,
        "largest": max(options) / sum(options),
        "divergence": min(one for one in apart if one is not None),
        "redundant_pairs": sum(one < SMALLEST_DIVERGENCE for one in apart if one is not None),
        "segments": [row[row >= 0].tolist() for row in segments],
    }


def complete(found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The fits of those seeds of which all settings are there."""
    return [one for one in found if sum(one["seed"] == other["seed"] for other in found) == len(SETTINGS)]


def summarize(found: list[dict[str, Any]]) -> dict[str, Any]:
    """Numbers of each setting over seeds, and how their variances compare with those of random and joint."""
    summary: dict[str, Any] = {}
    for setting in (name_of(*one) for one in SETTINGS):
        own = sorted((one for one in found if one["setting"] == setting), key=lambda one: one["seed"])
        values = {key: [one[key] for one in own] for key in REPORTED}
        pairs = [_nmi(a["segments"], b["segments"]) for a, b in combinations(own, 2)]
        summary[setting] = {
            "seeds": [one["seed"] for one in own],
            "values": values,
            "mean": {key: float(np.mean(row)) for key, row in values.items()},
            "variance": {key: float(np.var(row, ddof=1)) for key, row in values.items()},
            "nmi": {"mean": float(np.mean(pairs)), "pairs": pairs},
            "high_fitting": sum(share > HIGH_FITTING_SHARE for share in values["control"]),
            "imbalanced": sum(share > DOMINATING_SHARE for share in values["largest"]),
            "redundant": sum(one["redundant_pairs"] > 0 for one in own),
            "cpu_seconds": sum(one["cpu_seconds"] for one in own),
        }
    first = summary[name_of(*SETTINGS[0])]
    for one in summary.values():
        one["against_first"] = {key: _against(one, first, key) for key in ("valid", "train")}
    return summary


def _nmi(ours: list[list[int]], theirs: list[list[int]]) -> float:
    return float(normalized_mutual_info_score(np.concatenate(ours), np.concatenate(theirs)))


def _against(one: dict[str, Any], first: dict[str, Any], key: str) -> dict[str, float | None]:
    """Ratio of variances, and the p-value of Brown and Forsythe's test that they are equal."""
    if one is first:
        return {"variance_ratio": 1.0, "p_value": None}
    test = stats.levene(one["values"][key], first["values"][key], center="median")
    return {"variance_ratio": one["variance"][key] / first["variance"][key], "p_value": float(test.pvalue)}


def markdown(summaries: dict[str, Any], made_by: str) -> str:
    """The study as Markdown."""
    lines = [
        made_by,
        "",
        "Mean over seeds; variance over seeds, with its ratio to that of random and joint and the p-value of "
        "Brown and Forsythe's test that the two are equal (not corrected for the number of tests). NMI: mean over all "
        "pairs of seeds. P(option): the meta-policy's own probability of an option rather than the control, over all "
        "steps. The last three count the seeds in which control is active in more than "
        f"{HIGH_FITTING_SHARE:.0%} of the steps, one option in more than {DOMINATING_SHARE:.0%} of those of all "
        f"options, or two options differ by less than {SMALLEST_DIVERGENCE} nats per step.",
    ]
    head = (
        "initialise, train", "held-out nats/step", "variance", "training nats/step", "variance", "NMI", "P(option)",
        "control's share", "largest option's share", "smallest divergence", "high-fitting", "imbalanced", "redundant",
    )  # fmt: skip
    for name, summary in summaries.items():
        number = len(next(iter(summary.values()))["seeds"])
        lines += ["", f"**{name}**, {number} seeds", "", f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
        lines += [f"| {' | '.join(_cells(setting, one, number))} |" for setting, one in summary.items()]
    return "\n".join(lines) + "\n"


def _cells(setting: str, one: dict[str, Any], number: int) -> list[str]:
    mean = one["mean"]
    cells = [setting]
    for key in ("valid", "train"):
        cells += [f"{mean[key]:.2f}", _variance(one["variance"][key], one["against_first"][key])]
    cells += [f"{one['nmi']['mean']:.2f}", *(f"{mean[key]:.2f}" for key in ("selects_option", "control", "largest"))]
    counts = [f"{one[key]} of {number}" for key in ("high_fitting", "imbalanced", "redundant")]
    return [*cells, f"{mean['divergence']:.2g}", *counts]


def _variance(value: float, against: dict[str, float | None]) -> str:
    if against["p_value"] is None:
        return f"{value:.2g}"
    return f"{value:.2g} (× {against['variance_ratio']:.2g}, p = {against['p_value']:.2g})"


def draw(summaries: dict[str, Any], path: Path) -> None:
    """A row for each spec: log-likelihoods of all seeds, NMI of all pairs, probability of an option."""
    with style():
        figure = blank(0.5 + 1.7 * len(summaries))
        rows = figure.subplots(len(summaries), 3, squeeze=False, sharey=True)
        for (left, middle, right), (name, summary) in zip(rows, summaries.items(), strict=True):
            for place, one in enumerate(summary.values()):
                _dots(left, place, one["values"]["valid"])
                _dots(middle, place, one["nmi"]["pairs"])
                _dots(right, place, one["values"]["selects_option"])
            left.set_yticks(range(len(summary)), list(summary))
            left.set_ylim(len(summary) - 0.5, -0.5)
            left.set(title=name, xlabel="held-out nats per step")
            left.locator_params(axis="x", nbins=5)
            middle.set(xlabel="NMI of pairs of seeds", xlim=(-0.02, 1.02))
            right.set(xlabel="P(meta-policy selects an option)", xlim=(-0.02, 1.02))
        save(figure, path, "Quality and structure of fits from different seeds, for each way to train", "")


def _dots(axes: Axes, place: int, values: list[float]) -> None:
    axes.plot(values, [place] * len(values), "o", ms=3.5, color=FAINT, alpha=0.6, mew=0)
    axes.plot(np.mean(values), place, "|", ms=15, mew=2, color=INK)
    axes.grid(axis="x", color="#e4e4e4")


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--specs", nargs="+", default=["needle", "metaworld_pick_place"], metavar="NAME")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    own = parser.parse_args()
    settings = "".join(f" --set '{one}'" for one in own.set)
    command = f"python studies/stability.py --seeds {own.seeds} --specs {' '.join(own.specs)}{settings}"
    made_by = record(command)
    pool = Parallel(n_jobs=own.jobs, return_as="generator_unordered", batch_size=1)
    for path in pool(
        delayed(run)(name, *setting, seed, own.set, made_by)
        for seed in range(own.seeds)
        for name in own.specs
        for setting in SETTINGS
    ):
        print(path, flush=True)
    report(own.specs, own.seeds, command)


def report(names: list[str], seeds: int, command: str) -> None:
    """Write the results of what is there."""
    summaries, made_by = {}, []
    for name in names:
        found = complete([json.loads(path.read_text()) for path in sorted((RUNS / name).glob("*.json"))])
        used = [one for one in found if one["seed"] < seeds]
        summaries[name] = summarize(used)
        made_by += [one.get("made_by") for one in used]
    page = markdown(summaries, sentence(command, made_by))
    write_text(OUT / "stability.json", text(summaries, made_by))
    write_text(OUT / "stability.md", page)
    draw(summaries, OUT / "stability.png")
    print(page)


if __name__ == "__main__":
    main()
