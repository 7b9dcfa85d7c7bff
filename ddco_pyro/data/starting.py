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

GRADIENT_STEPS = 6000
"""A model may take about so many gradient steps in all: about a minute of one core, and enough for a hierarchy and for
the policies beside it to stop by :data:`PATIENCE` on the files of docs/decisions.md."""

EPOCHS = (200, 2000)
"""Fewest and most epochs of a model."""

PATIENCE = 50
"""Epochs without improvement before a stage stops; with 20 flat policies stopped too early (docs/decisions.md)."""


def starting_spec(inspection: Inspection, path: str | Path) -> str:
    """The text of a spec for the inspected demonstrations, commented, with ``path`` as its file.

    Demonstrations that cannot be read are left out, and those with values that cannot be used where they are few; else
    the observations with such values are. What was left out is said in a comment.

    :raises DemonstrationsError: nothing can be fitted to it; the line says why.
    """
    excluded = sorted({*inspection.unreadable, *_few_affected(inspection)}, key=natural)
    if excluded:
        inspection = inspect(inspection.path, exclude=excluded)
    if len(inspection.lengths) < LEAST:
        raise DemonstrationsError(
            f"{inspection.path}: holds {len(inspection.lengths)} demonstrations that can be read, and a fit "
            f"needs {LEAST}: to train, to stop early, and to validate; add some"
        )
    actions = inspection.actions
    wrong = _unusable(inspection, actions) if actions else "is missing"
    if actions is None or wrong:
        raise DemonstrationsError(
            f"{inspection.path}: actions {wrong}; repair them first (ddco-pyro inspect {inspection.path})"
        )
    if all(dimension.constant for dimension in inspection.control):
        raise DemonstrationsError(f"{inspection.path}: {all_constant(inspection.control)}")
    text = "\n".join(_lines(inspection, str(path))) + "\n"
    parse_spec(read_yaml(text))  # what is written can be read
    return text


MOST_EXCLUDED = 0.2
"""Part of the demonstrations that may be left out for the sake of an observation; of more, the observation is."""


def _few_affected(inspection: Inspection) -> list[str]:
    """The demonstrations to leave out so that no key has to be: those with values that cannot be used, if they are few
    and enough are left; a key that is affected in many, or is not in all, is not to be saved.
    """
    most = MOST_EXCLUDED * len(inspection.lengths)
    keys = [field for field in (inspection.actions, *inspection.observations) if field and inspection.everywhere(field)]
    names = {name for field in keys if len(field.affected) <= most for name in field.affected}
    left = [set(inspection.masks[mask]) - names for mask in ("train", "valid") if mask in inspection.masks]
    few = len(names) <= most and len(inspection.lengths) - len(names) >= LEAST and all(left)
    return [name for name in inspection.lengths if name in names] if few else []


def _lines(inspection: Inspection, path: str) -> Iterator[str]:
    lengths = np.array(list(inspection.lengths.values()))
    yield f"# A starting spec for {len(lengths)} demonstrations of {lengths.min()} to {lengths.max()} steps."
    yield "# Fit it:              ddco-pyro fit THIS_FILE --out runs/first"
    yield "# Every key explained: ddco-pyro check --schema"
    yield "demonstrations:"
    yield f"  path: {_text(path)}"
    if inspection.excluded:
        names = ", ".join(map(_text, inspection.excluded))
        yield f"  exclude: [{names}]   # NaN, infinite or huge values, or damaged; where: ddco-pyro inspect"
    yield from _validation(inspection)
    yield from _labels(inspection)
    yield from _observations(inspection)
    yield "control:"
    yield "  kind: auto                        # decided from the demonstrations; so it is:"
    yield from (f"  # {note}" for note in inspection.notes)
    yield "  std: {learn: true, floor: 0.01, per_option: true}   # in units of each dimension's own spread"
    yield "hierarchy:"
    yield "  levels:"
    yield "    - name: option"
    yield "      count: 4                      # how many options; try others: --set hierarchy.levels.0.count=3"
    yield f"      policy: {_smallest(inspection)}   # perceptrons where skills are crooked: {_network(inspection)}"
    yield f"      termination: {_smallest(inspection)}"
    yield f"  meta_policy: {_smallest(inspection)}"
    yield "training:"
    yield "  initialize: vq_controls           # clusters of observations and controls; vq: of observations alone"
    yield "  optimizer: {name: adam, lr: 3.0e-3}"
    batch = _batch(lengths)
    yield f"  epochs: {_epochs(lengths, batch)}                      # of all stages together, at most"
    yield f"  patience: {PATIENCE}                      # a stage stops after so many epochs without improvement"
    yield "  tune_by: median                   # of the tuning demonstrations, which one odd one cannot decide"
    yield f"  batch_size: {batch}                    # demonstrations in a gradient step"
    yield "# Is the hierarchy worth it? Policies without options, trained beside it with the same budget."
    yield "compare_with:"
    yield f"  - {{kind: flat, policy: {_network(inspection)}}}"
    yield f"  - {{kind: flat_equal, policy: {_network(inspection)}}}   # as wide as gives it the hierarchy's parameters"


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


def _validation(inspection: Inspection) -> Iterator[str]:
    used = [name for name in ("train", "valid") if name in inspection.masks]
    if used:
        yield f"  # held out: as mask/{' and mask/'.join(used)} in the file say"
    else:
        number = len(inspection.lengths)
        fraction = max(0.2 if number < MANY else 0.1, (1.5 if number > LEAST else 1) / number)  # one at least
        yield f"  valid_fraction: {fraction:.2g}               # of the demonstrations, held out"
    others = [name for name in inspection.masks if name not in ("train", "valid")]
    if others:
        yield f"  # other masks in the file, not used: {', '.join(others)}"


def _labels(inspection: Inspection) -> Iterator[str]:
    usable = [
        field for field in inspection.labels if np.dtype(field.dtype).kind in "iub" and inspection.everywhere(field)
    ]
    for number, field in enumerate(usable):
        comment = "# compared with the options that are found, never trained on"
        yield f"  {'# ' if number else ''}labels: {_text(field.key)}                  {comment}"


def _observations(inspection: Inspection) -> Iterator[str]:
    vectors, left_out, versions = [], [], inspection.versions
    for field in inspection.observations:
        if field.key in versions.values():
            continue
        reason = _unusable(inspection, field) or _constant(field)
        if reason:
            left_out.append((field, reason))
        elif not field.image:
            vectors.append(field)
    images = [field for field in inspection.observations if field.image and not _unusable(inspection, field)]
    if not vectors and not images:
        raise DemonstrationsError(
            f"{inspection.path}: no observation can be used; see what is wrong with: "
            f"ddco-pyro inspect {inspection.path}"
        )
    yield "observations:                       # standardised; differences: appends x_t - x_(t-1), a velocity"
    for field in vectors:
        moving = "" if field.still else ", differences: true"
        other = versions.get(field.key)
        varied = f", augment: {{versions: {_text(other)}}}" if other else ""
        yield f"  - {{key: {_text(field.key)}{moving}{varied}}}"
    for field in images:
        comment = "# " if vectors else ""
        note = "   # an image: with it, every network has to be network: conv" if vectors else ""
        yield f"  {comment}- {_text(field.key)}{note}"
    for field, reason in left_out:
        yield f"  # - {_text(field.key)}   # {reason}"


def _unusable(inspection: Inspection, field: Field) -> str:
    """Why an array cannot be used; nothing where it can."""
    if not field.numeric:
        return f"holds {field.dtype}, not numbers"
    if field.unusable:
        return f"has {field.unusable}"
    if not inspection.everywhere(field):
        return f"is in {field.demonstrations} of {len(inspection.lengths)} demonstrations"
    if 0 in inspection.lengths.values():
        return "has no steps in some demonstration"
    if field.place == "actions" and (len(field.shape) != 1 or not field.shape[0]):
        return f"has shape {list(field.shape)} at each step, not [dimensions]"
    if len(field.shape) == 3 and not field.image:
        return f"is {field.dtype} of shape {list(field.shape)}: an image has to be uint8"
    if 0 in field.shape:
        return "has no dimensions"
    return ""


def _constant(field: Field) -> str:
    """That an array says nothing, in words; nothing where it does."""
    if len(field.constant) == len(field.minimum):
        return "is constant"
    return "is constant but for rounding" if len(field.constant + field.rounding) == len(field.minimum) else ""


def _only_images(inspection: Inspection) -> bool:
    return all(field.image or _constant(field) for field in inspection.observations if not _unusable(inspection, field))


def _network(inspection: Inspection) -> str:
    return "{network: conv, filters: 8, hidden: [32]}" if _only_images(inspection) else "{network: mlp, hidden: [32]}"


def _smallest(inspection: Inspection) -> str:
    return "{network: conv, filters: 8, hidden: []}" if _only_images(inspection) else "{network: linear}"
