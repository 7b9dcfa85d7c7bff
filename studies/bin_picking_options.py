"""Which options of bin picking are active in the steps of a trial, and in a bin in which the policy acts; and which
inputs each of them attends to.

    python studies/bin_picking_options.py RUN [--bin 950000]

RUN is the folder of a fit of ``specs/bin_picking.yaml``, such as ``studies/bin_picking.py`` makes. Options are those of
the most likely path through the demonstrations, trials apart by how they end. Of the bin, the first frames are shown
with the left mask, and the options of all steps. An option attends to an input by as much as its control would change
with it: the standard deviation, to first order, of each number of the control if that input alone varied as it does
over all demonstrated steps. So do its termination and the meta-policy's choice.
Writes ``docs/results/bin_picking/options.json``, ``options.md`` and ``options.png``.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cells import printed
from ddco_tasks.bin_picking.objects import ACCEPTED, KINDS
from ddco_tasks.bin_picking.supervisor import PHASES
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from provenance import record, sentence, text
from torch import Tensor

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.data.files import whole_file, write_text
from ddco_pyro.drawing.colours import option_colour
from ddco_pyro.evaluation.inferred import infer
from ddco_pyro.fitting.fitted import Fit, load
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.networks import Inputs
from ddco_pyro.model.outputs import Outputs
from ddco_pyro.simulation.collect import collect
from ddco_pyro.simulation.episodes import Episode, run_episode
from ddco_pyro.simulation.task import find_task

OUT = Path("docs/results/bin_picking")
STEPS = 10  # of a trial of the supervisor
ENDS = ("to the accept cup", "to the reject cup", "back over the bin")
LABELS = ("phase", "kind")
FRAMES = 11  # of the bin, as many as a trial has with its end
PART = (slice(90, 270), slice(90, 390))  # of a frame, where something happens

SHADES = {"image": "#1f3b73", "grasp": "#c9a227", "kin": "#5b8c5a", "load": "#a23b3b"}

Attention = dict[str, dict[str, float]]
"""Of what options and meta-policy do, the part of each input in what it would change with."""
Shares = dict[str, list[dict[int, float]]]
"""By how a trial ends, for each of its steps, the part of the trials in which each option is active."""


def trials(controls: np.ndarray) -> list[slice]:
    """The steps of each trial among controls [T, 7]: it ends with the step in which the jaws open."""
    opened = controls[:, 6] > 0.5
    ends = np.flatnonzero(opened & ~np.append(True, opened[:-1])) + 1
    return [slice(start, end) for start, end in zip([0, *ends], ends, strict=False)]


def end(demo: Demonstration, trial: slice) -> str:
    """How a demonstrated trial ends."""
    phase, kind = (demo.labels[name][trial] for name in LABELS)
    if PHASES.index("recover") in phase:
        return ENDS[2]
    return ENDS[0] if KINDS[int(kind[-1])] == ACCEPTED else ENDS[1]


def shares(demos: Demonstrations, options: np.ndarray) -> tuple[Shares, dict[str, int]]:
    """Over all demonstrated trials, ``options`` [N, T] being the active ones; and how many trials end in each way."""
    counts: dict[str, list[Counter[int]]] = {name: [Counter() for _ in range(STEPS)] for name in ENDS}
    ended: Counter[str] = Counter()
    for demo, active in zip(demos, options, strict=True):
        for trial in trials(demo.actions):
            name = end(demo, trial)
            ended[name] += 1
            for step, option in enumerate(active[trial][:STEPS]):
                counts[name][step][int(option)] += 1
    found = {
        name: [{option: number / step.total() for option, number in sorted(step.items())} for step in each]
        for name, each in counts.items()
    }
    return found, dict(ended)


def attention(hierarchy: Hierarchy, demos: Demonstrations, options: np.ndarray) -> Attention:
    """What moves the control and the termination of each option, over the demonstrated steps in which it is the active
    one of ``options`` [N, T]; and what moves the meta-policy's choice, over those in which another one begins.

    The slopes g [F] of a number with an input, and the covariance Σ [F, F] of the input over all steps, give √(gᵀΣg);
    this is divided by its sum over the inputs, and averaged over numbers and steps, where anything moves them. The
    numbers are those of the control, the termination's logit, and log-probabilities of the choice.
    """
    each = [next(infer(hierarchy, [demo])).batch.inputs.loaded() for demo in demos]
    arrays = [{**inputs.vectors, **inputs.images} for inputs in each]
    seen = {key: torch.cat([one[key][0].float().flatten(1) for one in arrays]) for key in arrays[0]}
    centred = {key: values - values.mean(0) for key, values in seen.items()}
    active = [torch.as_tensor(path[: len(demo)]) for demo, path in zip(demos, options, strict=True)]
    found = [_spreads(_slopes(hierarchy, *one), centred) for one in zip(each, active, strict=True)]
    spread = {key: np.concatenate([one[key] for one in found]) for key in centred}
    chosen, size = torch.cat(active).numpy(), hierarchy.scaling.numbers
    begins = np.concatenate([np.diff(path.numpy(), prepend=0) != 0 for path in active])
    parts = {"control": slice(size), "termination": slice(size, size + 1)}
    shared = {
        f"{part}, option {option}": _shared(spread, chosen == option, numbers)
        for option in np.unique(chosen[chosen > 0])
        for part, numbers in parts.items()
    }
    return shared | {"choice": _shared(spread, begins, slice(size + 1, None))}


def _slopes(hierarchy: Hierarchy, inputs: Inputs, active: Tensor) -> dict[str, Tensor]:
    """How what is said of each step changes with each input of that step [T, A, F]; these networks remember nothing."""
    vectors, images = (
        {key: array.detach().float().requires_grad_() for key, array in part.items()}
        for part in (inputs.vectors, inputs.images)
    )
    arrays = vectors | images
    said = _said(hierarchy(Inputs(vectors, images, inputs.time)), active)
    how = {"retain_graph": True, "allow_unused": True, "materialize_grads": True}
    slopes = [torch.autograd.grad(number.sum(), [*arrays.values()], **how) for number in said.T]
    return {key: torch.stack(own, 2)[0].flatten(2) for key, own in zip(arrays, zip(*slopes, strict=True), strict=True)}


def _said(outputs: Outputs, active: Tensor) -> Tensor:
    """The active option's control and the logit of its termination, and log-probabilities of the meta-policy's choices,
    of each step, [T, A].
    """
    numbers, logits = outputs.callers[0].numbers, outputs.callers[-1].logits
    assert numbers is not None  # options emit the control
    assert logits is not None  # there are several of them
    steps = torch.arange(len(active))
    ends = outputs.termination_logits[0][0, steps, active - 1, None]
    return torch.cat([numbers[0, steps, active - 1], ends, logits[0, :, 0].log_softmax(-1)], dim=-1)


def _spreads(slopes: Mapping[str, Tensor], centred: Mapping[str, Tensor]) -> dict[str, np.ndarray]:
    """√(gᵀΣg) of each input for each step and number, [T, A]."""
    return {key: (slopes[key] @ values.T).square().mean(-1).sqrt().numpy() for key, values in centred.items()}


def _shared(spread: Mapping[str, np.ndarray], steps: np.ndarray, numbers: slice) -> dict[str, float]:
    own = {key: values[steps, numbers] for key, values in spread.items()}
    total = np.sum([*own.values()], axis=0)
    moved = total > 0  # nothing moves the log-probability of a choice that is certain
    return {key: float((values[moved] / total[moved]).mean()) for key, values in own.items()}


def acted(fit: Fit, seed: int) -> Episode:
    """The bin of this seed, with frames."""
    return run_episode(find_task("bin_picking"), fit.controller(), seed, film=True, observed=fit.spec.observed)


def draw(found: Shares, ended: dict[str, int], attended: Attention, episode: Episode, path: Path) -> None:
    """Shares over the steps of a trial, a panel for each end, and what each option attends to; below, the beginning of
    the bin, and its options.
    """
    figure = Figure(figsize=(13, 6.6), layout="constrained")
    FigureCanvasAgg(figure)
    above, below, strip = figure.subfigures(3, 1, height_ratios=[3, 2.2, 0.7])
    *panels, last = above.subplots(1, len(ENDS) + 1, sharey=True)
    for axes, name in zip(panels, ENDS, strict=True):
        _stacked(axes, found[name])
        axes.set_title(f"{name} ({ended.get(name, 0)} trials)", fontsize=9)
    _attended(last, attended)
    options = sorted({option for steps in found.values() for step in steps for option in step})
    handles = [Patch(color=option_colour(option), label=f"option {option}") for option in options]
    handles += [Patch(color=shade, label=key) for key, shade in SHADES.items()]
    above.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=8)
    masks = episode.record.observations["image"]
    for number, (scene, seen) in enumerate(below.subplots(2, FRAMES).T):
        scene.axis("off")
        seen.axis("off")
        if number < len(masks):
            scene.imshow(episode.frames[number][PART])
            scene.set_title(str(number), fontsize=7)
            seen.imshow(np.asarray(masks[number])[..., 0], cmap="gray")
    _path(strip.subplots(), episode)
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=110, format="png")


def _stacked(axes: Axes, steps: list[dict[int, float]]) -> None:
    top = np.zeros(STEPS)
    for option in sorted({option for step in steps for option in step}):
        heights = np.array([step.get(option, 0.0) for step in steps])
        axes.bar(range(STEPS), heights, 1.0, bottom=top, color=option_colour(option))
        top += heights
    axes.set(xlabel="step of the trial", xticks=range(STEPS), ylim=(0, 1), ylabel="share of trials")


def _attended(axes: Axes, attended: Attention) -> None:
    top = np.zeros(len(attended))
    for key, shade in SHADES.items():
        heights = np.array([one[key] for one in attended.values()])
        axes.bar([name.replace("option ", "") for name in attended], heights, 0.8, bottom=top, color=shade)
        top += heights
    axes.set_title("what each input moves", fontsize=9)
    axes.tick_params(axis="x", labelrotation=90, labelsize=7)


def _path(axes: Axes, episode: Episode) -> None:
    for step, option in enumerate(episode.choices[:, 0]):
        axes.bar(step, 1, 1.0, color=option_colour(int(option)))
    for trial in trials(episode.record.actions):
        axes.axvline(trial.stop - 0.5, color="black", lw=1)
    axes.set(xlabel="step of the bin; a line where the jaws opened", yticks=[], xlim=(-0.5, len(episode.choices) - 0.5))


def page(results: dict[str, Any], made_by: str) -> str:
    """The results as Markdown."""
    lines = [made_by, "", "Active option in each step of a demonstrated trial, and in which part of the trials.", ""]
    lines += [f"| trials | {' | '.join(map(str, range(STEPS)))} |", "|---" * (STEPS + 1) + "|"]
    for name, steps in results["shares"].items():
        cells = [", ".join(f"{option}: {share:.0%}" for option, share in step.items()) or "-" for step in steps]
        lines.append(f"| {name} ({results['trials'].get(name, 0)}) | {' | '.join(cells)} |")
    inputs = list(SHADES)
    lines += [
        "",
        "What moves an option's control and its termination, in the steps in which it is active, and the meta-policy's "
        "choice, in those in which another one begins: the part of each input.",
        "",
        f"| | {' | '.join(inputs)} |",
        "|---" * (len(inputs) + 1) + "|",
    ]
    for name, parts in results["inputs"].items():
        lines.append(f"| {name} | {' | '.join(f'{parts[key]:.0%}' for key in inputs)} |")
    lines += ["", "![options over the steps of a trial, and over a bin](options.png)"]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--bin", type=int, default=950_000)
    own = parser.parse_args()
    printed(lambda: run(own))


def run(own: argparse.Namespace) -> str:
    """Look at the fit, and write what came of it; the page."""
    command = f"python studies/bin_picking_options.py {own.run} --bin {own.bin}"
    made_by = record(command)
    torch.set_num_threads(1)
    fit = load(own.run)
    demos = Demonstrations.read(collect("bin_picking", fit.spec.demonstrations), fit.spec.observed, labels=LABELS)
    options = fit.segment(demos)[0]
    found, ended = shares(demos, options)
    attended, episode = attention(fit.hierarchy, demos, options), acted(fit, own.bin)
    results = {"shares": found, "trials": ended, "inputs": attended}
    results |= {"bin": {"seed": own.bin, "outcome": episode.outcome}}
    draw(found, ended, attended, episode, OUT / "options.png")
    shown = page(results, sentence(command, [made_by]))
    write_text(OUT / "options.json", text(results, [made_by]))
    write_text(OUT / "options.md", shown)
    return shown


if __name__ == "__main__":
    main()
