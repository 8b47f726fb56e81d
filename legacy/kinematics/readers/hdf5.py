"""Read and write spectra in HDF5: a small layout of this project that any program can write.

The layout, and how MATLAB writes it, stand in docs/vibrometer_files.md. MATLAB writes dimensions in reverse:
that is recognised by the length of freq_hz, and where both orders would fit by the attribute ``dims``.

Other HDF5 files are read when kinematics.readers.matlab.spectra knows their names and shapes, or as
a mapping says.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.readers.containers.hdf5_file import array_of, complex_of, read_hdf5, text_of, texts_of
from legacy.kinematics.readers.recording import Recording, Recordings, from_parts, scaled, unknown_vector
from legacy.kinematics.readers.text import shown
from legacy.kinematics.readers.unit_labels import MOTIONS, MotionUnit, motion_unit
from legacy.kinematics.readers.value_checks import number_faults
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, Place, collect_faults, raise_all

SCHEMA = "stapeskit.ldv/1"
# Groups in groups that are looked through for the data.
_DEEPEST = 6


def read(path: Path, mapping: Path | None = None) -> Recordings:
    """Read spectra from an HDF5 file.

    Parameters
    ----------
    mapping : Path, optional
        Which data set is what, for files of other layouts; see kinematics.readers.matlab.mapping.

    Raises
    ------
    KinematicsError
        The file is damaged or of another layout (its data sets are listed), something is missing, has
        another shape, or is of an unknown unit; all faults together.
    """
    from legacy.kinematics.readers.matlab.spectra import with_mapping

    path = Path(path)
    content = read_hdf5(path, "an HDF5 file", lambda file: _content(file, path.name, mapping is None))
    return content if isinstance(content, Recordings) else with_mapping(content, path, mapping)


def _content(file: Any, name: str, unmapped: bool) -> Recordings | dict[str, Any]:
    if unmapped and "freq_hz" in file and ("re" in file or "value" in file):
        return _read_own_layout(file, name)
    return plain_tree(file, name)


def plain_tree(group: Any, where: str, depth: int = 0) -> dict[str, Any]:
    """Return groups as dictionaries, data sets as arrays or texts.

    Raises
    ------
    KinematicsError
        A data set claims more than the file holds.
    """
    import h5py

    tree: dict[str, Any] = {}
    for name, node in group.items():
        if not isinstance(name, str):
            raise KinematicsError.of("the names in the file", "text in UTF-8", "others", where)
        if isinstance(node, h5py.Group):
            if depth < _DEEPEST:
                tree[name] = plain_tree(node, f"{where}, {name}", depth + 1)
        elif h5py.check_string_dtype(node.dtype) is not None:
            texts = texts_of(array_of(node, f"{where}, {name}"))
            tree[name] = texts[0] if len(texts) == 1 else texts
        elif node.dtype.kind in "fiubc" or node.dtype.names:
            tree[name] = complex_of(array_of(node, f"{where}, {name}"))
    return tree


def _read_own_layout(file: Any, name: str) -> Recordings:
    faults: list[Fault] = []
    freq = np.empty(0)
    value, turned = np.empty((0, 0, 0), dtype=complex), False
    with collect_faults(faults):
        freq = _frequencies(file, name)
        value, turned = _value(file, name, len(freq))
    runs, channels = value.shape[:2]
    unit = motion_unit(_attribute(file, "unit")) or MotionUnit(-1, 1.0)
    if unit.order < 0:
        got = shown(_attribute(file, "unit")) if "unit" in file.attrs else "none"
        step = "Write the attribute unit, m/s for velocities"
        faults.append(Fault("the attribute unit", "; ".join(MOTIONS), got, name, step))
    schema, amplitude = _attribute(file, "schema"), _attribute(file, "amplitude")
    if schema not in ("", SCHEMA):
        faults.append(Fault("the attribute schema", SCHEMA, schema, name))
    if amplitude not in ("", "peak", "rms"):
        faults.append(Fault("the attribute amplitude", "peak or rms", amplitude, name))
    sign = _attribute(file, "convention") or "+"
    if sign not in ("+", "-"):
        faults.append(Fault("the attribute convention", "+ or -", sign, name))
    if not value.size:
        raise_all(KinematicsError, faults)
    points = _texts(file, "point", channels, name, faults)
    bodies = _texts(file, "body", channels, name, faults) or [""] * channels
    run_names = _texts(file, "run", runs, name, faults) or [""] * runs
    direction = _vectors(file, "direction", channels, turned, name, faults)
    position = _vectors(file, "position_mm", channels, turned, name, faults)
    spread = _broadcast(file, "sd", value.shape, turned, name, faults)
    coherence = _broadcast(file, "coherence", value.shape, turned, name, faults)
    count = _broadcast(file, "n_avg", (1, channels, 1), turned, name, faults)
    if not points and "point" not in file and "point" not in file.attrs:
        step = "Write it as a data set of texts, or as an attribute with semicolons"
        faults.append(Fault("point", f"the names of {channels} channels", "none", name, step))
    if faults:
        faults += number_faults("freq_hz", freq, (freq < 0.0), "positive", name)
        faults += number_faults("the values", value, np.isinf(value), "finite, or NaN where missing", name)
    with np.errstate(over="ignore"):
        size = np.sqrt(np.sum(direction**2, axis=1))
    faults += [
        Fault("direction", "a unit vector (within 1e-3)", f"length {length:g}", f"{name}, channel {k}")
        for k, length in enumerate(size, 1)
        if abs(length - 1.0) > 1e-3
    ]
    raise_all(KinematicsError, faults)
    scale = unit.scale * (np.sqrt(2.0) if amplitude == "rms" else 1.0)
    value = value.conj() if sign == "-" else value
    recordings = []
    for run in range(runs):
        for k in range(channels):
            if np.all(np.isnan(value[run, k])):
                continue
            recordings.append(
                Recording(
                    points[k],
                    freq,
                    scaled(value[run, k], scale),
                    unit.order,
                    Place(name, "channel", (k + 1,), f"run {run + 1}" if runs > 1 else ""),
                    run_names[run] or (str(run + 1) if runs > 1 else ""),
                    bodies[k],
                    position[k],
                    direction[k],
                    None if spread is None else spread[run, k] * scale,
                    None if coherence is None else coherence[run, k],
                    None if count is None else float(count[0, k, 0]),
                    per=unit.per,
                )
            )
    return Recordings(
        tuple(recordings),
        (),
        "position_mm, direction",
        name,
        amplitude_stated=bool(amplitude),
        length_stated=True,
    )


def _frequencies(file: Any, name: str) -> Array:
    freq = _real(file, "freq_hz", name).reshape(-1)
    with np.errstate(invalid="ignore"):
        bad = ~np.isfinite(freq) | (np.diff(freq, prepend=-np.inf) <= 0.0)
    raise_all(KinematicsError, number_faults("freq_hz", freq, bad, "ascending and finite", name))
    return freq


def _real(file: Any, key: str, name: str) -> Array:
    """Return a data set of real numbers."""
    values = array_of(file[key], f"{name}, {key}")
    if values.dtype.kind not in "fiu":
        raise KinematicsError.of(key, "real numbers", f"values of type {values.dtype}", name)
    return values.astype(float)


def _attribute(file: Any, name: str) -> str:
    return text_of(file.attrs[name]).strip() if name in file.attrs else ""


def _value(file: Any, name: str, lines: int) -> tuple[NDArray[np.complex128], bool]:
    """Return values (run, channel, freq) and whether dimensions are written in reverse."""
    if "value" in file:
        values = complex_of(array_of(file["value"], f"{name}, value"))
    elif "im" in file:
        parts = [_real(file, part, name) for part in ("re", "im")]
        if parts[0].shape != parts[1].shape:
            got = f"{parts[0].shape} and {parts[1].shape}"
            raise KinematicsError.of("re and im", "of one shape", got, name)
        values = from_parts(*parts)
    else:
        step = "Write the imaginary part: without phase there is no motion"
        raise KinematicsError.of("the data set im", "in the file", "re alone", name, step)
    if values.dtype.kind not in "c":
        raise KinematicsError.of("value", "complex", "real numbers", name, "Write re and im")
    dims = _attribute(file, "dims").replace(" ", "")
    if dims not in ("", "channel,freq", "run,channel,freq", "freq,channel", "freq,channel,run"):
        raise KinematicsError.of("the attribute dims", "channel,freq or freq,channel", dims, name)
    if values.ndim not in (2, 3) or lines not in (values.shape[0], values.shape[-1]):
        want = f"of shape (channel, freq) with {lines} frequencies"
        raise KinematicsError.of("the values", want, values.shape, name)
    if not dims and values.shape[0] == values.shape[-1]:
        step = 'Write the attribute dims, "channel,freq" or (MATLAB) "freq,channel"'
        raise KinematicsError.of("the order of dimensions", "clear", "as many channels as lines", name, step)
    turned = dims.startswith("freq") if dims else values.shape[-1] != lines
    values = values.T if turned else values
    if values.shape[-1] != lines:
        raise KinematicsError.of("the values", f"as dims says, {dims}", values.shape, name)
    return np.asarray(values[None] if values.ndim == 2 else values, dtype=complex), turned


def _texts(file: Any, key: str, count: int, name: str, faults: list[Fault]) -> list[str]:
    if key in file:
        node = file[key]
        values = array_of(node, f"{name}, {key}")
        texts = [f"{v:g}" for v in values.reshape(-1)] if values.dtype.kind in "fiu" else texts_of(values)
    elif key in file.attrs:
        raw = file.attrs[key]
        texts = [text_of(entry) for entry in np.asarray(raw).reshape(-1)]
        texts = [part.strip() for part in texts[0].split(";")] if len(texts) == 1 else texts
    else:
        return []
    if len(texts) == 1 and key == "body":
        texts = texts * count
    if len(texts) != count or not all(texts):
        faults.append(Fault(key, f"{count} names", f"{len([t for t in texts if t])}", name))
        return []
    return texts


def _vectors(file: Any, key: str, count: int, turned: bool, name: str, faults: list[Fault]) -> Array:
    unknown = np.tile(unknown_vector(), (count, 1))
    if key not in file:
        return unknown
    values = array_of(file[key], f"{name}, {key}")
    values = values.T if turned else values
    if values.shape != (count, 3) or values.dtype.kind not in "fiu":
        faults.append(Fault(key, f"numbers of shape ({count}, 3)", values.shape, name))
        return unknown
    return values.astype(float)


def _broadcast(
    file: Any, key: str, shape: tuple[int, ...], turned: bool, name: str, faults: list[Fault]
) -> Array | None:
    if key not in file:
        return None
    values = array_of(file[key], f"{name}, {key}")
    if values.dtype.kind not in "fiu":
        faults.append(Fault(key, "real numbers", f"values of type {values.dtype}", name))
        return None
    values = values.T if turned else values
    values = values.reshape(1, -1, 1) if values.ndim == 1 and values.size == shape[1] else values
    try:
        return np.broadcast_to(values.astype(float), shape)
    except ValueError:
        faults.append(Fault(key, f"of shape {shape[1:]} or ({shape[1]},)", values.shape, name))
        return None


def write_hdf5(
    path: Path,
    freq_hz: ArrayLike,
    value: ArrayLike,
    *,
    point: Sequence[str],
    direction: ArrayLike,
    unit: str,
    body: Sequence[str] | str = "",
    position_mm: ArrayLike | None = None,
    sd: ArrayLike | None = None,
    coherence: ArrayLike | None = None,
    n_avg: ArrayLike | None = None,
    run: Sequence[str] = (),
    amplitude: str = "peak",
) -> None:
    """Write spectra in the layout that `read` knows.

    Parameters
    ----------
    path : Path
        Replaced when it exists.
    freq_hz : array_like, (freq,)
    value : array_like, (channel, freq) or (run, channel, freq), complex
        In ``unit``, e^{+iwt}.
    point : sequence of str, (channel,)
    direction : array_like, (channel, 3)
        Unit vectors towards the laser head.
    unit : str
        ``m/s``, ``nm``, ``(m/s)/V``, ...
    body : sequence of str, (channel,), or str
        Empty when another file says it.
    position_mm : array_like, (channel, 3), optional
    sd, coherence : array_like, shape of ``value``, optional
    n_avg : array_like, scalar or (channel,), optional
    run : sequence of str, (run,)
    amplitude : str
        ``peak`` or ``rms``.

    Raises
    ------
    KinematicsError
        A shape, unit or name that `read` would refuse.
    """
    from legacy.stapeskit.outputs import stage_outputs
    from legacy.stapeskit.records.hdf5_writing import write_h5

    path = Path(path)
    numbers = np.asarray(value, dtype=complex)
    with stage_outputs(path.parent) as stage:
        import h5py

        with write_h5(stage / path.name) as file:
            file.attrs["schema"], file.attrs["unit"], file.attrs["amplitude"] = SCHEMA, unit, amplitude
            file.attrs["convention"] = "+"
            file.attrs["dims"] = "channel,freq" if numbers.ndim == 2 else "run,channel,freq"
            _store(file, "freq_hz", freq_hz)
            _store(file, "re", numbers.real)
            _store(file, "im", numbers.imag)
            more = {"position_mm": position_mm, "sd": sd, "coherence": coherence, "n_avg": n_avg}
            for name, column in {"direction": direction, **more}.items():
                if column is not None:
                    _store(file, name, column)
            texts = {
                "point": point,
                "run": run,
                "body": [body] * len(point) if isinstance(body, str) else body,
            }
            for name, words in texts.items():
                if any(words):
                    file.create_dataset(name, data=list(words), dtype=h5py.string_dtype())
        read_hdf5(stage / path.name, path.name, lambda file: _read_own_layout(file, path.name))


def _store(file: Any, name: str, values: Any) -> None:
    """Store numbers with checksums, so that a damaged file is refused instead of read."""
    array = np.asarray(values, dtype=float)
    checked = {"fletcher32": True} if array.ndim and array.size else {}
    file.create_dataset(name, data=array, **checked)
