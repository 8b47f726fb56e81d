"""Write HDF5 files in memory first: on a full disk the library would end the process."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def write_h5(path: Path) -> Iterator[Any]:
    """Lend an HDF5 file in memory that is written to ``path`` when the block has ended.

    Raises
    ------
    OSError
        The file cannot be written.
    MemoryError
        There is no room for it in memory, which the library reports as another error, in words.
    """
    import h5py

    try:
        with h5py.File(Path(path).name, "w", driver="core", backing_store=False) as file:
            yield file
            file.flush()
            image = file.id.get_file_image()
    except (OSError, RuntimeError, ValueError) as fault:
        if "alloc" in str(fault):
            raise MemoryError(str(fault)) from fault
        raise
    Path(path).write_bytes(image)


def larger_than_file(group: Any, size: int) -> str:
    """Return the name of a data set that declares more bytes than the file has, or nothing."""
    names: list[str] = []

    def look(name: str, item: Any) -> None:
        count = getattr(item, "size", None)
        if count is not None and not names and count * item.dtype.itemsize > size:
            names.append(name)

    group.visititems(look)
    return names[0] if names else ""
