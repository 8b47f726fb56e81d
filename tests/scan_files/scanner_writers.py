"""Writers of the formats of scanners and viewers, from their descriptions: ISQ, AIM, VGStudio, Amira.

Each writes an array [z, y, x] with voxels of `SPACING` and returns the path to open.
"""

from __future__ import annotations

import numpy as np

from tests.scan_files.scan_writers import SPACING


def isq(path, array, spacing=SPACING):
    head = bytearray(1024)
    head[:16] = b"CTDATA-HEADER_V1"
    extent = np.rint(spacing * 1e3 * array.shape[::-1])
    head[44:68] = np.array([*array.shape[::-1], *extent], "<i4").tobytes()
    head[88:92] = np.array([4096], "<i4").tobytes()
    head[508:512] = np.array([1], "<i4").tobytes()
    path.write_bytes(bytes(head) + array.astype("<i2").tobytes())
    return path


AIM_TYPES = {"i1": 0x00010001, "u1": 0x00160001, "i2": 0x00020002, "u2": 0x00170002, "i4": 0x00030004}
AIM_TYPES |= {"f4": 0x001A0004}
AIM_LOG = b"! Processing Log\nMu_Scaling                    8192\n"


def aim(path, array, position=(0, 0, 0)):
    """Version 020: voxel size as VAX F floats, a log between header and data."""
    image = np.zeros(35, "<i4")
    image[[0, 5]] = 16, AIM_TYPES[array.dtype.str[1:]]
    image[6:9] = position
    image[9:12] = array.shape[::-1]
    halves = (SPACING * 4).astype("<f4").view("<u2").reshape(3, 2)[:, ::-1]
    image[27:30] = np.ascontiguousarray(halves).view("<i4").ravel()
    head = np.array([20, 140, len(AIM_LOG), array.nbytes, 0], "<i4").tobytes()
    path.write_bytes(head + image.tobytes() + AIM_LOG + array.tobytes())
    return path


def aim30(path, array, position=(0, 0, 0)):
    """Version 030: 64-bit numbers, voxel size in nanometres."""
    words = np.array([16, 0, 0, AIM_TYPES[array.dtype.str[1:]]], "<i4").tobytes()
    triples = np.zeros(24, "<i8")
    triples[0:3] = position
    triples[3:6] = array.shape[::-1]
    triples[21:24] = np.rint(SPACING * 1e6)
    image = words + triples.tobytes() + bytes(16)
    head = np.array([40, len(image), len(AIM_LOG), array.nbytes, 0], "<i8").tobytes()
    path.write_bytes(b"AIMDATA_V030   \0" + head + image + AIM_LOG + array.tobytes())
    return path


VGI = """{{volume1}}
[representation]
size = {size}
mirror = 0 0 0 0
datatype = unsigned integer
bitsperelement = 16
{files}{{volumeprimitive1}}
[geometry]
position = 10.5 -38 0
resolution = {resolution}
unit = {unit}
"""


def vgi(path, array, unit="mm", skip=0, spacing=SPACING):
    """A header as VGStudio MAX writes it, with the voxels in a file beside it."""
    size = " ".join(map(str, array.shape[::-1]))
    kind = {"u": "unsigned integer", "i": "signed integer", "f": "float"}[array.dtype.kind]
    name = f"{path.stem}-0.vol"
    (path.parent / name).write_bytes(bytes(skip) + array.tobytes())
    files = (
        f"[file1]\nSkipHeader = {skip}\nFileFormat = raw\nSize = {size}\n"
        f"Name = C:\\scans\\{name}\nDatatype = {kind}\nBitsPerElement = {array.dtype.itemsize * 8}\n"
    )
    factor = {"mm": 1.0, "um": 1e3, "": 1.0}[unit]
    steps = " ".join(f"{s * factor:g}" for s in spacing)
    text = VGI.format(size=size, files=files, unit=unit, resolution=steps)
    path.write_text(text, newline="\r\n")
    return path


def amira(path, array, big=False, unit="mm", materials=()):
    kinds = {"u1": "byte", "i2": "short", "u2": "ushort", "i4": "int", "f4": "float", "f8": "double"}
    far = (np.array(array.shape[::-1]) - 1) * SPACING * {"um": 1e3, "µm": 1e3}.get(unit, 1.0)
    box = " ".join(f"0 {value:g}" for value in far)
    stated = f'    Units {{\n        Coordinates "{unit}"\n    }}\n' if unit else ""
    if materials:
        listed = "".join(
            f"        {name} {{\n            Id {k}\n        }}\n" for k, name in enumerate(materials)
        )
        stated += f"    Materials {{\n{listed}    }}\n"
    text = (
        f"# Avizo {'BINARY' if big else 'BINARY-LITTLE-ENDIAN'} 2.1\n\n\n"
        f"define Lattice {' '.join(map(str, array.shape[::-1]))}\n\nParameters {{\n{stated}"
        f'    BoundingBox {box},\n    CoordType "uniform"\n}}\n\n'
        f"Lattice {{ {kinds[array.dtype.str[1:]]} Data }} @1\n\n# Data section follows\n@1\n"
    )
    path.write_bytes(text.encode() + array.astype(array.dtype.newbyteorder(">" if big else "<")).tobytes())
    return path
