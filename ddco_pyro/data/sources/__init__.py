"""Sources of demonstrations: files and folders of several libraries (:mod:`ddco_pyro.data.formats`), one interface."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from pkgutil import resolve_name
from shlex import quote
from typing import Protocol

import h5py

from ddco_pyro.data.formats import FORMATS
from ddco_pyro.data.hdf5 import Attribute, DemonstrationsError
from ddco_pyro.data.sources.recording import Column, Recording
from ddco_pyro.errors import command, nearest, path_of

__all__ = ["Column", "Recording", "Source", "open_source", "refuse_foreign"]


class Source(Protocol):
    """A set of recordings, open for reading."""

    @property
    def format(self) -> str:
        """The name of its format."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the recordings, in order."""

    @property
    def masks(self) -> Mapping[str, tuple[str, ...]]:
        """Name of each mask (robomimic: filter key) to names of recordings."""

    @property
    def frequency(self) -> float | None:
        """Control steps per second, Hz; None if unknown."""

    @property
    def attributes(self) -> Mapping[str, Attribute]:
        """Facts about the whole source."""

    @property
    def files(self) -> tuple[Path, ...]:
        """The files of the source, whose sizes and times identify its contents."""

    def recording(self, name: str) -> Recording:
        """One recording; its arrays can be read while the source is open."""


@contextmanager
def open_source(path: str | Path, form: str | None = None, actions: Sequence[str] = ()) -> Iterator[Source]:
    """Open a file or folder.

    :param form: its format, of :data:`~ddco_pyro.data.formats.FORMATS`; recognised if None.
    :param actions: names of the arrays that are the control together, where a LeRobot or Minari dataset has several.
    :raises DemonstrationsError: the source cannot be read, or has another format.
    """
    path = path_of(path, "demonstrations")
    form = form or format_of(path)
    if form not in FORMATS:
        known = ", ".join(FORMATS)
        raise DemonstrationsError(f"{path}: there is no format {form!r}{nearest(form, FORMATS)}; there is: {known}")
    if actions and not FORMATS[form].parts:
        several = " or ".join(about.text for about in FORMATS.values() if about.parts)
        raise DemonstrationsError(f"{path}: has the format {form}, with one control; --action is for {several}")
    reader = resolve_name(f"{__name__}.{FORMATS[form].reader}")
    opened = reader(path, actions=actions) if FORMATS[form].parts else reader(path)
    with opened if isinstance(opened, AbstractContextManager) else nullcontext(opened) as source:
        yield source


# --- recognition ------------------------------------------------------------------------------------------------------


def format_of(path: Path) -> str:
    """The format of a file or folder, by its layout.

    :raises DemonstrationsError: nothing is there, the layout is unknown, or it must be converted first.
    """
    if not path.exists():
        raise DemonstrationsError(f"{path}: there is no such file or folder; check the path")
    if not (path.is_file() or path.is_dir()):
        raise DemonstrationsError(f"{path}: is neither a regular file nor a folder; name an HDF5 file")
    names = _top_names(path) if path.is_file() else ()
    if (form := next((form for form, about in FORMATS.items() if about.fits(path, names)), None)) is not None:
        return form
    roots = [path, *(one for one in path.iterdir() if one.is_dir())]
    lines = "write its episodes into an HDF5 file as data/demo_0, data/demo_1, ... with the lines in docs/own.md"
    if any((root / name).exists() for root in roots for name in (".zgroup", "zarr.json")):
        raise DemonstrationsError(f"{path}: is a zarr store, as diffusion policy writes them; {lines}")
    if any((root / "dataset_info.json").exists() and (root / "features.json").exists() for root in roots):
        raise DemonstrationsError(f"{path}: is a TensorFlow dataset (RLDS); {lines}")
    folders = ", ".join(f"{about.text} (with {about.sign})" for about in FORMATS.values() if about.sign)
    raise DemonstrationsError(f"{path}: is a folder of no known format; name an HDF5 file, or {folders}")


def refuse_foreign(path: Path) -> None:
    """Refuse a dataset of another library, which is to be imported first.

    :raises DemonstrationsError: it is one, nothing is there, or the layout is unknown.
    """
    if (form := format_of(path)) != "robomimic":
        first = command("import", path, "--out", "demos.hdf5")
        raise DemonstrationsError(f"{path}: has the format {form}; first: {first}")


def _top_names(path: Path) -> frozenset[str]:
    """The names at the top of an HDF5 file; none of another file."""
    try:
        with h5py.File(path, "r") as file:
            names = frozenset(file)
            prepared = "env_args" in file["data"].attrs if _has_states_only(file.get("data")) else None
    except (OSError, RuntimeError, ValueError, KeyError):
        return frozenset()
    if prepared is not None:
        scripts, name = "python -m robomimic.scripts", quote(str(path))
        before = "" if prepared else f"{scripts}.conversion.convert_robosuite --dataset {name} && "
        raise DemonstrationsError(
            f"{path}: has states of robosuite's simulator and no observations; robomimic makes them: {before}"
            f"{scripts}.dataset_states_to_obs --dataset {name} --output_name low_dim.hdf5"
        )
    return names


def _has_states_only(data: object) -> bool:
    """Whether the first demonstration in a group has simulator states and no observations."""
    if not isinstance(data, h5py.Group):
        return False
    first = next((name for name in data if data.get(name, getclass=True) is h5py.Group), None)
    return first is not None and "states" in data[first] and "obs" not in data[first]
