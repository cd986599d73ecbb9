"""Reading loops from files, well-formed and hostile ones, and writing files whole or not at all."""

from __future__ import annotations

import errno
import itertools
import os
import struct

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from harnack.files import file_geometry
from harnack.files.file_geometry import FileFormatError, check_writable, write_atomically
from harnack.files.geometry_files import read_loops
from harnack.geometry import boundary_edges, example_curves

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
CORNERS = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]


def as_lists(loops) -> list:
    return [loop.tolist() for loop in loops]


def same_cycle(loop, expected) -> bool:
    """Whether two lists of vertices are the same directed cycle."""
    return any(loop == expected[k:] + expected[:k] for k in range(len(expected)))


# --- .obj ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        SQUARE + "f 1 2 3 4\n",
        SQUARE + "l 1 2 3 4 1\n",
        SQUARE + "f -4 -3 -2 -1",
        SQUARE + "f 1/7/3 2//2 3/1 4 # a comment\n",
        "f 1 2 3 4\n" + SQUARE,  # faces may come first
        SQUARE + "l 1 2\nl 2 3\nl 3 4\nl 4 1\n",
        SQUARE + "l 1 2\nl 3 4\nl 2 3\nl 1 4\n",  # in any order and direction
        SQUARE + "l 1 2 3\nl 3 4 1\n",
        SQUARE + "l 1 2 3 \\\n 4 1\n",
        "\ufeff# made by hand\r\no square\r\n"
        + SQUARE.replace("\n", " 1.0\r\n")
        + "l 1 2 3 4 1\r\n",
        SQUARE + "v 0 0 -0.0\nl 1 2 3 4 5\n",  # closed by position
        "mtllib x.mtl\nvn 0 0 1\nvt 0 0\ng all\ns off\nusemtl x\n" + SQUARE + "f 1 2 3 4\n",
    ],
)
def test_obj_ways_to_write_a_square(save, text):
    (loop,) = as_lists(read_loops(save("square.obj", text)))
    assert same_cycle(loop, CORNERS)


def test_obj_lines_that_continue_and_say_nothing(save):
    text = "\\\n\\\n\n" + SQUARE + "f 1 2 3 4" + " \\\n" * 100_000 + "\nl 1 2 3 \\\n1"
    assert [len(loop) for loop in read_loops(save("a.obj", text))] == [4, 3]


def test_obj_of_several_loops(save):
    text = SQUARE + "v 0 0 1\nv 1 0 1\nv 0 1 1\n"
    path = save("two.obj", text + "f 1 2 3 4\nl 5 6 7 5\nl 1 2\nl 2 5\nl 5 1\n")
    assert [len(loop) for loop in read_loops(path)] == [4, 3, 3]


def test_obj_segments_of_two_curves_are_told_apart(save):
    curves = example_curves.hopf_link(8)
    x = np.concatenate(curves)
    segments = [(k, (k + 1) % 8) for k in range(8)] + [(8 + k, 8 + (k + 1) % 8) for k in range(8)]
    order = np.random.default_rng(0).permutation(16)
    lines = [f"v {a:.17g} {b:.17g} {c:.17g}" for a, b, c in x]
    lines += [f"l {segments[k][0] + 1} {segments[k][1] + 1}" for k in order]
    loops = as_lists(read_loops(save("hopf.obj", "\n".join(lines))))
    assert len(loops) == 2
    for curve in curves:
        assert any(same_cycle(loop, curve.tolist()) for loop in loops)


def cube_without_lid() -> str:
    """Eight corners, each written once for every face that uses it, and five outward faces."""
    faces = [
        [(0, 0, 0), (0, 1, 0), (1, 1, 0), (1, 0, 0)],
        [(0, 0, 0), (1, 0, 0), (1, 0, 1), (0, 0, 1)],
        [(1, 0, 0), (1, 1, 0), (1, 1, 1), (1, 0, 1)],
        [(1, 1, 0), (0, 1, 0), (0, 1, 1), (1, 1, 1)],
        [(0, 1, 0), (0, 0, 0), (0, 0, 1), (0, 1, 1)],
    ]
    lines = ["v {} {} {}".format(*corner) for face in faces for corner in face]
    return "\n".join(lines + [f"f {k} {k + 1} {k + 2} {k + 3}" for k in range(1, 21, 4)]) + "\n"


def test_the_boundary_of_faces_is_welded(save):
    path = save("box.obj", cube_without_lid())
    assert len(read_loops(path)) == 5
    (rim,) = as_lists(read_loops(path, boundary=True))
    assert same_cycle(rim, [[0, 0, 1], [0, 1, 1], [1, 1, 1], [1, 0, 1]])
    lid = "v 0 0 1\nv 1 0 1\nv 1 1 1\nv 0 1 1\nf -4 -3 -2 -1\n"
    closed = save("closed.obj", cube_without_lid() + lid)
    with pytest.raises(FileFormatError, match="closed surface, which has no boundary"):
        read_loops(closed, boundary=True)


# --- .loops ----------------------------------------------------------------------------------


def test_loops_text(save):
    path = save(
        "a.loops", "# two loops\n\n0 0 0 1 0 0 1 1 0 0 1 0 # square\n 0 0 1  1 0 1  0 1 1\r\n"
    )
    first, second = as_lists(read_loops(path))
    assert first == CORNERS
    assert second == [[0, 0, 1], [1, 0, 1], [0, 1, 1]]


@given(seed=st.integers(0, 2**32 - 1), loops=st.integers(1, 4))
@settings(
    deadline=None, max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_loops_text_keeps_every_bit(save, seed, loops):
    rng = np.random.default_rng(seed)
    curves = [rng.normal(size=(rng.integers(3, 9), 3)) for _ in range(loops)]
    text = "\n".join(" ".join(repr(float(v)) for v in c.ravel()) for c in curves)
    assert as_lists(read_loops(save("r.loops", text))) == as_lists(curves)


# --- .ply ------------------------------------------------------------------------------------

_TYPES = {"double": "d", "float": "f", "int": "i", "uchar": "B", "ushort": "H", "uint": "I"}


def make_ply(byte_order: str, elements: list, comment: str = "comment made by a test\n") -> bytes:
    """A .ply file. elements: (name, [property declarations], rows)."""
    words = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}
    header = f"ply\nformat {words[byte_order]} 1.0\n{comment}"
    body = b""
    for name, properties, rows in elements:
        header += f"element {name} {len(rows)}\n"
        header += "".join(f"property {p}\n" for p in properties)
        for row in rows:
            values: list[tuple[str, float]] = []
            for declared, value in zip(properties, row, strict=True):
                kinds = declared.split()
                if kinds[0] == "list":
                    values.append((_TYPES[kinds[1]], len(value)))
                    values += [(_TYPES[kinds[2]], v) for v in value]
                else:
                    values.append((_TYPES[kinds[0]], value))
            if byte_order:
                body += b"".join(struct.pack(byte_order + code, v) for code, v in values)
            else:
                body += " ".join(str(v) for _, v in values).encode() + b"\n"
    return header.encode() + b"end_header\n" + body


XYZ = ["double x", "double y", "double z"]
FLOAT_XYZ = ["uchar red", "float x", "float y", "float z", "list uchar float weights"]
VERTICES = ("vertex", XYZ, CORNERS)
FACES = ("face", ["list uchar int vertex_indices"], [[[0, 1, 2, 3]]])
EDGES = ("edge", ["int vertex1", "int vertex2", "uchar red"],
         [[0, 1, 9], [2, 1, 9], [2, 3, 9], [3, 0, 9]])  # fmt: skip


@pytest.mark.parametrize("byte_order", ["", "<", ">"])
@pytest.mark.parametrize(
    "elements",
    [
        [VERTICES],
        [VERTICES, FACES],
        [VERTICES, EDGES],
        [FACES, VERTICES],
        [("vertex", FLOAT_XYZ, [[7, *c, [0.5] * k] for k, c in enumerate(CORNERS)]), EDGES],
        [("material", ["uchar id", "list ushort double table"], [[1, [2.0, 3.0]], [2, []]]),
         VERTICES,
         ("face", ["uchar flags", "list uint uint vertex_index"], [[0, [0, 1, 2, 3]]])],
    ],
)  # fmt: skip
def test_ply_ways_to_write_a_square(save, byte_order, elements):
    (loop,) = as_lists(read_loops(save("square.ply", make_ply(byte_order, elements))))
    assert same_cycle(loop, CORNERS)


def test_ply_header_with_windows_line_ends(save):
    data = make_ply("<", [VERTICES, FACES])
    end = data.index(b"end_header\n") + len(b"end_header\n")
    path = save("crlf.ply", data[:end].replace(b"\n", b"\r\n") + data[end:])
    assert as_lists(read_loops(path)) == [CORNERS]


def test_ply_boundary_of_faces(save):
    two = ("face", ["list uchar int vertex_indices"], [[[0, 1, 2]], [[0, 2, 3]]])
    path = save("two.ply", make_ply("<", [VERTICES, two]))
    (rim,) = as_lists(read_loops(path, boundary=True))
    assert same_cycle(rim, CORNERS)


# --- hostile and mistaken files --------------------------------------------------------------


def ply_text(header: str, body: str = "") -> str:
    return f"ply\nformat ascii 1.0\n{header}end_header\n{body}"


VERTEX_HEADER = "property float x\nproperty float y\nproperty float z\n"
MANY = "9" * 18

BAD = [
    ("empty.obj", "", "the file is empty"),
    ("blank.loops", " \n\n", "the file is empty"),
    ("binary.obj", b"v 0 0 0\n\x00\x01\x02", "binary data"),
    ("utf16.obj", SQUARE.encode("utf-16"), "binary data"),
    ("noise.obj", bytes(range(1, 256)) * 40, "is no .obj statement"),
    ("noise.loops", bytes(range(1, 256)) * 40, "is not a number"),
    ("noise.ply", bytes(range(256)) * 40, "this is no .ply file"),
    ("square.stl", SQUARE, "read from .obj, .ply and .loops files"),
    ("square", SQUARE, "read from .obj, .ply and .loops files"),
    ("points.obj", SQUARE, "no faces or polylines"),
    ("open.obj", SQUARE + "l 1 2 3\n", r"line 5: the polyline that ends at .* is open: to close"),
    ("open2.obj", SQUARE + "l 1 2\nl 2 3\nl 3 4\n", r"line [57]: the polyline that ends at"),
    ("fork.obj", SQUARE + "l 1 2\nl 1 3\nl 1 4\n", "line 7: 3 segments meet"),
    ("pinch.obj", SQUARE + "v 5 5 5\nl 1 2 3\nl 1 3 4 5\nl 3 5\n", "line 8: 4 segments meet"),
    ("stop.obj", SQUARE + "l 1 1\n", r"line 5: two vertices in a row"),
    ("two.obj", SQUARE + "f 1 2\n", "line 5: 'f' needs at least 3"),
    ("one.obj", SQUARE + "l 1\n", "line 5: 'l' needs at least 2"),
    ("twice.obj", SQUARE + "f 1 2 2 3\n", "line 5: vertices 1 and 2 of the loop are both"),
    ("back.obj", SQUARE + "l 1 2 1\n", "2 different vertices"),
    ("zero.obj", SQUARE + "f 0 1 2\n", "line 5: vertices are counted from 1"),
    ("high.obj", SQUARE + "f 1 2 5\n", "line 5: vertex 5 is out of range"),
    ("low.obj", SQUARE + "f 1 2 -5\n", "line 5: vertex -5 is out of range"),
    ("huge.obj", SQUARE + f"f 1 2 {MANY * 5}\n", "line 5: vertex 9+ is out of range"),
    ("huge2.obj", SQUARE + f"f 1 2 {MANY * 500}\n", "line 5: '99.*' is not an integer"),
    ("word.obj", SQUARE + "f 1 2 three\n", "line 5: 'three' is not an integer"),
    ("nan.obj", "v 0 nan 0\n", "line 1: coordinates must be finite, not 'nan'"),
    ("inf.obj", "v 0 0 1e999\n", "line 1: coordinates must be finite, not '1e999'"),
    ("short.obj", "v 0 0\n", "line 1: a vertex needs three coordinates, not 2"),
    ("text.obj", "v 0 0 zero\n", "line 1: 'zero' is not a number"),
    ("long.obj", "v 0 0 " + "1" * 100 + "x\n", r"line 1: '1{32}\.\.\.' is not a number"),
    ("line.obj", SQUARE + "f" + " 1" * 9_000_000, "line 5: a line of 18,000,001 bytes"),
    ("four.loops", "0 0 0 1 0 0 1 1 0\n1 2 3 4\n", "line 2: 4 numbers: .* a multiple of 3"),
    ("few.loops", "0 0 0 1 0 0\n", "line 1: the loop has 2 different vertices"),
    ("nan.loops", "\n0 0 0 1 0 0 1 nan 0\n", "line 2: coordinates must be finite"),
    ("note.loops", "# nothing\n", "there are no loops"),
    ("word.loops", "0 0 0 1 0 0 x 1 0\n", "line 1: 'x' is not a number"),
    ("none.ply", "ply\nformat ascii 1.0\n", "this is no .ply file"),
    ("mute.ply", f"ply\nelement vertex 1\n{VERTEX_HEADER}end_header\n0 0 0", "names no format"),
    ("new.ply", "ply\nformat ascii64 1.0\nend_header\n", "line 2: .* is no statement"),
    ("count.ply", ply_text("element vertex -1\n"), "line 3: .* is no statement"),
    ("count2.ply", ply_text(f"element vertex {MANY * 5}\n"), "line 3: .* too large a count"),
    ("stray.ply", ply_text("property float x\n"), "line 3: .* is no statement"),
    ("bare.ply", ply_text("element vertex 4\n", "\n" * 9), "'vertex' has no properties"),
    ("twice.ply", ply_text("element vertex 1\n" + 2 * "property int x\n"), "declared twice"),
    ("type.ply", ply_text("element vertex 1\nproperty half x\n"), "a property is"),
    ("list.ply", ply_text("element face 1\nproperty list float int a\n"), "must be an integer"),
    ("empty.ply", ply_text("element vertex 0\n" + VERTEX_HEADER), "no faces or polylines"),
    ("many.ply", ply_text(f"element vertex {MANY}\n" + VERTEX_HEADER, "0 0 0\n"), "ends before"),
    ("flat.ply", ply_text("element vertex 1\nproperty int x\n", "1\n"), "needs a property 'y'"),
    ("few.ply", ply_text("element vertex 1\n" + VERTEX_HEADER, "0 0\n"), "vertex 0: 2 .* too few"),
    ("lot.ply", ply_text("element vertex 1\n" + VERTEX_HEADER, "0 0 0 0\n"), "4 .* too many"),
    ("nan.ply", ply_text("element vertex 1\n" + VERTEX_HEADER, "0 nan 0\n"), "vertex 0: coord"),
    ("word.ply", ply_text("element vertex 1\n" + VERTEX_HEADER, "0 x 0\n"), "vertex 0: .x. is no"),
    ("size.ply", ply_text("element face 1\nproperty list int int vertex_index\n", "9 0 1 2\n"),
     "face 0: 4 numbers are too few"),
    ("size2.ply", ply_text("element face 1\nproperty list int int vertex_index\n", "-1 0 1 2\n"),
     "face 0: 4 numbers are too few"),
    ("kind.ply", ply_text("element face 1\nproperty int vertex_index\n", "3\n"), "face 0: a list"),
    ("float.ply", make_ply("<", [VERTICES, ("face", ["list uchar float vertex_index"],
                                            [[[0, 1, 2]]])]), "indices must be integers"),
    ("range.ply", make_ply(">", [VERTICES, ("face", ["list uchar int vertex_index"],
                                            [[[0, 1, 4]]])]), "face 0: vertex 4 is out of range"),
    ("minus.ply", make_ply(">", [VERTICES, ("edge", ["int vertex1", "int vertex2"],
                                            [[0, -1]])]), "edge 0: vertex -1 is out of range"),
    ("cut.ply", make_ply("<", [VERTICES, FACES])[:-1], "ends before the 1 rows of element 'face'"),
    ("cut2.ply", make_ply("<", [VERTICES])[:-1], "ends before the 4 rows of element 'vertex'"),
    ("vast.ply", make_ply("<", [VERTICES]).replace(b"vertex 4", b"vertex " + MANY.encode()),
     "ends before"),
    ("vast2.ply", make_ply("<", [VERTICES, ("face", ["list uint int vertex_index"], [[[]]])])[:-4]
     + b"\xff\xff\xff\xff", "ends before"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "content", "message"), BAD, ids=[bad[0] for bad in BAD])
def test_each_bad_file_has_its_own_error(save, name, content, message):
    path = save(name, content)
    with pytest.raises(FileFormatError, match=message) as caught:
        read_loops(path)
    assert isinstance(caught.value, ValueError)
    assert str(path) in str(caught.value)
    assert len(str(caught.value)) < 300 + len(str(path))


def test_what_is_not_a_file_is_said(tmp_path):
    with pytest.raises(FileFormatError, match="no such file"):
        read_loops(tmp_path / "missing.obj")
    with pytest.raises(FileFormatError, match=r"cannot be read|no such file"):
        read_loops("a\0b.obj")
    (tmp_path / "folder.obj").mkdir()
    with pytest.raises(FileFormatError, match="a directory"):
        read_loops(tmp_path / "folder.obj")
    os.mkfifo(tmp_path / "pipe.obj")
    with pytest.raises(FileFormatError, match="not an ordinary file"):
        read_loops(tmp_path / "pipe.obj")


def test_a_file_above_the_limit_is_not_read(tmp_path):
    path = tmp_path / "sparse.ply"
    with path.open("wb") as file:
        file.truncate(file_geometry.MAX_BYTES + 1)
    with pytest.raises(FileFormatError, match="bytes are too many"):
        read_loops(path)


@pytest.mark.parametrize("byte_order", ["", "<", ">"])
def test_faces_without_corners_have_no_boundary(save, byte_order):
    faces = ("face", ["list uchar int vertex_indices"], [[[]], [[0, 1, 2]], [[2]]])
    path = save("a.ply", make_ply(byte_order, [VERTICES, faces]))
    (rim,) = as_lists(read_loops(path, boundary=True))
    assert same_cycle(rim, CORNERS[:3])


def test_boundary_needs_faces(save):
    with pytest.raises(FileFormatError, match="no faces to take the boundary of"):
        read_loops(save("a.obj", SQUARE + "l 1 2 3 4 1\n"), boundary=True)
    with pytest.raises(FileFormatError, match="no faces to take the boundary of"):
        read_loops(save("a.loops", "0 0 0 1 0 0 1 1 0\n"), boundary=True)


SEEDS = [
    ("a.obj", (SQUARE + "l 1 2 3 4 1\nf 1 -2 3\n").encode()),
    ("a.loops", b"0 0 0 1 0 0 1 1 0\n0 0 1 1 0 1 1 1 1\n"),
    ("a.ply", make_ply("", [VERTICES, FACES, EDGES])),
    ("a.ply", make_ply("<", [VERTICES, FACES, EDGES])),
    ("a.ply", make_ply(">", [VERTICES, FACES])),
]


@pytest.mark.slow
@settings(
    deadline=None, max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    seed=st.sampled_from(SEEDS),
    edits=st.lists(st.tuples(st.integers(0, 400), st.binary(max_size=4)), min_size=1, max_size=4),
    cut=st.integers(0, 400),
)
@example(seed=SEEDS[0], edits=[(0, b"")], cut=0)
def test_a_damaged_file_is_read_or_refused_but_nothing_else(save, seed, edits, cut):
    name, data = seed
    for at, new in edits:
        at %= len(data) + 1
        data = data[:at] + new + data[at + len(new) :]
    path = save(name, data[: len(data) - cut % len(data)])
    try:
        loops = read_loops(path)
    except FileFormatError:
        return
    assert all(np.isfinite(loop).all() and len(loop) >= 3 for loop in loops)


# --- joining edges ---------------------------------------------------------------------------


@settings(deadline=None)
@given(
    faces=st.lists(
        st.lists(st.integers(0, 7), min_size=3, max_size=5, unique=True), min_size=1, max_size=12
    )
)
def test_boundary_edges_join_to_loops_that_use_each_once(faces):
    remaining = boundary_edges.boundary_edges(faces)
    loops = boundary_edges.join_edges(remaining)
    used = [(a, b) for loop in loops for a, b in zip(loop, loop[1:] + loop[:1], strict=True)]
    assert sorted(used) == sorted(remaining)
    assert all(len(set(loop)) == len(loop) for loop in loops)
    directed = [(f[k - 1], f[k]) for f in faces for k in range(len(f))]
    for a, b in itertools.combinations(range(8), 2):
        net = directed.count((a, b)) - directed.count((b, a))
        assert remaining.count((a, b)) - remaining.count((b, a)) == net
        assert min(remaining.count((a, b)), remaining.count((b, a))) == 0


# --- writing ---------------------------------------------------------------------------------


def test_a_file_appears_only_when_it_is_whole(tmp_path):
    target = tmp_path / "picture.png"
    with write_atomically(target) as partial:
        assert partial.parent == tmp_path
        assert partial.suffix == ".png"
        partial.write_text("new")
        assert not target.exists()
    assert target.read_text() == "new"
    assert list(tmp_path.iterdir()) == [target]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_error_leaves_the_old_file_and_nothing_else(tmp_path, error):
    target = tmp_path / "picture.png"
    target.write_text("old")

    def write_half():
        with write_atomically(target) as partial:
            partial.write_text("half")
            raise error

    with pytest.raises(error):
        write_half()
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_a_link_is_written_through(tmp_path):
    (tmp_path / "there").mkdir()
    link = tmp_path / "link.txt"
    link.symlink_to(tmp_path / "there" / "real.txt")
    with write_atomically(link) as partial:
        partial.write_text("new")
    assert link.is_symlink()
    assert (tmp_path / "there" / "real.txt").read_text() == "new"


def test_places_that_cannot_be_written_are_refused_before_the_work(tmp_path):
    with (
        pytest.raises(FileNotFoundError, match="create the folder"),
        write_atomically(tmp_path / "no" / "a.png"),
    ):
        pytest.fail("the block must not run")
    with pytest.raises(IsADirectoryError, match="it is a directory"), write_atomically(tmp_path):
        pytest.fail("the block must not run")
    with pytest.raises(FileNotFoundError), write_atomically(tmp_path / "a.png"):
        pass  # writes nothing


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs a disk that is always full")
def test_a_full_disk_is_said_and_nothing_is_left(tmp_path):
    target = tmp_path / "a.png"
    target.write_text("old")

    def fill():
        with write_atomically(target) as partial, open("/dev/full", "wb", buffering=0) as full:
            partial.write_text("half")
            full.write(b"more")

    with pytest.raises(OSError, match=r"cannot write .*a\.png: the disk is full; free") as caught:
        fill()
    assert caught.value.errno == errno.ENOSPC
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]
    assert target.read_text() == "old"


@pytest.mark.parametrize(
    ("number", "advice"),
    [
        (errno.ENOSPC, "the disk is full; free some space"),
        (errno.EDQUOT, "your share of the disk is used up"),
        (errno.EACCES, "you may not write in its folder"),
        (errno.EROFS, "its disk can only be read"),
        (errno.EIO, "Input/output error; name a file elsewhere"),
    ],
)
def test_what_the_system_refuses_is_said_before_the_work(tmp_path, monkeypatch, number, advice):
    def refused(*_, **__):
        raise OSError(number, os.strerror(number), str(tmp_path))

    monkeypatch.setattr("harnack.files.file_geometry.tempfile.TemporaryFile", refused)
    with pytest.raises(OSError, match=f"cannot write .*a.png: {advice}") as caught:
        check_writable(tmp_path / "a.png")
    assert caught.value.errno == number
    assert list(tmp_path.iterdir()) == []


def test_errors_about_other_files_are_passed_on(tmp_path):
    with (
        pytest.raises(FileNotFoundError, match="other"),
        write_atomically(tmp_path / "a.png"),
    ):
        (tmp_path / "other").read_bytes()


def test_devices_and_pipes_are_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "null.png").symlink_to("/dev/null")
    for name in ("pipe.png", "null.png"):
        with (
            pytest.raises(OSError, match="it is a device or a pipe, name an ordinary file"),
            write_atomically(tmp_path / name),
        ):
            raise AssertionError("the block must not begin")
    assert not os.path.isfile("/dev/null")


def test_a_link_that_leads_nowhere_is_said(tmp_path):
    (tmp_path / "a.obj").symlink_to("nowhere.obj")
    (tmp_path / "b.obj").symlink_to("b.obj")
    for name in ("a.obj", "b.obj"):
        with pytest.raises(FileFormatError, match="this is a link that leads to no file"):
            read_loops(tmp_path / name)


def test_names_in_messages_are_printable(tmp_path):
    with pytest.raises(FileFormatError, match=r"a\\x1b\[31m\\n.obj: there is no such file$"):
        read_loops(tmp_path / "a\x1b[31m\n.obj")
