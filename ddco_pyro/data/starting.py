"""The starting spec for a file of demonstrations: ``starting.yaml.j2``, filled from an inspection."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import NamedTuple

import jinja2
import numpy as np

from ddco_pyro.data.controls import all_constant
from ddco_pyro.data.demonstrations import FEW, LEAST, check_division, with_values
from ddco_pyro.data.errors import DemonstrationsError, printable
from ddco_pyro.data.hdf5 import natural
from ddco_pyro.data.inspection import Field, Inspection, inspect
from ddco_pyro.data.labels import BOUNDARY, EXCLUDE
from ddco_pyro.errors import command
from ddco_pyro.spec import EACH, parse_spec
from ddco_pyro.spec.yaml import read_yaml

TEMPLATE = Path(__file__).with_suffix(".yaml.j2")

STARTS = ("vq_controls", "vq", "mixture", "equal_parts")
"""Ways to begin, of which the likeliest in training is kept."""

MARGIN = 0.5
"""Nats per step by which another way has to be likelier than the first."""

MANY = 100
"""From so many demonstrations on a tenth is held out, of fewer a fifth."""

OPTIONS = 4
"""Options where no labels say how many."""

MOST_OPTIONS = 30
"""Labels with more values than that, of each task, do not decide the number of options."""

MOST_EPOCHS = 2000
"""Largest budget of epochs."""

MOST_EXCLUDED = 0.2
"""Largest share of demonstrations that are excluded for the sake of an observation."""

LONGEST = 64
"""Longest side of a picture in pixels, as networks read it."""

SHIFT = 20
"""Pictures are shifted by up to 1 / SHIFT of their longer side."""


EXACT_EPOCHS = 500
"""Fewest epochs where a stage takes exact steps, one over all demonstrations in each epoch."""

VECTORS = (1000, 6000, 200)
"""Steps in a minibatch and gradient steps of a model, about, and its fewest epochs.

About a minute on one core. The hierarchy and the baselines converge on the files of docs/decisions.md; with a
patience of 20, flat policies stopped too early there."""

PICTURES = (250, 4000, 20)
"""The same. About six minutes on one core for each model, with pictures of 48 × 64 pixels."""


HEAVY = "one Student t predicts left-out demonstrations better than Gaussians"


class Decided(NamedTuple):
    """What small fits decide.

    :param power: β of the control's log-density; below 1/2, gates have larger ridges too.
    :param constant: whether gates and terminations are constant.
    :param window: ``training.window``; 0 for none.
    :param why: the length of segments that came of it, in words.
    :param heavy: control dimensions for one Student t.
    :param moved: the observation that is drawn as a path in space; empty for none.
    """

    power: float = 0.5
    constant: bool = False
    window: int = 0
    why: str = (
        "times the control's log-density counts: less makes options last longer, as init --segment 2s does"
    )
    heavy: tuple[int, ...] = ()
    moved: str = ""


class Starting(NamedTuple):
    """The commented YAML text of a spec, and a line for each thing that the demonstrations decided."""

    text: str
    notes: list[str]


def starting_spec(
    inspection: Inspection, path: str | Path, hold_out_by: str | None = None, decided: Decided | None = None
) -> Starting:
    """A spec for the inspected demonstrations, with ``path`` as its file.

    Unreadable and odd demonstrations are excluded, and those of the mask ``exclude``.
    Demonstrations with unusable values are excluded if they are few;
    otherwise the affected observations are left out. Comments say why.

    :param hold_out_by: the attribute of demonstrations whose values are not to be on both sides of the split.
    :raises DemonstrationsError: nothing can be fitted to them, or the attribute cannot divide them.
    """
    facts, reasons = _usable_part(inspection)
    observed, masks = facts.observations, [] if hold_out_by not in (None, EACH) else list(facts.masks)
    used = [field for field in observed if not _left_out(facts, field)]
    vectors, images = ([field for field in used if field.image is image] for image in (False, True))
    if not (vectors or images):
        why = next((f": {field.place} {_left_out(facts, field)}" for field in observed), "")
        look = command("inspect", facts.path)
        raise DemonstrationsError(f"{facts.path}: no observation can be used{why}; see all with: {look}")
    labels = _fullest_first([field for field in facts.labels if not _unusable(facts, field)])
    count, many = _options(facts, labels[0]) if labels else (0, "")
    counted = 1 < count <= MOST_OPTIONS * max(1, len(facts.tasks) * facts.several)
    count, many = (count, many) if counted else (OPTIONS, "")
    apart = _held_out(facts, hold_out_by) if hold_out_by not in (None, EACH) else ""
    lengths, small = list(facts.lengths.values()), decided or Decided()
    batch_steps, gradient_steps, fewest = VECTORS if vectors else PICTURES
    batch = int(np.clip(round(batch_steps / np.mean(lengths)), 1, max(1, len(lengths) // 2)))
    epochs = int(np.clip(round(gradient_steps / np.ceil(len(lengths) / batch), -1), fewest, MOST_EPOCHS))
    em = bool(vectors) and not images
    few = em and len(lengths) < FEW and not {"train", "valid"} & set(masks) and not apart
    text = ENVIRONMENT.from_string(TEMPLATE.read_text(encoding="utf-8")).render(
        facts=facts,
        path=str(path),
        lengths=lengths,
        reasons=reasons,
        by=hold_out_by if apart else None,
        apart=apart,
        each=hold_out_by == EACH or few,
        masks=[name for name in ("train", "valid") if name in masks],
        other_masks=[name for name in masks if name not in ("train", "valid")],
        valid_fraction=_valid_fraction(len(lengths)),
        labels=labels,
        unusable_labels=[(field.key, why) for field in facts.labels if (why := _unusable(facts, field))],
        count=count,
        many=many,
        vectors=vectors,
        images=images,
        tasks=facts.tasks if facts.several and em else {},
        relative=_relative(vectors),
        left_out=[(field, why) for field in observed if (why := _left_out(facts, field))],
        batch=batch,
        small=small,
        starts=("windows", *STARTS) if small.window else STARTS,
        margin=MARGIN,
        em=em,
        epochs=max(epochs, EXACT_EPOCHS if em else 0),
    )
    parse_spec(read_yaml(text))  # the text is a valid spec
    said = [decided.why, "heavy tails: " + HEAVY if decided.heavy else ""] if decided else []
    tasks = f"{len(facts.tasks)} tasks: terminations and the meta-policy see which, policies do not"
    notes = [f"{count} options, {many}" if many else "", tasks if facts.several else "", apart, *said]
    return Starting(text, [note for note in notes if note])


def _usable_part(inspection: Inspection) -> tuple[Inspection, list[str]]:
    """What is left without the excluded demonstrations, and why odd ones are excluded.

    :raises DemonstrationsError: nothing can be fitted to it.
    """
    odd = list(inspection.odd) if _divides(inspection, inspection.odd) else []
    left_out = inspection.masks.get(EXCLUDE, ())
    excluded = sorted({*inspection.unreadable, *_few_affected(inspection), *odd, *left_out}, key=natural)
    reasons = [printable(line) for line in inspection.exclusions if odd]
    if excluded:
        inspection = inspect(inspection.path, exclude=excluded, where=inspection.where)
    actions = inspection.actions
    try:
        check_division(tuple(inspection.lengths), inspection.masks)
        if wrong := _unusable(inspection, actions) if actions else "is missing":
            look = command("inspect", inspection.path)
            raise DemonstrationsError(f"actions {wrong}; repair them first ({look})")
        if all(dimension.constant for dimension in inspection.control):
            raise DemonstrationsError(all_constant(inspection.control))
    except DemonstrationsError as error:
        raise DemonstrationsError(f"{inspection.path}: {error}") from None
    return inspection, reasons


def _options(inspection: Inspection, labels: Field) -> tuple[int, str]:
    """How many options labels ask for, and why. Without names, a number is another label in each task."""
    if not inspection.several or labels.names:
        return len(labels.values), f"as many as the values of {labels.place}"
    return sum(map(len, labels.of_tasks.values())), f"as many as the values of {labels.place} in each task"


HANDS = re.compile(r"(^|_)(hand|eef|ee|tcp|gripper|end_effector)(_|$)")
"""In the name of a position, that of the hand."""


def _relative(vectors: Sequence[Field]) -> list[tuple[str, str]]:
    """Positions and that of the hand, to which they may be relative, by the ends ``_pos`` of their names."""
    positions = {field.key: field.shape for field in vectors if field.key.endswith(("_pos", "_position"))}
    hand = next((key for key in positions if HANDS.search(key)), "")
    return [(key, hand) for key, shape in positions.items() if key != hand and shape == positions.get(hand)]


def _held_out(inspection: Inspection, attribute: str) -> str:
    """What a fit holds out by an attribute of demonstrations, in words.

    :raises DemonstrationsError: the demonstrations cannot be divided by this attribute.
    """
    try:
        found = with_values(attribute, inspection.attributes, _valid_fraction(len(inspection.lengths)), 0)
    except DemonstrationsError as error:
        raise DemonstrationsError(f"{inspection.path}: {error}") from None
    number = f"{sum(map(len, found.values()))} of {len(inspection.lengths)} demonstrations"
    return printable(f"held out: {attribute} {', '.join(found)}, {number}")


def _fullest_first(labels: Sequence[Field]) -> list[Field]:
    """Labels with the fewest unknown steps first, named ones of equals; constant and ``segment``'s last."""
    keys = {field.key for field in labels}

    def rank(field: Field) -> tuple[bool, bool, int, bool]:
        written = field.key.removesuffix(BOUNDARY) + BOUNDARY in keys
        return written, bool(field.constant), field.unknown, not field.names

    return sorted(labels, key=rank)


def _text(value: str) -> str:
    """A string as YAML, quoted where YAML would read something else."""
    plain = re.fullmatch(r"[A-Za-z_/.][\w/.-]*", value) and read_yaml(value) == value
    return value if plain else json.dumps(value)


def _seen(shape: Sequence[int]) -> tuple[list[int] | None, int]:
    """Height and width to which pictures [H, W, C] are scaled, or None; the shift in training, pixels."""
    scale = min(1.0, LONGEST / max(shape[:2]))
    size = [max(1, round(side * scale)) for side in shape[:2]]
    return size if scale < 1 else None, max(size) // SHIFT


ENVIRONMENT = jinja2.Environment(
    undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
)
ENVIRONMENT.filters |= {"yaml": _text, "seen": _seen, "printable": printable}


def _valid_fraction(number: int) -> float:
    least = (1.5 if number > LEAST else 1) / number  # one demonstration
    return float(f"{max(0.2 if number < MANY else 0.1, least):.2g}")


def _few_affected(inspection: Inspection) -> list[str]:
    """The demonstrations to exclude so that no array is left out: those with unusable values, if few.

    An array that is affected in many demonstrations, or absent in some, is left out in any case.
    """
    most = MOST_EXCLUDED * len(inspection.lengths)
    arrays = (inspection.actions, *inspection.observations)
    keys = [field for field in arrays if field and inspection.everywhere(field)]
    names = {name for field in keys if len(field.affected) <= most for name in field.affected}
    fits = len(names) <= most and _divides(inspection, names)
    return [name for name in inspection.lengths if name in names] if fits else []


def _divides(inspection: Inspection, without: Collection[str]) -> bool:
    """Whether enough demonstrations for a fit are left without these."""
    given = inspection.masks.items()
    masks = {mask: [name for name in members if name not in without] for mask, members in given}
    try:
        check_division([name for name in inspection.lengths if name not in without], masks)
    except DemonstrationsError:
        return False
    return True


def _unusable(inspection: Inspection, field: Field) -> str:
    """Why an array cannot be used; empty if it can."""
    if field.unusable:
        return f"has {field.unusable}"
    if not inspection.everywhere(field):
        return f"is in {field.demonstrations} of {len(inspection.lengths)} demonstrations"
    if 0 in inspection.lengths.values():
        return "has no steps in some demonstration"
    return field.problem


def _left_out(inspection: Inspection, field: Field) -> str:
    """Why an observation is left out; empty if it is used."""
    if unusable := _unusable(inspection, field):
        return unusable
    if len(field.constant) == len(field.minimum):
        return "is constant"
    if len(field.constant + field.rounding) == len(field.minimum):
        return "is constant up to rounding"
    return inspection.leaks.get(field.place, "")
