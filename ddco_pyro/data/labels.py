"""Labels of demonstrations: the names of their values, and the values with a meaning of their own."""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import TypeAdapter, ValidationError

from ddco_pyro.data.errors import DemonstrationsError

LABEL_NAMES = "label_names"
"""Attribute of a file of demonstrations: JSON, the names of labels 0, 1, ... for each name of labels."""

UNKNOWN = -1
"""The label of a step without ground truth."""

EXCLUDE = "exclude"
"""The mask of demonstrations that a person leaves out; ``init`` excludes them."""

BOUNDARY, SOURCE = "_boundary", "_source"
"""Ends of names of labels beside those of a level: 1 where a segment begins, and who says what a step is."""

SOURCES = ("open", "proposed", "accepted", "given")
"""Who says what a step is: none, as a person left it open; the model; a person who accepts that; a person."""


def label_names(attributes: Mapping[str, object]) -> dict[str, list[str]]:
    """The names of labels 0, 1, ... in the attributes of a file (:data:`LABEL_NAMES`), by name of labels.

    :raises DemonstrationsError: the attribute is something else.
    """
    try:
        return TypeAdapter(dict[str, list[str]]).validate_json(str(attributes.get(LABEL_NAMES, "{}")))
    except ValidationError:
        wrong = 'is no JSON such as {"phase": ["reach", "grasp"]}; correct or remove it'
        raise DemonstrationsError(f"attribute {LABEL_NAMES!r}: {wrong}") from None
