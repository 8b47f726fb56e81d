"""Files that only their vendor's program can open: one sentence on what to export instead."""

from __future__ import annotations

from pathlib import Path
from typing import NoReturn

from legacy.kinematics.errors import KinematicsError

SUFFIXES = (".svd", ".pvd", ".set")
WORKBOOKS = (".xls", ".xlsx", ".xlsm", ".ods")
COMPOUND = b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1"


def read(path: Path) -> NoReturn:
    """Refuse a scan file of a scanning vibrometer.

    Raises
    ------
    KinematicsError
        Always; it says how to export.
    """
    if path.suffix.lower() in WORKBOOKS:
        refuse_workbook(path)
    step = (
        "Export the spectra of all points in the program that wrote it, as UFF (universal file, with "
        "geometry) or as ASCII (Real & Imag.), and give that file or folder"
    )
    raise KinematicsError.of(
        "the vibrometer file", "UFF or ASCII", "a scan file that only its own program reads", path.name, step
    )


def refuse_workbook(path: Path) -> NoReturn:
    """Refuse a workbook of a spreadsheet program.

    Raises
    ------
    KinematicsError
        Always; it says how to export.
    """
    step = "Save the sheet as CSV in the program that wrote it, and give that file"
    raise KinematicsError.of("the vibrometer file", "a table as text (.csv)", "a workbook", path.name, step)
