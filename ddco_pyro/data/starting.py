"""A starting spec for a file of demonstrations: everything said, everything commented, and it fits as it is."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ddco_pyro.data.control_dimensions import all_constant
from ddco_pyro.data.hdf5 import DemonstrationsError, natural
from ddco_pyro.data.inspection import Field, Inspection, inspect
from ddco_pyro.spec import parse_spec
from ddco_pyro.spec.reading import read_yaml

MANY = 100
"""Of so many demonstrations a tenth is held out, of fewer a fifth."""

LEAST = 3
"""Demonstrations that a fit needs: to train, to stop early, and to validate."""

STEPS_PER_BATCH = 1000
"""A minibatch has about so many steps: enough for a steady gradient, and several of them in an epoch."""

LINEAR_BELOW = 2000
"""With fewer steps than this in all, options have linear policies: hidden layers fit what will not come again."""

GRADIENT_STEPS = 6000
"""A model may take about so many gradient steps in all: about a minute of one core, and enough for a hierarchy and for
the policies beside it to stop by :data:`PATIENCE` on the files of docs/decisions.md."""

EPOCHS = (200, 2000)
"""Fewest and most epochs of a model."""

PATIENCE = 50
"""Epochs without improvement before a stage stops; with 20 flat policies stopped too early (docs/decisions.md)."""


def starting_spec(found: Inspection, path: str | Path) -> str:
    """The text of a spec for what was found, commented, with ``path`` as its file.

    Demonstrations that cannot be read are left out, and those with values that cannot be used where they are few; else
    the observations with such values are. What was left out is said in a comment.

    :raises DemonstrationsError: nothing can be fitted to it; the line says why.
    """
    excluded = sorted({*found.unreadable, *_few_affected(found)}, key=natural)
    if excluded:
        found = inspect(found.path, exclude=excluded)
    if len(found.lengths) < LEAST:
        raise DemonstrationsError(
            f"{found.path}: holds {len(found.lengths)} demonstrations that can be read, and a fit needs {LEAST}: to "
            "train, to stop early, and to validate; add some"
        )
    actions = found.actions
    wrong = _unusable(found, actions) if actions else "is missing"
    if actions is None or wrong:
        raise DemonstrationsError(f"{found.path}: actions {wrong}; repair them first (ddco-pyro inspect {found.path})")
    if all(one.constant for one in found.control):
        raise DemonstrationsError(f"{found.path}: {all_constant(found.control)}")
    text = "\n".join(_lines(found, str(path))) + "\n"
    parse_spec(read_yaml(text))  # what is written can be read
    return text


MOST_EXCLUDED = 0.2
"""Part of the demonstrations that may be left out for the sake of an observation; of more, the observation is."""


def _few_affected(found: Inspection) -> list[str]:
    """The demonstrations to leave out so that no key has to be: those with values that cannot be used, if they are few
    and enough are left; a key that is affected in many, or is not in all, is not to be saved.
    """
    most = MOST_EXCLUDED * len(found.lengths)
    keys = [one for one in (found.actions, *found.observations) if one and found.everywhere(one)]
    names = {name for one in keys if len(one.affected) <= most for name in one.affected}
    left = [set(found.masks[mask]) - names for mask in ("train", "valid") if mask in found.masks]
    few = len(names) <= most and len(found.lengths) - len(names) >= LEAST and all(left)
    return [name for name in found.lengths if name in names] if few else []


def _lines(found: Inspection, path: str) -> Iterator[str]:
    lengths = np.array(list(found.lengths.values()))
    yield f"# A starting spec for {len(lengths)} demonstrations of {lengths.min()} to {lengths.max()} steps."
    yield "# Fit it:              ddco-pyro fit THIS_FILE --out runs/first"
    yield "# Every key explained: ddco-pyro check --schema"
    yield "demonstrations:"
    yield f"  path: {_text(path)}"
    if found.excluded:
        names = ", ".join(map(_text, found.excluded))
        yield f"  exclude: [{names}]   # NaN, infinite or huge values, or damaged; where: ddco-pyro inspect"
    yield from _validation(found)
    yield from _labels(found)
    yield from _observations(found)
    yield "control:"
    yield "  kind: auto                        # decided from the demonstrations; so it is:"
    yield from (f"  # {note}" for note in found.notes)
    yield "  std: {learn: true, floor: 0.01}   # in units of each dimension's own spread"
    yield "hierarchy:"
    yield "  levels:"
    yield "    - name: option"
    yield "      count: 4                      # how many options; try others: --set hierarchy.levels.0.count=3"
    few = lengths.sum() < LINEAR_BELOW
    yield f"      policy: {_smallest(found) if few else _network(found)}"
    yield f"      termination: {_smallest(found)}"
    yield f"  meta_policy: {_smallest(found)}"
    yield "training:"
    yield "  initialize: vq_controls           # clusters of observations and controls; vq: of observations alone"
    yield "  optimizer: {name: adam, lr: 3.0e-3}"
    batch = _batch(lengths)
    yield f"  epochs: {_epochs(lengths, batch)}                      # of all stages together, at most"
    yield f"  patience: {PATIENCE}                      # a stage stops after so many epochs without improvement"
    yield f"  batch_size: {batch}                    # demonstrations in a gradient step"
    yield "# Is the hierarchy worth it? Policies without options, trained beside it with the same budget."
    yield "compare_with:"
    yield f"  - {{kind: flat, policy: {_network(found)}}}"
    yield f"  - {{kind: flat_equal, policy: {_network(found)}}}   # as wide as gives it the hierarchy's parameters"


def _text(value: str) -> str:
    """A text as YAML, in quotes where it would be read as something else."""
    plain = re.fullmatch(r"[A-Za-z_/.][\w/.-]*", value) and read_yaml(value) == value
    return value if plain else json.dumps(value)


def _batch(lengths: np.ndarray) -> int:
    """Demonstrations in a minibatch: :data:`STEPS_PER_BATCH` steps, but at least two minibatches in an epoch."""
    return int(np.clip(round(STEPS_PER_BATCH / lengths.mean()), 1, max(1, len(lengths) // 2)))


def _epochs(lengths: np.ndarray, batch: int) -> int:
    wanted = GRADIENT_STEPS / np.ceil(len(lengths) / batch)
    return int(np.clip(round(wanted, -1), *EPOCHS))


def _validation(found: Inspection) -> Iterator[str]:
    used = [name for name in ("train", "valid") if name in found.masks]
    if used:
        yield f"  # held out: as mask/{' and mask/'.join(used)} in the file say"
    else:
        number = len(found.lengths)
        fraction = max(0.2 if number < MANY else 0.1, (1.5 if number > LEAST else 1) / number)  # one at least
        yield f"  valid_fraction: {fraction:.2g}               # of the demonstrations, held out"
    others = [name for name in found.masks if name not in ("train", "valid")]
    if others:
        yield f"  # other masks in the file, not used: {', '.join(others)}"


def _labels(found: Inspection) -> Iterator[str]:
    usable = [one for one in found.labels if np.dtype(one.dtype).kind in "iub" and found.everywhere(one)]
    for number, one in enumerate(usable):
        comment = "# compared with the options that are found, never trained on"
        yield f"  {'# ' if number else ''}labels: {_text(one.key)}                  {comment}"


def _observations(found: Inspection) -> Iterator[str]:
    vectors, left_out = [], []
    for one in found.observations:
        reason = _unusable(found, one) or ("is constant" if _constant(one) else "")
        if reason:
            left_out.append((one, reason))
        elif not one.image:
            vectors.append(one)
    images = [one for one in found.observations if one.image and not _unusable(found, one)]
    if not vectors and not images:
        raise DemonstrationsError(
            f"{found.path}: no observation can be used; see what is wrong with: ddco-pyro inspect {found.path}"
        )
    yield "observations:                       # standardised; differences: appends x_t - x_(t-1), a velocity"
    for one in vectors:
        moving = "" if one.still else ", differences: true"
        yield f"  - {{key: {_text(one.key)}{moving}}}"
    for one in images:
        comment = "# " if vectors else ""
        note = "   # an image: with it, every network has to be network: conv" if vectors else ""
        yield f"  {comment}- {_text(one.key)}{note}"
    for one, reason in left_out:
        yield f"  # - {_text(one.key)}   # {reason}"


def _unusable(found: Inspection, one: Field) -> str:
    """Why an array cannot be used; nothing where it can."""
    if not one.numeric:
        return f"holds {one.dtype}, not numbers"
    if one.unusable:
        return f"has {one.unusable}"
    if not found.everywhere(one):
        return f"is in {one.demonstrations} of {len(found.lengths)} demonstrations"
    if 0 in found.lengths.values():
        return "has no steps in some demonstration"
    if one.place == "actions" and (len(one.shape) != 1 or not one.shape[0]):
        return f"has shape {list(one.shape)} at each step, not [dimensions]"
    if len(one.shape) == 3 and not one.image:
        return f"is {one.dtype} of shape {list(one.shape)}: an image has to be uint8"
    if 0 in one.shape:
        return "has no dimensions"
    return ""


def _constant(one: Field) -> bool:
    return len(one.constant) == len(one.minimum)


def _only_images(found: Inspection) -> bool:
    usable = [one for one in found.observations if not _unusable(found, one)]
    return all(one.image or _constant(one) for one in usable)


def _network(found: Inspection) -> str:
    if _only_images(found):
        return "{network: conv, filters: 8, hidden: [32]}"
    return "{network: mlp, hidden: [32]}"


def _smallest(found: Inspection) -> str:
    return "{network: conv, filters: 8, hidden: []}" if _only_images(found) else "{network: linear}"
