"""What sessions of labelling show, and the truth as a person says it."""

import time
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np

PATIENCE = 20
"""Seconds that another process, or the page, has for what is expected."""

POOL = ThreadPoolExecutor()


def until(holds):
    """Wait until something holds."""
    end = time.monotonic() + PATIENCE
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.01)


def here(background, call):
    """Have a call of the page made by this process."""
    return POOL.submit(call)


def refitted(session):
    """What is said of refits once nothing is under way."""
    while (known := session.progress())["refit"]["running"] or known["behind"]:
        time.sleep(0.01)
    return known["refit"]


def accept(session, index):
    """Accept what is shown of a demonstration."""
    seen = [[own["start"], own["option"]] for own in session.demo(index)["segments"]]
    return session.edit({"do": "accept", "demo": index, "segments": seen})


def paint(session, demo, start, stop, option):
    return session.edit({"do": "paint", "demo": demo, "start": start, "stop": stop, "option": option})


def stretches(truth):
    """Each stretch of equal labels as (first step, step after the last, option)."""
    edges = [0, *(np.flatnonzero(np.diff(truth)) + 1).tolist(), len(truth)]
    return [(start, stop, int(truth[start]) + 1) for start, stop in pairwise(edges)]


def label(session, index, truth):
    """Say the truth of a demonstration."""
    for stretch in stretches(truth):
        paint(session, index, *stretch)
