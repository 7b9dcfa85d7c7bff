"""HDF5 files of which parts are elsewhere, missing, or only claimed, and specs that are no small files."""

import os
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import h5py
import numpy as np

from odd_files import Row

STEPS = 12


def demonstrations(path: Path, number: int = 6) -> h5py.File:
    """An ordinary file of what the toy task observes, open for changes."""
    random = np.random.default_rng(0)
    file = h5py.File(path, "w")
    for index in range(number):
        group = file.create_group(f"data/demo_{index}")
        group["obs/offsets"] = random.normal(size=(STEPS, 4))
        group["obs/visited"] = random.normal(size=(STEPS, 1))
        group["actions"] = random.normal(size=(STEPS, 2))
    return file


def changed(change: Callable[..., None], *given: object, **named: object) -> Callable[[Path], Path]:
    """Writes such a file, with something odd about ``demo_1``: a change of (group, folder, the given)."""

    def make(folder: Path) -> Path:
        path = folder / "demos.hdf5"
        with demonstrations(path) as file:
            change(file["data/demo_1"], folder, *given, **named)
        return path

    return make


def instead(group: h5py.Group, key: str, item: object) -> None:
    del group[key]
    group[key] = item


def spoil(path: Path, place: str, chunk: int = 0) -> None:
    """Flip a bit of a chunk that is stored."""
    with h5py.File(path) as file:
        at = file[place].id.get_chunk_info(chunk).byte_offset + 8
    content = bytearray(path.read_bytes())
    content[at] ^= 1
    path.write_bytes(content)


# --- parts elsewhere ----------------------------------------------------------------------------------------


def raw(group: h5py.Group, folder: Path) -> None:
    """Controls in a raw file."""
    (folder / "actions.raw").write_bytes(group["actions"][:].tobytes())
    del group["actions"]
    place = [(str(folder / "actions.raw"), 0, STEPS * 2 * 8)]
    group.create_dataset("actions", (STEPS, 2), "f8", external=place)


def linked(group: h5py.Group, folder: Path, place: str, key: str) -> None:
    demonstrations(folder / "other.hdf5").close()
    instead(group.file, key, h5py.ExternalLink("other.hdf5", place))


def virtual(group: h5py.Group, folder: Path) -> None:
    """An observation that is that of another file."""
    layout = h5py.VirtualLayout((STEPS, 4), "f8")
    layout[:] = h5py.VirtualSource("other.hdf5", "x", (STEPS, 4))
    with h5py.File(folder / "other.hdf5", "w") as file:
        file["x"] = group["obs/offsets"][:]
    del group["obs/offsets"]
    group.create_virtual_dataset("obs/offsets", layout)


def soft(group: h5py.Group, folder: Path, key: str, target: str) -> None:
    instead(group.file, key, h5py.SoftLink(target))


def twice(group: h5py.Group, folder: Path) -> None:
    instead(group, "obs/offsets", group.file["data/demo_0/obs/offsets"])


def circle(group: h5py.Group, folder: Path) -> None:
    group["obs/again"] = group["obs"]


# --- what is claimed ----------------------------------------------------------------------------------------


def rows_claimed(group: h5py.Group, folder: Path) -> None:
    """Arrays of 1e12 steps of which one chunk is stored."""
    for key, size in (("actions", 2), ("obs/offsets", 4), ("obs/visited", 1)):
        del group[key]
        dataset = group.create_dataset(key, (10**12, size), "f8", chunks=(10**4, size), compression="gzip")
        dataset.id.write_direct_chunk((0, 0), zlib.compress(bytes(8 * size * 10**4)))


def chunk_missing(group: h5py.Group, folder: Path) -> None:
    """Chunks of which one was never written, though the others, padded, are as large as the array."""
    del group["obs/offsets"]
    dataset = group.create_dataset("obs/offsets", (STEPS, 4), "f8", chunks=(STEPS - 1, 3))
    dataset[: STEPS - 1] = 1.0


# --- specs --------------------------------------------------------------------------------------------------


def pipe(folder: Path, name: str = "spec.yaml") -> Path:
    os.mkfifo(folder / name)
    return folder / name


def endless(folder: Path) -> Path:
    (folder / "spec.yaml").symlink_to("/dev/zero")
    return folder / "spec.yaml"


def text(content: str) -> Callable[[Path], Path]:
    """A spec; PIPE in it is the path of a pipe."""

    def make(folder: Path) -> Path:
        (folder / "spec.yaml").write_text(content.replace("PIPE", str(pipe(folder, "pipe"))))
        return folder / "spec.yaml"

    return make


SPEC = "demonstrations: {{path: {}}}\nobservations: [x]\nbaseline: {{kind: flat}}\n"
REPACK = r"{}, which is not read; .*: h5repack --merge -l CONTI \S+ whole.hdf5"
LINK = REPACK.format(r"demo_1.* is a link to {}")

PLACE, CLAIMS = "/data/demo_0/obs/offsets", "demo_1: {} claims {} chunks, but the file holds {}"
ROWS: dict[str, Row] = {
    "ordinary": Row(changed(lambda *_: None), None),
    "external storage": Row(changed(raw), REPACK.format("demo_1: actions is stored in another file")),
    "virtual": Row(changed(virtual), REPACK.format("demo_1: obs/offsets is virtual")),
    "external link to an array": Row(changed(linked, PLACE, "data/demo_1/obs/offsets"), LINK.format(PLACE)),
    "external link to a demonstration": Row(
        changed(linked, "/data/demo_0", "data/demo_1"), LINK.format("/data/demo_0")
    ),
    "dangling link": Row(changed(soft, "data/demo_1", "demo_9"), LINK.format("demo_9")),
    "hard link": Row(changed(twice), None),
    "a group in itself": Row(changed(circle), "demo_1: obs/again: its groups go in a circle"),
    "1e12 rows": Row(changed(rows_claimed), CLAIMS.format("actions", 100000000, 1) + "; write"),
    "a chunk missing": Row(changed(chunk_missing), CLAIMS.format("obs/offsets", 4, 2)),
    "a pipe": Row(partial(pipe, name="demos.hdf5"), r"is neither a regular file nor a folder"),
    "spec: a device": Row(endless, r"is no file of at most 256 kB"),
    "spec: large": Row(text("a: [" + "1, " * 500_000 + "]"), r"is no file of at most 256 kB"),
    "spec: of a pipe": Row(text(SPEC.format("PIPE")), r"is no regular file"),
    "spec: of a device": Row(text(SPEC.format("/dev/zero")), r"is no regular file"),
}
