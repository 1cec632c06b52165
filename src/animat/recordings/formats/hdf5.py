"""Reads untrusted HDF5 files so that a damaged or hostile one causes an error and nothing else."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from animat.errors import InvalidArgument, InvalidFile, UnusableData, first_line, some_of

Column = np.ndarray[Any, Any]

SOFT_LINKS = 16
"""Most links followed in a row; more are circular."""
SPARE_VALUES = 1_000_000
"""Values that any file may hold, however small it is; each one beyond them must take at least a byte."""
LARGEST_VALUES = 200_000_000
LARGEST_ITEM_BYTES = 2**16
LARGEST_CHUNK_BYTES = 2**28
DAMAGE = (OSError, RuntimeError, LookupError, ValueError, TypeError, ArithmeticError, MemoryError, AttributeError)
"""Errors that h5py and numpy raise on damaged files."""


class Hdf5File:
    """An open file in which every access is checked.

    Nothing is unpickled, no other file is opened, and data that claims to be larger than the file can hold is refused
    before memory is allocated. Links inside the file are followed, as MaxWell's files need them.
    """

    def __init__(self, path: Path, file: h5py.File) -> None:
        self.path, self.file = path, file
        self._bytes = path.stat().st_size

    def node(self, where: str) -> h5py.Group | h5py.Dataset | None:
        """The group or dataset at a path, None if there is none; refuses links to other files, and circular ones."""
        parts = deque(part for part in where.split("/") if part)
        node: Any = self.file["/"]
        hops = 0
        while parts:
            name = parts.popleft()
            if not isinstance(node, h5py.Group):
                return None
            link = node.get(name, getlink=True)
            if link is None:
                return None
            if isinstance(link, h5py.ExternalLink):
                link = f"{where} is a link to another file, which is never followed; copy all data into one file"
                raise InvalidFile(f"{self.path}: expected data in the file itself, but {link}")
            if isinstance(link, h5py.SoftLink):
                hops += 1
                if hops > SOFT_LINKS:
                    raise InvalidFile(f"{self.path}: expected data at {where}, got circular links")
                if link.path.startswith("/"):
                    node = self.file["/"]
                parts.extendleft(reversed([part for part in link.path.split("/") if part]))
                continue
            # The link exists: if its target cannot be opened, it is damaged, not missing.
            node = node[name]
        return node if isinstance(node, h5py.Group | h5py.Dataset) else None

    def names(self, where: str) -> list[str]:
        """Names of a group's members, in alphabetical order; empty if there is no group."""
        node = self.node(where)
        return sorted(node) if isinstance(node, h5py.Group) else []

    def own_names(self, where: str) -> list[str]:
        """As `names`, without what is linked from other files."""
        group: Any = self.node(where)
        return [name for name in self.names(where) if not isinstance(group.get(name, getlink=True), h5py.ExternalLink)]

    def has(self, where: str) -> bool:
        """Whether there is a group or dataset at a path."""
        return self.node(where) is not None

    def fields(self, where: str) -> tuple[str, ...]:
        """Names of a table's columns; empty for other datasets, or if there is none."""
        node = self.node(where)
        return tuple(node.dtype.names or ()) if isinstance(node, h5py.Dataset) else ()

    def dataset(self, where: str) -> h5py.Dataset:
        """A dataset; refused if there is none, it holds no values, or they are in other files or in absurd chunks."""
        node = self.node(where)
        if not isinstance(node, h5py.Dataset):
            raise InvalidFile(f"{self.path}: expected a dataset at {where}, found {'a group' if node else 'nothing'}")
        created = node.id.get_create_plist()
        if created.get_external_count() > 0 or created.get_layout() == h5py.h5d.VIRTUAL:
            what = "they are in other files, which are never opened; copy all data into one file"
            raise InvalidFile(f"{self.path}: expected the values of {where} in the file itself, but {what}")
        if node.shape is None:
            raise InvalidFile(f"{self.path}: expected values at {where}, got an empty dataspace")
        # HDF5 reads whole chunks, and raw traces are read in the program's own process.
        if math.prod(node.chunks or ()) * node.dtype.itemsize > LARGEST_CHUNK_BYTES:
            raise InvalidFile(f"{self.path}: {where} is stored in chunks of an absurd size: the file is damaged")
        return node

    def read(self, where: str, field: str | None = None) -> Column:
        """All values of a dataset, or of one column of a table: numbers, or text as `str`; others are refused."""
        dataset = self.dataset(where)
        dtype = dataset.dtype
        name = where if field is None else f"{where}/{field}"
        if field is not None:
            if dtype.names is None or field not in dtype.names:
                raise InvalidFile(f"{self.path}: expected a column {field} in {where}, found {dtype.names or dtype}")
            dtype = dtype[field]
        text = h5py.check_string_dtype(dtype) is not None
        if not text and (dtype.kind not in "iufb" or dtype.shape):
            raise InvalidFile(f"{self.path}: expected numbers or text at {name}, got {dtype}")
        n_values = math.prod(dataset.shape)
        filtered = dataset.id.get_create_plist().get_nfilters() > 0
        possible = SPARE_VALUES + (self._bytes if filtered else self._bytes // max(dtype.itemsize, 1))
        if n_values > min(possible, LARGEST_VALUES) or n_values * dtype.itemsize > 8 * LARGEST_VALUES:
            claim = f"{n_values:,} values, more than a file of {self._bytes:,} bytes can hold"
            raise InvalidFile(f"{self.path}: {name} claims {claim}: it is damaged, or not a recording")
        if missing := unavailable_filters(dataset):
            raise InvalidFile(f"{self.path}: {name} is compressed by {missing}: {PLUGIN_ADVICE}")
        values = np.asarray(dataset[()] if field is None else dataset.fields(field)[()])
        return _as_text(values) if text else values

    def columns(self, where: str, *fields: str) -> list[Column]:
        """Some columns of a table; see `read`."""
        return [self.read(where, field) for field in fields]

    def first(self, where: str) -> Any:
        """The first value of a dataset, a number or text; None if there is no such dataset or it is empty."""
        if not isinstance(self.node(where), h5py.Dataset):
            return None
        values = self.read(where).reshape(-1)
        return values[0].item() if len(values) else None

    def ends(self, where: str) -> tuple[int, int, int] | None:
        """First value, last value and length of a dataset of whole numbers; None if there is none."""
        node = self.node(where)
        if not isinstance(node, h5py.Dataset) or node.ndim != 1 or not node.shape[0] or node.dtype.kind not in "iu":
            return None
        dataset = self.dataset(where)
        if unavailable_filters(dataset):
            return None
        return int(dataset[0]), int(dataset[-1]), int(dataset.shape[0])

    def attribute(self, where: str, name: str) -> Any:
        """An attribute that is one number or text; None if it is missing or anything else. Nothing is unpickled."""
        node = self.node(where)
        if node is None or name not in node.attrs:
            return None
        stored = node.attrs.get_id(name)
        if stored.shape not in ((), (1,)) or stored.dtype.itemsize > LARGEST_ITEM_BYTES:
            return None
        if h5py.check_string_dtype(stored.dtype) is None and stored.dtype.kind not in "iufb":
            return None
        value = node.attrs[name]
        value = value.reshape(-1)[0] if isinstance(value, np.ndarray) else value
        value = value.item() if isinstance(value, np.generic) else value
        return value.decode("utf-8", "replace") if isinstance(value, bytes) else value

    def row_lengths(self, where: str, n: int) -> np.ndarray[Any, np.dtype[np.int64]]:
        """How many values each row of a ragged column of NWB has; refuses an index that does not divide them."""
        ends = self.read(f"{where}_index").astype(np.int64).reshape(-1)
        lengths = np.diff(ends, prepend=0)
        if np.any(lengths < 0) or lengths.sum() != n:
            raise InvalidFile(f"{self.path}: /{where}_index does not divide the {n:,} values of /{where}: damaged")
        return lengths


PLUGIN_ADVICE = "install the filter's plugin (MaxWell's comes with MaxLab Live) and set HDF5_PLUGIN_PATH to its folder"


def unavailable_filters(dataset: h5py.Dataset) -> str:
    """The compression filters of a dataset that are not installed, for messages; empty if all are installed."""
    created = dataset.id.get_create_plist()
    names = []
    for code, _, _, name in map(created.get_filter, range(created.get_nfilters())):
        if not h5py.h5z.filter_avail(code):
            text = name.decode("utf-8", "replace").partition("\0")[0].strip()
            names.append(f"filter {code}" + (f" ({text})" if text.isprintable() and text else ""))
    return ", ".join(names)


@contextmanager
def hdf5_file(path: Path) -> Iterator[Hdf5File]:
    """Open a file for checked reading; any error about its contents becomes an `InvalidFile` that names the file."""
    try:
        with h5py.File(path, "r") as file:
            yield Hdf5File(path, file)
    except (InvalidFile, InvalidArgument):
        raise
    except UnusableData as error:
        # The file is not damaged; its contents are invalid.
        raise InvalidFile(f"{path}: {error}") from error
    except DAMAGE as error:
        what = f"it is cut off or damaged ({first_line(error)}); copy or record it again"
        raise InvalidFile(f"{path}: expected a complete HDF5 recording, but {what}") from error


def is_positive(value: Any) -> bool:
    """Whether a value from a file is a positive, finite number."""
    return isinstance(value, int | float) and 0 < value < math.inf


def _as_text(values: Column) -> Column:
    flat = [v.decode("utf-8", "replace") if isinstance(v, bytes) else str(v) for v in values.reshape(-1).tolist()]
    if sum(map(len, flat)) > LARGEST_VALUES or max(map(len, flat), default=0) * len(flat) > LARGEST_VALUES:
        # numpy reserves the length of the longest text for each.
        flat = [text[:256] for text in flat]
    return np.array(flat, dtype=np.str_).reshape(values.shape)


def choose(
    what: str,
    option: str,
    names: Iterable[str],
    asked: str | None,
    describe: Callable[[str], str] = lambda name: name,
    commands: str = "animat inspect or animat convert; other commands need the file converted first",
) -> str:
    """The name that was asked for, or the only one; other cases are refused, with a list of the names.

    `what` is chosen and where (`rig.h5: part`), by an `option` (`--part`) of some `commands`.
    """
    found = list(names)
    if asked in found or (asked is None and len(found) == 1):
        return asked or found[0]
    listed = some_of([describe(name)[:80] for name in found])
    if asked is not None:
        raise InvalidFile(f"{what}: expected one of {listed}; got {asked}")
    raise InvalidFile(f"{what}: expected one, found {len(found)}: {listed}; choose with {option} NAME in {commands}")
