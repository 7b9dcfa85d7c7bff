"""What the time lines of a page hold, decoded from the page alone."""

import base64
import html
import json
import re
from itertools import pairwise


def embedded(page):
    """The data of the page's script."""
    (text,) = re.findall(r'<script type="application/json">(.*?)</script>', page, re.DOTALL)
    return json.loads(text)


def tracks(page):
    """Of each demonstration by name: (its ``id``, whether it is marked as held out, lane name → runs).

    A run is (value, first step, step after the last).
    """
    data = embedded(page)
    head = r'class="demonstration" id="([^"]*)"><div class="who">(.*?)\n(.*?)</div>'
    heads = re.findall(head, page, re.DOTALL)
    found = {}
    for (place, name, mark), track in zip(heads, data["tracks"], strict=True):
        assert html.unescape(name) == track["name"]
        lanes = {}
        for lane, runs in zip(data["lanes"], track["lanes"], strict=True):
            ends = pairwise([*runs["s"], track["steps"]]) if runs else ()
            values = zip(runs["v"] if runs else (), ends, strict=True)
            lanes[lane["name"]] = [(value, *ab) for value, ab in values]
        found[track["name"]] = place, "held out" in mark, lanes
    return found


def unpacked(text):
    """Bytes in base64 as numbers."""
    return list(base64.b64decode(text))
