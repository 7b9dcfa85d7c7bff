"""What a starting spec says where pictures are all that is observed, as ``specs/pushing_image_ff.yaml`` has it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

LONGEST = 64
"""Pixels of a picture's longer side, at most, as networks see it."""

SHIFT = 20
"""Pictures are moved by up to one part in so many of their longer side."""

EYE = (
    "{network: conv, layers: [{filters: 16, kernel: 5, stride: 2, padding: 2}, "
    "&half {filters: 32, kernel: 3, stride: 2, padding: 1}, *half], pool: flatten, hidden: [128], standardize: true, "
    "activation: leaky_relu}"
)


def seen(key: str, shape: Sequence[int]) -> str:
    """The line of an observation.

    :param key: as YAML has it.
    :param shape: height, width and channels.
    """
    height, width = shape[:2]
    longer = max(height, width)
    scale = min(1.0, LONGEST / longer)
    small = [max(1, round(side * scale)) for side in (height, width)]
    resize = f", resize: {small}" if scale < 1 else ""
    shift = max(small) // SHIFT
    moved = f", augment: {{shift: {shift}}}" if shift else ""
    return f"  - {{key: {key}{resize}{moved}}}"


def sight(keys: Sequence[str]) -> Iterator[str]:
    """The lines of the network that sees, for the whole hierarchy.

    :param keys: of the pictures, as YAML has them.
    """
    yield "  trunk: &sight                     # sees for options, terminations and meta-policy; every step trains it"
    yield "    network: branches"
    yield "    of:"
    for number, key in enumerate(keys):
        yield f"      {key}: {'*eye' if number else '&eye ' + EYE}"
    yield "    hidden: [1024]"
    yield "    activation: leaky_relu"
