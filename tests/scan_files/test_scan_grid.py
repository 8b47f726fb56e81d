"""The scan as a grid: parts, boxes, slabs and block means are those of the whole, and keep their place."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ct_inertia.scan.raw import plane_reader
from ct_inertia.scan.scan import Scan, block_means
from stapeskit.faults import StapeskitError

RNG = np.random.default_rng(3)
ARRAY = RNG.integers(0, 999, (13, 11, 9)).astype(np.uint16)
TURN = Rotation.from_euler("xyz", [0.2, 0.5, -1.1]).as_matrix()


def turned(array=ARRAY, **fields):
    return Scan.from_array(array, (0.02, 0.03, 0.04), origin_mm=[1.0, -2.0, 3.0], direction=TURN, **fields)


def refused(work):
    with pytest.raises(StapeskitError) as caught:
        work()
    return caught.value.faults[0]


ALONG = st.builds(slice, st.integers(-15, 15), st.integers(-15, 15), st.integers(1, 5))


@settings(max_examples=60, deadline=None)
@given(st.tuples(ALONG, ALONG, ALONG))
def test_a_box_is_that_part_of_the_array(box):
    assert np.array_equal(turned().read(box), ARRAY[box])


@settings(max_examples=60, deadline=None)
@given(st.tuples(ALONG, ALONG, ALONG), st.sampled_from([1, 700]))
def test_raw_planes_are_read_in_place(tmp_path_factory, box, wide):
    """Also where rows are long enough to be read one by one, and planes lie in any order in two files."""
    array = np.repeat(ARRAY, wide, axis=2).astype(">u2")
    folder = tmp_path_factory.getbasetemp() / f"planes{wide}"
    order = np.random.default_rng(5).permutation(len(array))
    files = (folder / "a", folder / "b")
    if not folder.exists():
        folder.mkdir()
        files[0].write_bytes(b"xyz" + array[order[:6]].tobytes())
        files[1].write_bytes(array[order[6:]].tobytes())
    place = np.argsort(order)
    plane = array[0].nbytes
    number = (place >= 6).astype(int)
    offset = np.where(number == 0, 3 + plane * place, plane * (place - 6))
    planes = [(files[n], int(start)) for n, start in zip(number, offset, strict=True)]
    fetch = plane_reader(planes, array.shape, array.dtype)
    bounds = tuple(slice(*along.indices(n)) for along, n in zip(box, array.shape, strict=True))
    values = fetch(bounds)
    assert values.dtype == np.dtype("u2")
    assert np.array_equal(values, array[bounds])


@pytest.mark.parametrize(("planes", "chunk"), [(1, 1), (3, 1), (2, 4), (20, 4)])
def test_slabs_make_up_the_box(planes, chunk):
    scan = turned(chunk_planes=chunk)
    box = (slice(1, 13, 2), slice(2, 9), slice(None))
    slabs = list(scan.slabs(planes, box))
    assert [first for first, _ in slabs] == list(range(0, 6, planes))
    assert np.array_equal(np.concatenate([slab for _, slab in slabs]), ARRAY[box])


def test_a_part_keeps_its_place_and_so_does_a_part_of_it():
    scan = turned()
    part = scan.part((slice(2, 12, 3), slice(1, 9), slice(3, 9, 2)))
    inner = part.part((slice(1, 4), slice(0, 6, 2), slice(1, 3)))
    assert np.array_equal(inner.read(), part.read()[1:4, 0:6:2, 1:3])
    for index in ((0, 0, 0), (1, 2, 2)):
        x, y, z = 3 + 2 * (1 + index[0]), 1 + 2 * index[1], 2 + 3 * (1 + index[2])
        assert inner.scan_points(index) == pytest.approx(scan.scan_points((x, y, z)))


def test_a_box_by_its_corners_holds_the_centres_between_them():
    scan = Scan.from_array(ARRAY, 0.5, origin_mm=[10.0, 20.0, 30.0])
    box = scan.box_of([10.9, 20.0, 30.4, 12.1, 22.0, 99.0])
    assert box == (slice(1, 13), slice(0, 5), slice(2, 5))
    assert refused(lambda: scan.box_of([0, 0, 0, 1, 1, 1])).thing == "--box"


@settings(max_examples=40, deadline=None)
@given(st.tuples(*[st.integers(1, 4)] * 3), st.tuples(*[st.integers(0, 1)] * 3))
def test_block_means_are_those_of_every_block(block, first):
    ends = [
        start + (n - start) // size * size
        for start, n, size in zip(first, ARRAY.shape, block[::-1], strict=True)
    ]
    box = tuple(slice(start, end) for start, end in zip(first, ends, strict=True))
    means = block_means(turned(), block, box)
    assert means.dtype == np.float32
    k, j, i = means.shape
    x, y, z = block
    assert means == pytest.approx(ARRAY[box].reshape(k, z, j, y, i, x).mean(axis=(1, 3, 5)), rel=1e-6)


def test_what_is_no_grid_is_refused():
    sheared = np.eye(3)
    sheared[0, 1] = 0.01
    wrong = {
        "spacing_mm": (0.0, 1.0, 1.0),
        "origin_mm": (np.nan, 0.0, 0.0),
        "direction": np.diag([1.0, 1.0, -1.0]),
    }
    for name, value in wrong.items():
        fields = {"spacing_mm": 1.0} | {name: value}
        assert refused(lambda fields=fields: Scan.from_array(ARRAY, **fields)).thing
    fault = refused(lambda: Scan.from_array(ARRAY, 1.0, direction=sheared))
    assert fault.expected == "orthonormal (no shear)"
    for array in (ARRAY[0], ARRAY[:1], ARRAY.astype("c8"), ARRAY.astype(bool)):
        assert refused(lambda array=array: Scan.from_array(array, 1.0)).thing


def test_huge_grey_values_are_refused_where_they_are_read():
    array = ARRAY.astype("f8")
    array[9] *= 1e20
    scan = turned(array)
    assert np.array_equal(scan.read((slice(0, 9), slice(None), slice(None))), array[:9])
    assert refused(scan.read).thing == "the grey values"
