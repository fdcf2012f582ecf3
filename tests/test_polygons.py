"""Polygons of mesh files: read as they are written, and covered once by triangles that leave no corner out."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geomtact.errors import MeshError
from geomtact.geometry.mesh_file import load_mesh
from geomtact.geometry.obj_file import read_obj
from geomtact.geometry.off_file import read_off
from geomtact.geometry.ply_file import read_ply
from geomtact.geometry.polygon_file import READERS, read_triangles
from geomtact.geometry.polygons import Polygons
from geomtact.geometry.solid import folded_faces
from geomtact.geometry.stl_file import read_stl
from geomtact.se3 import random_rotations

BIG, LITTLE = ">", "<"
L_SHAPE = np.array([(0, 0), (30, 0), (30, 8), (8, 8), (8, 20), (0, 20)], float)


def simple_polygon(n, rng, straight=0):
    """A random polygon (n + straight, 2) that does not cross itself, ``straight`` of its corners on sides."""
    kind = rng.choice(["star", "comb", "tour"])
    angle = 2 * np.pi * (np.arange(n) + rng.uniform(0.05, 0.95, n)) / n
    ring = rng.uniform(2, 20, n)[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    if kind == "comb" and n > 5:  # no single point sees all of its teeth
        m = n // 2
        x = 4.0 * np.arange(n - m)
        teeth = np.stack([x[:m], rng.uniform(1, 9, m) + 20 * (np.arange(m) % 2)], 1)
        ring = np.concatenate([np.stack([x, 0 * x], 1), teeth[::-1]])
    elif kind == "tour":
        ring = untangled(rng.uniform(0, 40, (n, 2)))
    ring = np.round(1024 * ring) / 1024
    for _ in range(straight):
        k = int(rng.integers(len(ring)))
        ring = np.insert(ring, k + 1, 0.5 * (ring[k] + ring[(k + 1) % len(ring)]), axis=0)
    return ring


def untangled(ring):
    """The corners in an order in which no two sides cross: each crossing that is undone makes the outline shorter."""
    n = len(ring)
    i, j = np.triu_indices(n, 2)
    while True:
        a, b, c, d = ring[i], ring[(i + 1) % n], ring[j], ring[(j + 1) % n]

        def side(p, q, r):
            return np.sign((q - p)[:, 0] * (r - p)[:, 1] - (q - p)[:, 1] * (r - p)[:, 0])

        crossing = np.flatnonzero((side(a, b, c) * side(a, b, d) < 0) & (side(c, d, a) * side(c, d, b) < 0))
        if not len(crossing):
            return ring
        k = crossing[0]
        ring = np.concatenate([ring[: i[k] + 1], ring[i[k] + 1 : j[k] + 1][::-1], ring[j[k] + 1 :]])


def shoelace(ring):
    x, y = ring.T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))


def prism(ring, height, first=0):
    """Vertices (2 n, 3) and polygons of a ring raised by ``height``: two caps, and a wall at each side."""
    ring = ring if shoelace(ring) > 0 else ring[::-1]
    n = len(ring)
    vertices = np.concatenate([np.column_stack([ring, np.full(n, z)]) for z in (0.0, height)])
    round_ = [(k + first) % n for k in range(n)]
    caps = [round_[::-1], [n + k for k in round_]]
    return vertices, caps + [[k, (k + 1) % n, n + (k + 1) % n, n + k] for k in range(n)]


def measured(polygons):
    """Area and volume of the triangles, and that they close without a hole and use all corners."""
    faces, owner = polygons.triangles()
    a, b, c = np.moveaxis(polygons.vertices[faces], 1, 0)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    there, back = ({tuple(e) for e in some.tolist()} for some in (edges, edges[:, ::-1]))
    assert there == back and len(there) == len(edges)
    assert set(faces.ravel().tolist()) == set(polygons.corners.tolist())
    assert (np.bincount(owner, minlength=len(polygons.sizes)) == polygons.sizes - 2).all()
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum(), float(
        np.einsum("ij,ij->", a, np.cross(b, c)) / 6
    )


def as_obj(vertices, faces, rng=None):
    """An OBJ file; with ``rng`` every face after the vertices it needs, in any style of index, with all that lines may hold."""
    lines, given = [], 0
    numbers = [" ".join(repr(float(x)) for x in v) for v in vertices]
    if rng is None:
        return "\n".join(
            [*(f"v {n}" for n in numbers), *("f " + " ".join(str(k + 1) for k in f) for f in faces)]
        ).encode()
    ends, gap = rng.choice(["\n", "\r\n"]), rng.choice([" ", "\t", "  "])
    colour = " 0.5 0.5 0.5" if rng.random() < 0.5 else ""
    for face in sorted(faces, key=max):
        while given <= max(face):
            lines.append(f"v{gap}{numbers[given].replace(' ', gap)}{colour}{rng.choice(['', ' # a corner', ' #'])}")
            given += 1
        words = []
        for k in face:
            index = str(k - given) if rng.random() < 0.5 else str(k + 1)
            words.append(index + rng.choice(["", "/1", "//1", "/1/1"]))
        if rng.random() < 0.2:
            words.insert(2, "\\" + ends)
        lines.append(rng.choice(["", "  "]) + f"f{gap}" + gap.join(words) + rng.choice(["", " ", "\t# a face"]))
        lines.append(
            rng.choice(["o one", "g a b", "s off", "usemtl m", "vn 0 0 1", "vt 0 0", "l 1 2", "p 1", "", "# f 1 2 3"])
        )
    return ends.join([str(line) for line in lines]).encode()


def as_off(vertices, faces, head="OFF\n{} {} 0", extra=""):
    rows = [" ".join(repr(float(x)) for x in v) + extra for v in vertices]
    rows += [" ".join(map(str, [len(f), *f])) + " 255 0 0" for f in faces]
    return "\n".join(["# a file", head.format(len(vertices), len(faces)), "", *rows, ""]).encode()


def as_ply(vertices, faces, form="ascii", count="uchar", index="int", extras=False):
    """A PLY file; ``extras``: with colours, texture coordinates of each face, and edges."""
    codes = {
        "uchar": "u1",
        "int": "i4",
        "uint": "u4",
        "ushort": "u2",
        "short": "i2",
        "int8": "i1",
        "uint8": "u1",
        "char": "i1",
    }
    order = BIG if "big" in form else LITTLE
    head = ["ply", f"format {form} 1.0", "comment made for a test", f"element vertex {len(vertices)}"]
    head += [f"property double {x}" for x in "xyz"] + ["property uchar red"] * extras
    head += [f"element edge {extras * 1}", "property int vertex1", "property int vertex2"]
    head += [f"element face {len(faces)}", *["property float quality"] * extras]
    head += [
        f"property list {count} {index} vertex_indices",
        *["property list uchar float texcoord"] * extras,
        "end_header",
        "",
    ]
    words, body = [], b""
    for v in vertices:
        words += [*map(repr, map(float, v)), *["200"] * extras]
        body += np.array(v, order + "f8").tobytes() + b"\xc8" * extras
    if extras:
        words += ["0", "1"]
        body += np.array([0, 1], order + "i4").tobytes()
    for face in faces:
        if extras:
            words.append("0.25")
            body += np.array(0.25, order + "f4").tobytes()
        words += map(str, [len(face), *face])
        body += np.array(len(face), order + codes[count]).tobytes() + np.array(face, order + codes[index]).tobytes()
        if extras:
            words += [str(2 * len(face)), *["0.5"] * (2 * len(face))]
            body += np.array(2 * len(face), "u1").tobytes() + np.full(2 * len(face), 0.5, order + "f4").tobytes()
    return "\n".join(head).encode() + (" ".join(words).encode() if form == "ascii" else body)


FORMS = ("ascii", "binary_little_endian", "binary_big_endian")


@settings(max_examples=150, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(3, 40), straight=st.integers(0, 4), tilted=st.booleans())
def test_prisms_of_any_polygon_have_their_area_and_volume_in_every_format(seed, n, straight, tilted):
    rng = np.random.default_rng(seed)
    ring, height = simple_polygon(n, rng, straight), 6.0
    if rng.random() < 0.5:
        ring = ring[::-1]
    vertices, faces = prism(ring, height, int(rng.integers(n)))
    area, base = sum(np.linalg.norm(ring - np.roll(ring, 1, axis=0), axis=1)), abs(shoelace(ring))
    expected = 2 * base + height * area, base * height
    if tilted:
        vertices = vertices @ random_rotations(1, rng)[0].T + rng.uniform(-50, 50, 3)
    form, count, index = (
        str(rng.choice(some)) for some in (FORMS, ("uchar", "int", "ushort"), ("int", "uint", "ushort", "uint8"))
    )
    for polygons in (
        read_obj(as_obj(vertices, faces)),
        read_obj(as_obj(vertices, faces, rng)),
        read_off(as_off(vertices, faces)),
        read_ply(as_ply(vertices, faces)),
        read_ply(as_ply(vertices, faces, form, count, index, bool(rng.random() < 0.5))),
    ):
        assert measured(polygons) == pytest.approx(expected, rel=1e-9)
        for some in (polygons.vertices, polygons.vertices.astype(np.float32).astype(float)):
            assert len(folded_faces(some, polygons.triangles()[0])) == 0


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(4, 40), straight=st.integers(0, 4))
def test_a_fan_that_covers_more_than_the_polygon_is_folded(seed, n, straight):
    rng = np.random.default_rng(seed)
    ring = simple_polygon(n, rng, straight)
    vertices, faces = prism(ring, 6.0)
    fans = np.array([(f[0], f[k], f[k + 1]) for f in faces for k in range(1, len(f) - 1)])
    a, b, c = np.moveaxis(vertices[fans], 1, 0)
    covered = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    right = measured(Polygons.of(vertices, faces))[0]
    turned = vertices @ random_rotations(1, rng)[0].T
    for some in (vertices, turned, np.asarray(turned, np.float32).astype(float)):
        if not right * (1 + 1e-9) < covered < right * (1 + 1e-3):
            assert (len(folded_faces(some, fans)) > 0) == (covered > right * (1 + 1e-9))


@pytest.mark.parametrize("first", range(6))
@pytest.mark.parametrize("suffix", [".obj", ".off", ".ply"])
def test_an_l_shape_is_one_mesh_whatever_its_first_corner_and_format(first, suffix, tmp_path):
    vertices, faces = prism(L_SHAPE, 6.0, first)
    path = tmp_path / f"l{suffix}"
    path.write_bytes({".obj": as_obj, ".off": as_off, ".ply": as_ply}[suffix](vertices, faces))
    mesh = load_mesh(path, "mm")
    assert 1e6 * mesh.areas.sum() == pytest.approx(1272, rel=1e-6) and mesh.warnings == ()


@pytest.mark.parametrize(
    ("ring", "area"),
    [
        # holes are joined to the rim by two sides that coincide, as modellers write them; once with the corners repeated
        ([(0, 0), (10, 0), (10, 10), (0, 10), (0, 0), (3, 3), (3, 6), (6, 6), (6, 3), (3, 3)], 91),
        ([(0, 0), (10, 0), (10, 10), (0, 10), (0, 5), (3, 5), (3, 6), (6, 6), (6, 3), (3, 3), (3, 5), (0, 5)], 91),
        ([(0, 0), (5, 5), (10, 0), (10, 10), (5, 5), (0, 10)], 50),  # two triangles that meet at a point
        ([(0, 0), (10, 0), (10, 10), (10, 20), (10, 10), (0, 10)], 100),  # a spike
        ([(0, 0), (5, 0), (10, 0), (0, 10)], 50),  # a triangle with a corner on its side
        ([(0, 0), (5, 0), (10, 0), (0, 0), (0, 0)], 0),  # all on a line
        ([(0, 0), (4, 4), (8, 0), (4, 12)], 32),  # an arrow head
    ],
)
def test_polygons_that_touch_themselves_are_covered_once(ring, area, rng):
    for first, turn in itertools.product(range(len(ring)), (np.eye(3), *random_rotations(2, rng))):
        vertices = np.column_stack([np.roll(ring, first, axis=0), np.zeros(len(ring))]) @ turn.T
        faces, _ = Polygons.of(vertices, [range(len(ring))]).triangles()
        a, b, c = np.moveaxis(vertices[faces], 1, 0)
        assert 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() == pytest.approx(area, abs=1e-6)
        assert len(faces) == len(ring) - 2


@pytest.mark.parametrize(
    "ring",
    [
        [(0, 0), (10, 10), (10, 0), (0, 10)],
        [(0, 0), (10, 10), (10, 0), (0, 10), (-5, 5)],
        [(0, 3), (2, -2), (-3, 1), (3, 1), (-2, -2)],
    ],
)
def test_a_face_that_crosses_itself_is_refused(ring, tmp_path):
    vertices = np.column_stack([ring, np.zeros(len(ring))])
    (tmp_path / "a.obj").write_bytes(as_obj(vertices, [range(len(ring))]))
    with pytest.raises(
        MeshError, match=r"a\.obj: face 1, of \d corners about .*, crosses itself.*cut it into triangles"
    ):
        load_mesh(tmp_path / "a.obj", "mm")


def test_a_face_that_is_not_flat_is_loaded_with_a_note(tmp_path):
    vertices, faces = prism(L_SHAPE, 6.0)
    for lift, warned in ((0.01, 0), (0.3, 1)):
        bent = vertices.copy()
        bent[6, 2] += lift
        (tmp_path / "a.obj").write_bytes(as_obj(bent, faces))
        warnings = load_mesh(tmp_path / "a.obj", "mm").warnings
        assert len(warnings) == warned and all("1 of 8 faces are not flat, by up to 0.196 mm" in w for w in warnings)


def test_many_faces_are_read_quickly_and_quads_as_two_triangles():
    n = 200
    k = np.arange(n * n).reshape(n, n)[:-1, :-1].ravel()
    x, y = np.divmod(np.arange(n * n), n)
    vertices = np.column_stack([x, y, np.sin(0.1 * x)])
    quads = np.stack([k, k + n, k + n + 1, k + 1], axis=1)
    faces, owner = Polygons.of(vertices, quads).triangles()
    np.testing.assert_array_equal(faces, np.stack([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]], 1).reshape(-1, 3))
    np.testing.assert_array_equal(owner, np.repeat(np.arange(len(k)), 2))


BOX = prism(np.array([(0, 0), (10, 0), (10, 8), (0, 8)], float), 6.0)
BOX_TRIANGLES = Polygons.of(*BOX).triangles()[0]


@pytest.mark.parametrize(
    "head",
    [
        "OFF\n{} {} 12",
        "OFF {} {} 0",
        "OFF\n{} {}",
        "COFF # colours\n{} {} 0",
        "NOFF\n{} {} 0",
        "STOFF\n{} {} 0",
        "NCOFF\n{} {} 0",
        "CNOFF {} {}",
        "STCNOFF\n{} {} 0",
        "OFF{} {} 0",
        "off\n{} {} 0",
        "coff\n{} {} 0",
        "{} {} 12",
        "{} {}",
    ],
)
def test_off_headers(head):
    polygons = read_off(as_off(*BOX, head, " 0 0 1 0.5" if "C" in head.upper() or "N" in head else ""))
    assert measured(polygons) == pytest.approx((376, 480)) and polygons.warnings == ()


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), head=st.sampled_from(["OFF ", "OFF\n", "off ", "OFF", ""]))
def test_off_is_read_in_its_order_however_it_lies_on_lines(seed, head):
    rng = np.random.default_rng(seed)
    vertices, faces = prism(simple_polygon(int(rng.integers(3, 12)), rng), 6.0)
    words = [len(vertices), len(faces), 0, *vertices.ravel().tolist(), *(k for f in faces for k in (len(f), *f))]
    text = head + "".join(f"{word!r}{rng.choice([' ', chr(10), ' # 7' + chr(10)])}" for word in words)
    polygons = read_off(text.encode())
    np.testing.assert_array_equal(polygons.vertices, vertices)
    np.testing.assert_array_equal(polygons.corners, np.concatenate(faces))
    np.testing.assert_array_equal(polygons.sizes, [len(f) for f in faces])


def test_off_with_colours_is_read_by_lines_alone():
    text = as_off(*BOX)
    for joined in (text.replace(b" 255 0 0\n", b" 255 0 0 "), as_off(*BOX, "COFF\n{} {} 0").replace(b"0.0\n", b"0.0 ")):
        with pytest.raises(MeshError, match="is cut short: expected 8 vertices and 6 faces, a line each"):
            read_off(joined)


@pytest.mark.parametrize(
    "word", ["1.#INF", "-1.#IND00", "1.#QNAN", "1.#J", "nan", "1_0", "1__0", "0x10", "1,5", "1d3", "1#"]
)
@pytest.mark.parametrize("suffix", [".obj", ".off", ".ply", ".stl"])
def test_a_word_that_is_no_finite_number_is_refused(word, suffix, tmp_path):
    vertices = np.where(BOX[0] == 10, 777, BOX[0])
    written = {".obj": as_obj, ".off": as_off, ".ply": as_ply}.get(suffix)
    data = written(vertices, BOX[1]) if written else as_stl_text(vertices, BOX_TRIANGLES)
    path = tmp_path / f"a{suffix}"
    path.write_bytes(data.replace(b"777.0", b"777").replace(b"777", word.encode(), 1))
    with pytest.raises(MeshError, match="three numbers|NaN, infinity|words among its numbers") as caught:
        load_mesh(path, "mm")
    if "." in word and suffix in (".obj", ".off"):
        assert "vertices hold NaN, infinity" in str(caught.value)


@pytest.mark.parametrize("suffix", [".obj", ".off", ".ply"])
def test_an_index_with_an_underscore_is_refused(suffix, tmp_path):
    data = {".obj": as_obj, ".off": as_off, ".ply": as_ply}[suffix](*BOX)
    path = tmp_path / f"a{suffix}"
    path.write_bytes(data.replace(b"f 4 3", b"f 0_4 3").replace(b"4 3 2 1 0", b"4 0_3 2 1 0"))
    assert b"_" in path.read_bytes().replace(b"end_header", b"").replace(b"vertex_indices", b"")
    with pytest.raises(MeshError, match="whole numbers|words among"):
        load_mesh(path, "mm")


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_a_line_of_obj_is_continued_but_no_comment(end):
    text = as_obj(*BOX).decode().splitlines()
    lines = ["# C:\\parts\\", text[0] + " # \\", *text[1:8], "g a \\", "b", "#\\", text[8].replace(" ", " \\" + end)]
    assert measured(read_obj(end.join([*lines, *text[9:]]).encode())) == pytest.approx((376, 480))
    with pytest.raises(MeshError, match="line 3 cannot be read.*got 'v 1  2 x'"):
        read_obj(b"# \\\nv 1 \\\n2 x")


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be"])
@pytest.mark.parametrize("suffix", [".obj", ".off", ".ply", ".stl"])
def test_text_in_utf_16_is_named(encoding, suffix, tmp_path):
    data = as_stl_text(BOX[0], BOX_TRIANGLES)
    if suffix != ".stl":
        data = {".obj": as_obj, ".off": as_off, ".ply": as_ply}[suffix](*BOX)
    path = tmp_path / f"a{suffix}"
    path.write_bytes(b"\xef\xbb\xbf" + data)
    assert 1e6 * load_mesh(path, "mm").areas.sum() == pytest.approx(376)
    path.write_bytes(data.decode().encode(encoding))
    with pytest.raises(
        MeshError, match=rf"a\{suffix}: is UTF-16 text, expected ASCII or UTF-8; save or export it as that"
    ):
        load_mesh(path, "mm")


@pytest.mark.parametrize(
    ("reader", "data", "words"),
    [
        (read_off, b"4OFF\n1 0 0\n0 0 0 1\n", "another number of coordinates"),
        (read_off, b"C4nOFF\n3\n1 0 0\n0 0 0 1\n", "another number of coordinates"),
        (read_off, b"noff\n3\n1 0 0\n0 0 0 1\n", "another number of coordinates"),
        (read_off, b"OFF BINARY\n1 0 0\n", "in binary, which is not read"),
        (read_off, as_off(*BOX)[:-30], r"is cut short: expected 8 vertices and 6 faces"),
        (read_off, as_off(*BOX).replace(b"4 0 1 5", b"4 0 x 5"), "expected a face's number"),
        (read_off, b"ply\n", "expected OFF"),
        (read_obj, b"v 0 0 0\nv 1 0 0\nf 1 2 -3\n", "line 3 cannot be read.*got 'f 1 2 -3'"),
        (read_obj, b"v 0 0 0\nf 0 1 2\n", "line 2 cannot be read"),
        (read_obj, b"v 0,5 0 0\n", "line 1 cannot be read"),
        (read_obj, b"v 0 0 0\ncstype bspline\nsurf 0 1 0 1 1\n", "free-form .*surf.*export it as polygons"),
        (read_obj, b"call other.obj\n", "calls other files"),
        (read_ply, b"ply\nformat binary_middle 1.0\nend_header\n", "expected a format"),
        (read_ply, b"ply\nformat ascii 1.0\nelement vertex 1\nproperty quad x\nend_header\n1", "at 'property quad x'"),
        (
            read_ply,
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1",
            "expected vertices with x, y and z",
        ),
        (read_ply, as_ply(*BOX)[:-9], "is cut short: expected 6 rows of face"),
        (read_ply, as_ply(*BOX, "binary_little_endian")[:-9], "is cut short: expected 6 rows of face"),
        (
            read_ply,
            as_ply(*BOX).replace(b"vertex_indices", b"corners"),
            "expected faces with vertex_indices, got corners",
        ),
        (read_ply, as_ply(*BOX) + b" 1 2", "more numbers than its header"),
    ],
)
def test_what_cannot_be_read_is_named(reader, data, words):
    with pytest.raises(MeshError, match=words):
        reader(data)


def test_numbers_out_of_any_range_are_refused_or_unused(tmp_path):
    for far, used in ((1e200, True), (float("nan"), True), (1e50, False)):
        vertices, faces = BOX
        vertices = np.concatenate([vertices, [[far, 0, 0]]])
        (tmp_path / "a.obj").write_bytes(as_obj(vertices, [*faces, [0, 1, 8]] if used else faces))
        if used:
            with pytest.raises(MeshError, match="NaN, infinity or numbers beyond 1e"):
                load_mesh(tmp_path / "a.obj", "mm")
        else:
            assert 1e6 * load_mesh(tmp_path / "a.obj", "mm").areas.sum() == pytest.approx(376)


def test_skipped_elements_are_noted():
    assert "2 bytes after the last row" in read_ply(as_ply(*BOX, "binary_little_endian") + b"ab").warnings[0]
    assert "1 lines after the last face" in read_off(as_off(*BOX) + b"\n1 0").warnings[0]
    assert "surf" in read_obj(as_obj(*BOX) + b"\nsurf 0 1 0 1 1").warnings[0]


@pytest.mark.parametrize("end", [b"\n", b"\r\n", b"\r"])
def test_ply_headers_end_in_any_line_ending(end):
    head, body = as_ply(*BOX, "binary_big_endian").split(b"end_header\n")
    # a body that begins as a line ends is not mistaken for one
    assert measured(read_ply((head + b"end_header\n").replace(b"\n", end) + body)) == pytest.approx((376, 480))


def test_triangle_strips_of_ply():
    vertices = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], float)
    strip = [0, 2, 1, 3, 0, 2, -1, 2, 3, 1][:6]
    for form in FORMS:
        data = as_ply(vertices, [[*strip, -1], [-1]], form).replace(b"element face", b"element tristrips")
        area, volume = measured(read_ply(data))
        assert (area, volume) == pytest.approx((1.5 + np.sqrt(3) / 2, 1 / 6))


def as_stl(vertices, faces, count=None):
    rows = np.zeros(len(faces), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    rows["corners"] = vertices[faces]
    return (
        b"solid of another kind".ljust(80)
        + (len(faces) if count is None else count).to_bytes(4, "little")
        + rows.tobytes()
    )


def as_stl_text(vertices, faces, name="part"):
    rows = [
        "facet normal 0 0 0\nouter loop\n"
        + "".join(f"vertex {x:g} {y:g} {z:g}\n" for x, y, z in f)
        + "endloop\nendfacet\n"
        for f in vertices[faces]
    ]
    return f"solid {name}\n{''.join(rows)}endsolid {name}\n".encode()


WHOLE, TEXT = as_stl(BOX[0], BOX_TRIANGLES), as_stl_text(BOX[0], BOX_TRIANGLES)


@pytest.mark.parametrize(
    ("data", "warned"),
    [
        (WHOLE, None),
        (WHOLE + b"\0" * 37, "37 bytes after the last triangle are passed over"),
        (WHOLE + b"\0" * 100, "100 bytes after"),
        (WHOLE + b"COLOR=" * 30, "180 bytes after"),
        (as_stl(*BOX[:1], BOX_TRIANGLES, 0), "says that it holds 0 triangles; all 12 that are there are read"),
        (as_stl(*BOX[:1], BOX_TRIANGLES, 5), "says that it holds 5 triangles; all 12"),
        (as_stl(*BOX[:1], BOX_TRIANGLES, 99), "says that it holds 99 triangles; the 12 that are there close a surface"),
        (TEXT, None),
        (TEXT.upper().replace(b"SOLID", b"Solid").replace(b"\n", b"\r\n"), None),
        (b"\xef\xbb\xbf\n " + TEXT + b"\0\0", None),
        (TEXT.replace(b"endsolid", b"end solid"), None),
        (TEXT.replace(b"part", b"facet vertex 1 2 3 endfacet"), None),
        (TEXT[: TEXT.rindex(b"endsolid")], "does not end with endsolid"),
    ],
)
def test_stl_that_is_beyond_doubt_is_read(data, warned):
    polygons = read_stl(data)
    assert measured(welded(polygons)) == pytest.approx((376, 480))
    assert [warned in text for text in polygons.warnings] == [True] * (warned is not None)


def welded(polygons):
    vertices, index = np.unique(polygons.vertices, axis=0, return_inverse=True)
    return Polygons(vertices, index.ravel()[polygons.corners], polygons.sizes)


def test_several_solids_of_text_are_one_mesh():
    moved = as_stl_text(BOX[0] + [20, 0, 0], BOX_TRIANGLES, "two words")
    assert measured(welded(read_stl(TEXT + moved))) == pytest.approx((752, 960))


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (WHOLE[:-50], "is cut short: expected 684 bytes .*, found 634"),
        (WHOLE[:-7], "is cut short"),
        # two boxes, of which the header counts the first: both interpretations close
        (
            as_stl(np.concatenate([BOX[0], BOX[0] + 20]), np.concatenate([BOX_TRIANGLES, BOX_TRIANGLES + 8]), 12),
            "for 24",
        ),
        (as_stl(*BOX[:1], BOX_TRIANGLES[:-1], 5), "says that it holds 5 triangles, but is long enough for 11"),
        (TEXT[:-60], "is cut short: 1 of 12 facets are not ended"),
        (
            as_stl_text(BOX[0], BOX_TRIANGLES[:9]).partition(b"endsolid")[0],
            "is cut short: endsolid is missing after 9 facets",
        ),
        (TEXT.replace(b"vertex 10 0 0", b"vertex 10 O 0"), "not three numbers"),
        (TEXT.replace(b"vertex 10 0 0\n", b"", 1), "expected three corners in each of 12 facets, found 35"),
        (b"x", "neither STL text nor"),
        (b"; made by hand\n" + TEXT, "is neither STL text nor STL in binary"),
    ],
)
def test_stl_in_doubt_is_refused(data, words):
    with pytest.raises(MeshError, match=words):
        read_stl(data)


@pytest.mark.parametrize("how", ["fan", "flap"])
def test_a_surface_folded_back_is_refused(how, tmp_path):
    vertices, faces = prism(L_SHAPE, 6.0, 0)
    fans = np.array([(f[0], f[k], f[k + 1]) for f in faces for k in range(1, len(f) - 1)])
    if how == "flap":
        vertices, fans = np.concatenate([BOX[0], [[5, 4, 20]]]), np.concatenate([BOX_TRIANGLES, [[4, 6, 8], [6, 4, 8]]])
    (tmp_path / "a.stl").write_bytes(as_stl(vertices, fans))
    with pytest.raises(MeshError, match=r"a\.stl: faces of [\d.]+ mm2 are folded back .*; export it with its polygons"):
        load_mesh(tmp_path / "a.stl", "mm")


@pytest.mark.parametrize(("radius", "n"), [(3, 64), (3, 256), (5, 256)])
def test_all_of_a_fold_is_found_however_many_faces_it_has(radius, n):
    """A plate with a round notch, its two caps cut up by fans: what a fan covers beyond the cap, it covers twice more."""
    turn = np.linspace(0, np.pi, n + 1)
    notch = np.stack([12 + radius * np.cos(turn), 18 - radius * np.sin(turn)], 1)
    ring = np.concatenate([[[0, 0], [24, 0], [24, 18]], notch, [[0, 18]]])
    m = len(ring)
    vertices = np.concatenate([np.c_[ring, np.zeros(m)], np.c_[ring, np.full(m, 5)]])
    k, after = np.arange(m), np.roll(np.arange(m), -1)
    fan = np.stack([0 * k[1:-1], k[1:-1], k[2:]], 1)
    walls = np.concatenate([np.stack([k, after, m + after], 1), np.stack([k, m + after, m + k], 1)])
    faces = np.concatenate([fan[:, ::-1], m + fan, walls])

    def area(of):
        a, b, c = np.moveaxis(vertices[of], 1, 0)
        return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()

    x, y = ring.T
    cap = 0.5 * abs((x * np.roll(y, -1) - y * np.roll(x, -1)).sum())
    assert area(faces[folded_faces(vertices, faces)]) == pytest.approx(area(fan) - cap, rel=1e-9)


def test_a_thin_blade_is_no_fold():
    """Two faces that meet at half a degree, and two sides of a foil, near the origin and far from it."""
    foil = np.array([(0, 0), (30, 0), (30, 0.01), (0, 0.01)], float)
    for ring, length, far in itertools.product(
        (np.array([(0, 0), (30, 0.13), (30, -0.13)]), foil), (1.0, 100.0), (0, 1e4)
    ):
        vertices, faces = prism(ring, length)
        assert len(folded_faces(vertices + far, Polygons.of(vertices, faces).triangles()[0])) == 0


@pytest.mark.parametrize(
    ("file", "area", "warned"),
    [(f"ngon_L{k}.obj", 1272, 0) for k in range(6)]
    + [("ngon_L0.ply", 1272, 0), ("ngon_L3.ply", 1272, 0), ("ngon_L0.off", 1272, 0), ("hex_ngon.off", 879.615, 0)]
    + [("mixed_bin.ply", 760, 0), ("neg_two_bodies.obj", 496, 0), ("trailing.stl", 1456.255, 1)],
)
def test_small_files_that_were_read_wrong(data_folder, file, area, warned):
    mesh = load_mesh(data_folder / "inputs" / file, "mm")
    assert 1e6 * mesh.areas.sum() == pytest.approx(area, rel=1e-6) and len(mesh.warnings) == warned
    if "neg" in file:
        np.testing.assert_allclose(1e3 * mesh.vertices[:, 0][[0, -1]], [-5, 19], atol=1e-6)


def test_a_truncated_text_is_named_as_such(data_folder):
    with pytest.raises(MeshError, match=r"asc_cut\.stl: is cut short: 1 of 140 facets are not ended"):
        load_mesh(data_folder / "inputs" / "asc_cut.stl", "mm")


def test_of_all_sound_meshes_one_scan_has_small_folds(data_folder):
    folded = {}
    for path in sorted(p for p in data_folder.glob("*/**/*.*") if "mesh" in str(p) and p.suffix.lower() in READERS):
        if "dirty" in str(path):
            continue
        polygons, faces, _ = read_triangles(path)
        vertices, index = np.unique(polygons.vertices, axis=0, return_inverse=True)
        if len(folds := folded_faces(vertices, index.ravel()[faces])):
            folded[path.name] = len(folds)
    assert set(folded) == {"040_large_marker.obj"}
    (warning,) = load_mesh(data_folder / "hsp_digit_sim_ycb" / "meshes" / "040_large_marker.obj", "m").warnings
    assert "faces of 0.198 mm2 are folded back" in warning
