"""A starting spec for a file of demonstrations: everything said, everything commented, and it fits as it is."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ddco_pyro.data.checks import LEAST, check_division
from ddco_pyro.data.control_dimensions import all_constant
from ddco_pyro.data.hdf5 import DemonstrationsError, natural, printable
from ddco_pyro.data.inspection import Field, Inspection, inspect
from ddco_pyro.data.starting_pictures import seen, sight
from ddco_pyro.errors import command
from ddco_pyro.spec import parse_spec
from ddco_pyro.spec.yaml import read_yaml

MANY = 100
"""Of so many demonstrations a tenth is held out, of fewer a fifth."""

MOST_EPOCHS = 2000
"""Of a model."""

PERCEPTRON = "{network: mlp, hidden: [32]}"


class Recipe(NamedTuple):
    """What ``training`` says.

    :param batch_steps: a minibatch has about so many steps: enough for a steady gradient, and several in an epoch.
    :param gradient_steps: a model may take about so many in all.
    :param epochs: a model may take so many at least.
    """

    batch_steps: int
    gradient_steps: int
    epochs: int
    initialize: str
    layerwise: str
    optimizer: str
    patience: str


VECTORS = Recipe(
    batch_steps=1000,
    gradient_steps=6000,
    epochs=200,
    initialize="vq_controls           # clusters of observations and controls; vq: of observations alone",
    layerwise="true                   # options first, then the meta-policy, then everything together",
    optimizer="{name: adam, lr: 3.0e-3}",
    patience="50                      # a stage stops after so many epochs without improvement",
)
"""About a minute of one core, and enough for a hierarchy and for the policies beside it to stop on the files of
docs/decisions.md; with a patience of 20 flat policies stopped too early there."""

PICTURES = Recipe(
    batch_steps=250,
    gradient_steps=4000,
    epochs=20,
    initialize="equal_parts           # of each demonstration, one for each option",
    layerwise="false                  # then everything together",
    optimizer="{name: adam, lr: 1.0e-3, schedule: cosine}",
    patience="null                    # the learning rate falls to the end",
)
"""Of pictures of 48 x 64 pixels some six minutes of one core for each model."""


def starting_spec(inspection: Inspection, path: str | Path) -> str:
    """The text of a spec for the inspected demonstrations, commented, with ``path`` as its file.

    Demonstrations that cannot be read are left out, and those with values that cannot be used where they are few; else
    the observations with such values are. What was left out is said in a comment.

    :raises DemonstrationsError: nothing can be fitted to it; the line says why.
    """
    excluded = sorted({*inspection.unreadable, *_few_affected(inspection)}, key=natural)
    if excluded:
        inspection = inspect(inspection.path, exclude=excluded)
    try:
        check_division(tuple(inspection.lengths), inspection.masks)
    except DemonstrationsError as error:
        raise DemonstrationsError(f"{inspection.path}: {error}") from None
    actions = inspection.actions
    wrong = _unusable(inspection, actions) if actions else "is missing"
    if actions is None or wrong:
        raise DemonstrationsError(
            f"{inspection.path}: actions {wrong}; repair them first ({command('inspect', inspection.path)})"
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
    masks = {mask: [name for name in members if name not in names] for mask, members in inspection.masks.items()}
    try:
        check_division([name for name in inspection.lengths if name not in names], masks)
    except DemonstrationsError:
        return []
    return [name for name in inspection.lengths if name in names] if len(names) <= most else []


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
    yield from (f"  # {printable(note)}" for note in inspection.notes)
    yield "  std: {learn: true, floor: 0.01, per_option: true}   # in units of each dimension's own spread"
    pictures = [_text(field.key) for field in _images(inspection)] if _only_images(inspection) else []
    yield "hierarchy:"
    yield from sight(pictures) if pictures else ()
    yield "  levels:"
    yield "    - name: option"
    yield "      count: 4                      # how many options; try others: --set hierarchy.levels.0.count=3"
    crooked = "" if pictures else f"   # perceptrons where skills are crooked: {PERCEPTRON}"
    yield f"      policy: {{network: linear}}{crooked}"
    yield "      termination: {network: linear}"
    yield "  meta_policy: {network: linear}"
    yield "training:"
    yield from _training(lengths, PICTURES if pictures else VECTORS)
    yield "# Is the hierarchy worth it? Other models, trained beside it with the same budget."
    yield "compare_with:"
    yield "  - mixture                         # the same policies, chosen anew at every step: is lasting worth it?"
    network = "*sight" if pictures else PERCEPTRON
    if not pictures:  # the network that all read is nearly all of the hierarchy
        yield f"  - {{kind: flat, policy: {network}}}"
    yield f"  - {{kind: flat_equal, policy: {network}}}   # as wide as gives it the hierarchy's parameters"


def _training(lengths: np.ndarray, recipe: Recipe) -> Iterator[str]:
    batch = _batch(lengths, recipe)
    epochs = _epochs(lengths, batch, recipe)
    yield f"  initialize: {recipe.initialize}"
    yield f"  layerwise: {recipe.layerwise}"
    yield f"  optimizer: {recipe.optimizer}"
    yield f"  epochs: {epochs}                      # of all stages together, at most"
    yield f"  patience: {recipe.patience}"
    yield "  tune_by: median                   # of the tuning demonstrations, which one odd one cannot decide"
    yield f"  batch_size: {batch}                    # demonstrations in a gradient step"


def _text(value: str) -> str:
    """A text as YAML, in quotes where it would be read as something else."""
    plain = re.fullmatch(r"[A-Za-z_/.][\w/.-]*", value) and read_yaml(value) == value
    return value if plain else json.dumps(value)


def _batch(lengths: np.ndarray, recipe: Recipe) -> int:
    """Demonstrations in a minibatch: as many steps as the recipe says, and at least two minibatches in an epoch."""
    return int(np.clip(round(recipe.batch_steps / lengths.mean()), 1, max(1, len(lengths) // 2)))


def _epochs(lengths: np.ndarray, batch: int, recipe: Recipe) -> int:
    wanted = recipe.gradient_steps / np.ceil(len(lengths) / batch)
    return int(np.clip(round(wanted, -1), recipe.epochs, MOST_EPOCHS))


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
    reasons = {field.key: _unusable(inspection, field) for field in inspection.labels}
    for number, key in enumerate(key for key, reason in reasons.items() if not reason):
        comment = "# compared with the options that are found, never trained on"
        yield f"  {'# ' if number else ''}labels: {_text(key)}                  {comment}"
    yield from (f"  # labels: {_text(key)}   # {reason}" for key, reason in reasons.items() if reason)


def _observations(inspection: Inspection) -> Iterator[str]:
    vectors, left_out, versions = [], [], inspection.versions
    for field in inspection.observations:
        if field.key in versions.values():
            continue
        reason = _left_out(inspection, field)
        if reason:
            left_out.append((field, reason))
        elif not field.image:
            vectors.append(field)
    images = _images(inspection)
    if not vectors and not images:
        raise DemonstrationsError(
            f"{inspection.path}: no observation can be used; see what is wrong with: "
            f"{command('inspect', inspection.path)}"
        )
    yield "observations:                       # standardised; differences: appends x_t - x_(t-1), a velocity"
    for field in vectors:
        moving = "" if field.still else ", differences: true"
        other = versions.get(field.key)
        varied = f", augment: {{versions: {_text(other)}}}" if other else ""
        yield f"  - {{key: {_text(field.key)}{moving}{varied}}}"
    for field in images:
        if vectors:
            yield f"  # - {_text(field.key)}   # an image: networks that read it beside vectors are network: branches"
        else:
            yield seen(_text(field.key), field.shape)
    for field, reason in left_out:
        yield f"  # - {_text(field.key)}   # {reason}"


def _unusable(inspection: Inspection, field: Field) -> str:
    """Why an array cannot be used; nothing where it can."""
    if not field.numeric and not field.place.startswith("labels/"):
        return f"holds {field.dtype}, not numbers"
    if field.unusable:
        return f"has {field.unusable}"
    if not inspection.everywhere(field):
        return f"is in {field.demonstrations} of {len(inspection.lengths)} demonstrations"
    if 0 in inspection.lengths.values():
        return "has no steps in some demonstration"
    return field.problem or ("has no dimensions" if 0 in field.shape else "")


def _left_out(inspection: Inspection, field: Field) -> str:
    """Why an observation is left out; nothing where it is not."""
    leak = "is the control that a policy has to predict" if field.place in inspection.leaks else ""
    return _unusable(inspection, field) or _constant(field) or leak


def _constant(field: Field) -> str:
    """That an array says nothing, in words; nothing where it does."""
    if len(field.constant) == len(field.minimum):
        return "is constant"
    return "is constant but for rounding" if len(field.constant + field.rounding) == len(field.minimum) else ""


def _images(inspection: Inspection) -> list[Field]:
    return [field for field in inspection.observations if field.image and not _left_out(inspection, field)]


def _only_images(inspection: Inspection) -> bool:
    return all(field.image for field in inspection.observations if not _left_out(inspection, field))
