"""Write MATLAB 7.3 files as MATLAB does: HDF5 behind a user block, dimensions reversed."""

import h5py
import numpy as np


def write_v73(path, variables):
    """Write a dictionary of arrays, texts, lists (cells, struct arrays) and dictionaries."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in variables.items():
            _put(file, file, name, value)
    with open(path, "r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file, Platform: PCWIN64".ljust(124) + b"\x00\x02IM")


def _put(file, group, name, value):
    if isinstance(value, dict):
        made = group.create_group(name)
        made.attrs["MATLAB_class"] = np.bytes_("struct")
        for key, one in value.items():
            _put(file, made, key, one)
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        made = group.create_group(name)
        made.attrs["MATLAB_class"] = np.bytes_("struct")
        for key in value[0]:
            _references(file, made, key, [one[key] for one in value])
    elif isinstance(value, list):
        _references(file, group, name, value).attrs["MATLAB_class"] = np.bytes_("cell")
    elif isinstance(value, str):
        codes = np.frombuffer(value.encode("utf-16-le"), dtype=np.uint16)[:, None]
        made = group.create_dataset(name, data=codes)
        made.attrs["MATLAB_class"] = np.bytes_("char")
        made.attrs["MATLAB_int_decode"] = np.int32(2)
    else:
        array = np.atleast_2d(np.asarray(value))
        if array.size == 0:
            made = group.create_dataset(name, data=np.array(array.shape, dtype=np.uint64))
            made.attrs["MATLAB_empty"] = np.uint8(1)
        elif np.iscomplexobj(array):
            pairs = np.empty(array.T.shape, dtype=[("real", "<f8"), ("imag", "<f8")])
            pairs["real"], pairs["imag"] = array.T.real, array.T.imag
            made = group.create_dataset(name, data=pairs)
        else:
            made = group.create_dataset(name, data=np.asarray(array, dtype=float).T)
        made.attrs["MATLAB_class"] = np.bytes_("double")


def _references(file, group, name, values):
    store = file.require_group("#refs#")
    places = []
    for value in values:
        key = f"r{len(store)}"
        _put(file, store, key, value)
        places.append(store[key].ref)
    return group.create_dataset(
        name, data=np.array(places, dtype=h5py.ref_dtype)[:, None], dtype=h5py.ref_dtype
    )
