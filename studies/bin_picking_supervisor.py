"""The demonstrator of bin picking: how many objects its grasps take, how its bins end, and what a picture tells.

    python studies/bin_picking_supervisor.py [--bins 200] [--jobs 2]

Plays bins as they are demonstrated, on seeds of their own. What is held at the moment of decision is also read from the
observed masks alone, by a classifier trained on half of the bins and tested on the other half: that bounds what a policy
can know. Writes ``docs/results/bin_picking/supervisor.json`` and ``.md``.
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from ddco_tasks.bin_picking import task
from ddco_tasks.bin_picking.supervisor import SHOWN
from joblib import Parallel, delayed
from provenance import record, sentence, text
from sklearn.ensemble import ExtraTreesClassifier

from ddco_pyro.data.files import write_text
from ddco_pyro.simulation.episodes import rate, summarize

OUT = Path("docs/results/bin_picking")
FIRST = 330_000
"""Seed of the first bin."""
PAPER = {"at least one": "94 %", "five in the bin: two": "32 %", "five in the bin: three": "14 %",
         "five in the bin: four or more": "0.5 %"}  # fmt: skip


def play(seed: int, policy: str = "supervisor") -> dict[str, Any]:
    """One bin: its measures, [before, lifted] of each attempt, and the masks at each decision with what was held."""
    environment = task.load(seed)
    actor = task.policies[policy](environment)
    actor.reset(seed)
    step, masks, held = environment.reset(), [], []
    while not step.last():
        action = actor.act(step.observation)
        if environment.task.trials.steps == SHOWN:
            masks.append(np.packbits(step.observation["image"]))
            held.append(_named(environment))
        step = environment.step(action)
    attempts = [(attempt.before, len(attempt.lifted)) for attempt in environment.task.trials.attempts]
    found = {"outcome": task.measured(environment), "attempts": attempts, "masks": masks, "held": held}
    environment.close()
    return found


def _named(environment: Any) -> str:
    """What is held: a kind, ``nothing`` or ``several``."""
    held = environment.physics.held()
    return environment.task.trials.kinds[min(held)] if len(held) == 1 else "several" if held else "nothing"


def grasps(bins: list[dict[str, Any]]) -> dict[str, Any]:
    """Of all grasps, those that took something; of those that did with five in the bin, how many took two and more."""
    attempts = [attempt for one in bins for attempt in one["attempts"]]
    five = [lifted for before, lifted in attempts if before == 5 and lifted]
    return {
        "at least one": rate(sum(lifted > 0 for _, lifted in attempts), len(attempts)),
        "exactly one": rate(sum(lifted == 1 for _, lifted in attempts), len(attempts)),
        "five in the bin: two": rate(five.count(2), len(five)),
        "five in the bin: three": rate(five.count(3), len(five)),
        "five in the bin: four or more": rate(sum(lifted > 3 for lifted in five), len(five)),
    }


def from_pictures(bins: list[dict[str, Any]]) -> dict[str, Any]:
    """How often the masks alone say what is held; the second half of the bins is tested."""
    halves = [bins[: len(bins) // 2], bins[len(bins) // 2 :]]
    inputs, labels = zip(*(_pictures(half) for half in halves), strict=True)
    said = ExtraTreesClassifier(500, random_state=0).fit(inputs[0], labels[0]).predict(inputs[1])
    right, confused = said == labels[1], Counter(zip(labels[1].tolist(), said.tolist(), strict=True))
    kinds = sorted(set(labels[1].tolist()))
    return {
        "accuracy": rate(int(right.sum()), len(right)),
        "held, said": [[held, said, confused[held, said]] for held in kinds for said in kinds],
    }


def _pictures(bins: list[dict[str, Any]]) -> tuple[np.ndarray, np.ndarray]:
    masks = [np.unpackbits(mask) for one in bins for mask in one["masks"]]
    return np.array(masks), np.array([held for one in bins for held in one["held"]])


def page(results: dict[str, Any], made_by: str) -> str:
    """The results as Markdown."""
    lines = [made_by, "", "| of its grasps | here | paper |", "|---|---|---|"]
    lines += [f"| {name} | {said(one)} | {PAPER.get(name, '-')} |" for name, one in results["grasps"].items()]
    lines += ["", "Those with five in the bin are shares of the grasps that took something. Intervals are Wilson 95 %.", ""]
    lines += ["| of its bins | here |", "|---|---|"]
    lines += [f"| {name} | {said(one)} |" for name, one in results["bins"].items() if "rate" in one]
    lines += [f"| {name}, mean | {one['mean']:.2f} |" for name, one in results["bins"].items() if "mean" in one]
    pictures = results["from pictures"]
    lines += ["", f"What is held, read from the observed masks by trees over pixels: {said(pictures['accuracy'])}.", ""]
    lines += ["| held | said | times |", "|---|---|--:|"]
    lines += [f"| {held} | {name} | {count} |" for held, name, count in pictures["held, said"] if count]
    return "\n".join(lines) + "\n"


def said(one: dict[str, Any]) -> str:
    """A rate with its counts and interval."""
    if not one["trials"]:
        return "-"
    low, high = one["interval"]
    return f"{one['rate']:.1%} ({one['successes']} of {one['trials']}; {low:.1%} to {high:.1%})"


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bins", type=int, default=200)
    parser.add_argument("--jobs", type=int, default=2)
    arguments = parser.parse_args()
    command = f"python studies/bin_picking_supervisor.py --bins {arguments.bins}"
    made_by = record(command)
    bins = Parallel(n_jobs=arguments.jobs)(delayed(play)(FIRST + number) for number in range(arguments.bins))
    results = {
        "grasps": grasps(bins),
        "bins": summarize(task, [one["outcome"] for one in bins]),
        "from pictures": from_pictures(bins),
    }
    shown = page(results, sentence(command, [made_by]))
    write_text(OUT / "supervisor.json", text(results, [made_by]))
    write_text(OUT / "supervisor.md", shown)
    print(shown)


if __name__ == "__main__":
    main()
