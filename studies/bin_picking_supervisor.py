"""The demonstrator of bin picking: how many objects its grasps take, how its bins end, and what a picture tells.

    python studies/bin_picking_supervisor.py [--demonstrations 60] [--out DIR]

Collects as many demonstrations as ``specs/bin_picking.yaml`` has, or others, unless they have been. What is held at the
moment of decision is also read from the observed left mask, from the shape of the load in it, and from how far the jaws
are closed, by a classifier that is tested on bins it was not trained on: it says how much of that a policy can know.
What a first grasp takes from a pile of five, as the paper counts, is measured on fresh ones. Writes
``supervisor.json`` and ``supervisor.md``.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import rates
from ddco_tasks.bin_picking import camera
from ddco_tasks.bin_picking.environment import load
from ddco_tasks.bin_picking.geometry import IMAGE_SIZE, SHOWING, project
from ddco_tasks.bin_picking.objects import KINDS
from ddco_tasks.bin_picking.supervisor import KNOWN, PHASES, Supervisor
from joblib import Parallel, delayed
from provenance import record, sentence, text
from sklearn.ensemble import ExtraTreesClassifier
from sklearn.model_selection import GroupKFold, cross_val_predict

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.data.files import write_text
from ddco_pyro.simulation.collect import collect
from ddco_pyro.simulation.episodes import rate
from ddco_pyro.spec import load_spec

SPEC = "specs/bin_picking.yaml"
FOLDS = 5
BEST = "the shape and the jaws' angle"
SENT_BACK = 0.03  # of single objects, at which it is counted how many loads of several and of nothing are told
BACK = ("several", "nothing")  # what is not carried to a cup
SHOWN_WITHIN = 13  # rows of the observed mask about the place where the load is shown
PILES, FIRST_PILE = 200, 330_000
"""Fresh piles of five, and the seed of the first."""
PAPER = {"something": "94 %", "two": "32 %", "three": "14 %", "four or more": "0.5 %"}


def decisions(demo: Demonstration) -> np.ndarray:
    """The steps after what is held was shown: a recovery, or the first step of carrying."""
    phase = demo.labels["phase"]
    after = np.flatnonzero(np.diff(phase, prepend=phase[0])) if len(phase) else np.zeros(0, int)
    return np.array([t for t in after if PHASES[phase[t]] in ("recover", "carry")], int)


def first_grasp(seed: int) -> int:
    """How many objects the first grasp takes from a fresh pile of five; nothing where the bin ends with it."""
    kinds = tuple(np.random.default_rng(seed).choice(KINDS, size=5).tolist())
    environment = load(seed, kinds=kinds)
    demonstrator = Supervisor(environment)
    demonstrator.reset(seed)
    step = environment.reset()
    for _ in range(KNOWN):
        step = step if step.last() else environment.step(demonstrator.act(step.observation))
    held = 0 if step.last() else len(environment.physics.held())
    environment.close()
    return held


def of_five(held: list[int]) -> dict[str, Any]:
    """Of grasps in a bin of five, how many took something; and of those, how many several."""
    taken = [number for number in held if number]
    return {
        "something": rate(len(taken), len(held)),
        "two": rate(taken.count(2), len(taken)),
        "three": rate(taken.count(3), len(taken)),
        "four or more": rate(sum(number > 3 for number in taken), len(taken)),
    }


def grasps(demos: Demonstrations) -> dict[str, Any]:
    """Of all grasps that were shown, how many took something and exactly one."""
    held = [int(demo.labels["held"][t]) for demo in demos for t in decisions(demo)]
    return {
        "something": rate(sum(number > 0 for number in held), len(held)),
        "exactly one": rate(held.count(1), len(held)),
    }


def left_five(demos: Demonstrations) -> list[int]:
    """How many objects each grasp took that began with five in the bin."""
    shown = [(int(demo.labels["left"][t]), int(demo.labels["held"][t])) for demo in demos for t in decisions(demo)]
    return [held for left, held in shown if left == 5]


def from_observations(demos: Demonstrations) -> dict[str, Any]:
    """How often pixels of the left mask, the shape of the load in it, and that with the jaws' angle say what is held.

    Every bin is predicted from the others.
    """
    pixels, shapes, jaws, held, bins = [], [], [], [], []
    for number, demo in enumerate(demos):
        for t in decisions(demo):
            pixels.append(_where_shown(np.asarray(demo.observations["image"][int(t)])[..., 0]).ravel())
            shapes.append(demo.observations["load"][t])
            jaws.append(demo.observations["kin"][t, 6])
            held.append(_name(demo, t))
            bins.append(number)
    inputs = {
        "the pixels of the left mask": np.array(pixels),
        "the shape of the load": np.array(shapes),
        BEST: np.column_stack([shapes, jaws]),
    }
    return {name: _read(one, held, bins) for name, one in inputs.items()}


def _read(inputs: np.ndarray, held: list[str], bins: list[int]) -> dict[str, Any]:
    trees, names = ExtraTreesClassifier(500, random_state=0), np.unique(held)
    folds = GroupKFold(FOLDS)
    likely = cross_val_predict(trees, inputs, np.array(held), groups=bins, cv=folds, method="predict_proba")
    said = names[np.argmax(likely, axis=1)]
    confused = Counter(zip(held, said.tolist(), strict=True))
    right = sum(count for (truth, guess), count in confused.items() if truth == guess)
    return {
        "accuracy": rate(right, len(held)),
        "told": told(likely[:, np.isin(names, BACK)].sum(axis=1), held),
        "held, said": [[*pair, count] for pair, count in sorted(confused.items())],
    }


def told(back: np.ndarray, held: list[str]) -> dict[str, Any]:
    """Of loads of several and of nothing, how many are told where at most 3 % of single objects are sent back.

    :param back: how likely it is [N] that a load is not a single object.
    """
    loads = np.array(held)
    single = np.sort(back[~np.isin(loads, BACK)])
    bound = single[-1 - int(SENT_BACK * len(single))]
    return {name: rate(int((back[loads == name] > bound).sum()), int((loads == name).sum())) for name in BACK}


def _where_shown(mask: np.ndarray) -> np.ndarray:
    row = round(project(SHOWING)[1] * camera.OBSERVED_SIZE / IMAGE_SIZE)
    return (mask[max(0, row - SHOWN_WITHIN) : row + SHOWN_WITHIN] > 0).astype(np.uint8)


def _name(demo: Demonstration, t: int) -> str:
    kind, held = demo.labels["kind"][t], demo.labels["held"][t]
    return KINDS[kind] if held == 1 else "several" if held else "nothing"


def page(results: dict[str, Any], made_by: str) -> str:
    """The results as Markdown."""
    lines = [made_by, "", f"{results['demonstrations']} bins, {results['steps']} control steps.", ""]
    lines += ["| its grasps took | here | paper |", "|---|---|---|"]
    lines += [f"| {name} | {rates.shown(one)} | {PAPER.get(name, '-')} |" for name, one in results["grasps"].items()]
    fresh, later = results["fresh piles of five"], results["five left in demonstrations"]
    lines += ["", "| with five in the bin | fresh piles | demonstrations | paper |", "|---|---|---|---|"]
    lines += [f"| {name} | {rates.shown(fresh[name])} | {rates.shown(later[name])} | {PAPER[name]} |" for name in fresh]
    lines += ["", "Two, three and more: of the grasps that took something. Wilson 95 % intervals.", ""]
    lines += ["| its bins | here |", "|---|---|"]
    lines += [f"| {name} | {rates.shown(one)} |" for name, one in results["bins"].items() if "rate" in one]
    lines += [f"| {name}, mean | {one['mean']:.2f} |" for name, one in results["bins"].items() if "mean" in one]
    read = results["from observations"]
    for name, one in read.items():
        several, nothing = (rates.shown(one["told"][kind]) for kind in BACK)
        lines += ["", f"What is held, read by trees from {name}: {rates.shown(one['accuracy'])}."]
        lines += [f"With {SENT_BACK:.0%} of single objects sent back: several told in {several}, nothing in {nothing}."]
    lines += ["", f"| held | said of {BEST} | times |", "|---|---|--:|"]
    lines += [f"| {held} | {name} | {count} |" for held, name, count in read[BEST]["held, said"]]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run the study."""
    plan = load_spec(SPEC).demonstrations
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--demonstrations", type=int, default=plan.count)
    parser.add_argument("--out", type=Path, default=Path("docs/results/bin_picking"))
    own = parser.parse_args()
    if own.demonstrations < FOLDS:
        parser.error(f"--demonstrations: {FOLDS} at least, one bin for each fold; got {own.demonstrations}")
    command = f"python studies/bin_picking_supervisor.py --demonstrations {own.demonstrations}"
    made_by = record(command)
    path = collect("bin_picking", plan.model_copy(update={"count": own.demonstrations}))
    demos = Demonstrations.read(path, ["image", "kin", "load"], labels=("phase", "held", "kind", "left"))
    results = {
        "demonstrations": len(demos),
        "steps": sum(demos.lengths),
        "grasps": grasps(demos),
        "fresh piles of five": of_five(Parallel(n_jobs=2)(delayed(first_grasp)(FIRST_PILE + n) for n in range(PILES))),
        "five left in demonstrations": of_five(left_five(demos)),
        "bins": json.loads(str(demos.attributes["supervisor"])),
        "from observations": from_observations(demos),
    }
    shown = page(results, sentence(command, [made_by]))
    write_text(own.out / "supervisor.json", text(results, [made_by]))
    write_text(own.out / "supervisor.md", shown)
    print(shown)


if __name__ == "__main__":
    main()
