"""Read a vibrometer file of any known format as one object: ``stapeskit.read_vibrometer(path)``."""

from __future__ import annotations

from pathlib import Path

from kinematics.readers.facts import FileFacts, with_facts
from kinematics.readers.formats import read_file
from kinematics.readers.recording import Recording


def read_vibrometer(
    path: str | Path,
    *,
    mapping: str | Path | None = None,
    channels: str | Path | None = None,
    n_avg: float | None = None,
) -> Recording:
    """Read a vibrometer file: Polytec scan, UFF, PSV text, MATLAB, HDF5, CSV, time series.

    Parameters
    ----------
    path : path
        A file, or a folder of text exports.
    mapping : path, optional
        TOML file with other names for the columns of a wide table.
    channels : path, optional
        Table of the channels of time series.
    n_avg : float, optional
        Averages behind each value, where the file does not say them: with the coherence they give the noise.

    Returns
    -------
    Recording
        ``freq_hz`` (L,), ``points_m`` (P, 3), ``directions`` (P, 3), ``frf`` or ``velocity`` (P, L)
        complex, ``coherence`` (P, L) or None, ``sd`` (P, L) or None, ``units``, ``reference``;
        ``to_frame()``, ``plot()``.
        Amplitudes and positions of which the file does not say the unit are as in the file and in metres: see
        ``amplitude_stated`` and ``length_stated``.

    Raises
    ------
    StapeskitError
        The file is missing, damaged, of no known format, or holds no motion with a phase.
    """
    facts = FileFacts(
        n_avg=n_avg,
        mapping=None if mapping is None else Path(mapping),
        channels=None if channels is None else Path(channels),
    )
    return with_facts(read_file(Path(path), facts), facts).with_noise()
