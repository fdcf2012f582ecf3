"""Make the bundled parts in meshes/ and their catalogue from the constructions below (manifold3d, lengths in mm).

python tools/make_meshes.py           # write meshes/*.stl and meshes/catalogue.toml
python tools/make_meshes.py --check   # compare with what is there, byte for byte; exit status 1 if it differs
"""

from __future__ import annotations

import argparse
import itertools
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from manifold3d import CrossSection, JoinType, Manifold

from geomtact.geometry.mesh_file import load_mesh

sys.path.insert(0, str(Path(__file__).resolve().parent))
from meshprep.adding import catalogue_entry

FOLDER = Path(__file__).resolve().parents[1] / "meshes"
FINE = 128  # sides of a large circle: 6 micrometres from round at 20 mm radius

PARTS: dict[str, tuple[str, Callable[[], Manifold]]] = {}


def part(description: str) -> Callable:
    def register(build: Callable[[], Manifold]) -> Callable[[], Manifold]:
        PARTS[build.__name__] = (description, build)
        return build

    return register


# What the parts are made of.


def turned(profile: list[tuple[float, float]], n: int = FINE) -> Manifold:
    """Body of revolution about z from (radius, z) points, counterclockwise."""
    return Manifold.revolve(CrossSection([profile]), n)


def rod(radius: float, low: float, high: float, n: int = 48, top: float | None = None) -> Manifold:
    """Cylinder, or cone to the radius ``top``, along z."""
    return Manifold.cylinder(high - low, radius, radius if top is None else top, n).translate((0, 0, low))


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Manifold:
    size = np.subtract(high, low)
    return Manifold.cube(tuple(size)).translate(low)


def rounded(low: tuple[float, float, float], high: tuple[float, float, float], r: float, n: int = 24) -> Manifold:
    """Box with edges rounded to the radius ``r``."""
    ball = Manifold.sphere(r, n)
    corners = [
        (x, y, z)
        for x in (low[0] + r, high[0] - r)
        for y in (low[1] + r, high[1] - r)
        for z in (low[2] + r, high[2] - r)
    ]
    return Manifold.batch_hull([ball.translate(c) for c in corners])


def rectangle(w: float, h: float, r: float = 0.0) -> CrossSection:
    """Rectangle about the origin with corners rounded to the radius ``r``."""
    if r == 0:
        return CrossSection.square((w, h), True)
    return CrossSection.square((w - 2 * r, h - 2 * r), True).offset(r, JoinType.Round, 2.0, 32)


def stroke(points: list[tuple[float, float]], width: float, low: float, high: float) -> Manifold:
    """A line of this width along ``points``, raised from z = low to high."""
    dot = Manifold.cylinder(high - low, width / 2, 0.35 * width, 16)
    pieces = [
        Manifold.batch_hull([dot.translate((*a, low)), dot.translate((*b, low))]) for a, b in itertools.pairwise(points)
    ]
    return union(pieces)


def union(pieces: list[Manifold]) -> Manifold:
    total = Manifold()
    for piece in pieces:
        total += piece
    return total


def ring(piece: Manifold, n: int, start: float = 0.0) -> Manifold:
    """``n`` copies evenly about z."""
    return union([piece.rotate((0, 0, start + 360 * k / n)) for k in range(n)])


# The four parts of the thesis, 100 to 150 mm long.


@part("stepped pin with a head, a snap-ring groove and a cross hole for a split pin")
def pin() -> Manifold:
    body = turned(
        [(0, 0), (11, 0), (13, 2), (13, 8.5), (11.5, 10), (8.8, 10), (8, 10.8), (8, 74), (6.5, 75.5), (6.5, 94.0)]
        + [(5.3, 94.0), (5.3, 96.5), (6.5, 96.5), (6.5, 116), (4, 120), (0, 120)]
    )
    body -= rod(2.0, -20, 20, 48).rotate((0, 90, 0)).translate((0, 0, 107))
    body -= rod(5, -1, 1.2, 64)
    return body


@part("pin with a thick damping collar of rubber lips, grooves and a rounded tip")
def damping_pin() -> Manifold:
    profile = [(0.0, 0.0), (7, 0), (8, 1), (8, 24), (9, 25), (16, 25), (17.5, 26.5)]
    for k in range(5):  # lips of the collar: an arc outwards, a narrow groove between two
        z = 27.5 + 7 * k
        angle = np.radians(np.linspace(-90, 90, 9))
        profile += [(17.5 + 2.5 * float(np.cos(a)), z + 2.5 + 2.5 * float(np.sin(a))) for a in angle]
        profile += [(15.5, z + 5.4), (15.5, z + 6.6)] if k < 4 else []
    profile += [(17.5, 64), (16, 65), (9, 65), (8, 66), (8, 84)]
    for k in range(3):
        z = 84 + 4 * k
        profile += [(6.8, z + 0.6), (6.8, z + 1.9), (8, z + 2.5)]
    profile += [(8, 104)]
    angle = np.radians(np.linspace(0, 90, 13))
    profile += [(8 * float(np.cos(a)), 104 + 6 * float(np.sin(a))) for a in angle[1:-1]] + [(0, 110)]
    return turned(profile)


@part("head of a hand-held device: nose, fins, bores, a rail and raised signs; no symmetry")
def head() -> Manifold:
    block = rounded((0, -22, -18), (66, 22, 20), 5)
    block += rounded((8, -16, -27), (46, 12, -10), 4)

    def cone(inset: float) -> Manifold:
        wide = rod(16 - inset, 0, 1, 64).rotate((0, 90, 0)).translate((60, 2, -2))
        return Manifold.batch_hull([wide, rod(8.5 - inset, 0, 1, 64).rotate((0, 90, 0)).translate((98, 2, -7))])

    nose = cone(0)
    tip = turned([(0, 0), (8.5, 0), (8.5, 4), (7, 5.5), (7, 8), (8, 9), (8, 13), (6, 15), (3, 15), (3, 9), (0, 9)], 64)
    shape = block + nose + tip.rotate((0, 90, 0)).translate((97, 2, -7))
    neck = turned(
        [
            (0, -1),
            (13, -1),
            (13, 3),
            (11.5, 4.5),
            (13, 6),
            (11.5, 7.5),
            (13, 9),
            (11.5, 10.5),
            (13, 12),
            (13, 14),
            (0, 14),
        ],
        96,
    )
    shape += neck.rotate((0, -90, 0)).translate((0, -4, 4))
    shape -= rod(7, 6, 30, 64).rotate((0, -90, 0)).translate((0, -4, 4))
    for k in range(6):  # fins across the top, lower towards the nose
        shape += rounded((8 + 6 * k, -17, 15), (10.4 + 6 * k, 17, 25 - 0.6 * k), 1.1, 12)
    shape += rounded((46, 4, 14), (60, 16, 24), 2.5, 16) + rod(4, 20, 26.5, 48).translate((53, 10, 0))
    shape -= rod(2, 22, 40, 32).translate((53, 10, 0))
    for x, z, r in ((12, 8, 4.5), (26, 9, 3.2), (37, 10, 2.2), (18, -5, 2.2)):  # bores of the left side
        shape -= rod(r, 0, 12, 48).rotate((90, 0, 0)).translate((x, -15, z))
        shape -= rod(r, 0, 1.2, 48, r + 1.2).rotate((90, 0, 0)).translate((x, -20.81, z))
    shape += ring(box((4.5, -0.6, 0), (7, 0.6, 1.2)), 9).rotate((90, 0, 0)).translate((51, -21.6, 2))
    shape -= rod(3, -1, 5, 6).rotate((90, 0, 0)).translate((51, -18, 2))
    signs: list[list[tuple[float, float]]] = [
        [(9, 7), (7.5, 9.5), (3, 10), (0.5, 7.5), (0.5, 2.5), (3, 0), (7.5, 0.3), (9, 2), (9, 4.8), (5.5, 4.8)],
        [(13, 10), (20, 10), (15.8, 0)],
        [(25, 0), (25, 10), (31, 10), (32, 7.5), (31, 5), (25, 5)],
        [(40, 0), (36, 8), (44, 8), (40, 0)],
    ]
    letters = union([stroke(s, 1.8, 0, 1.6) for s in signs])
    # Raised on the right side, read from outside.
    shape += letters.rotate((90, 0, 180)).translate((58, 21, -3))
    shape += rounded((8, 19, -13), (58, 23.4, -9), 1.4, 12)
    for k in range(9):  # a rack along the right side's rail
        shape -= rod(1.1, -3, 3, 16).translate((12 + 5.2 * k, 23.6, -11))
    shape -= box((14, -20, -29), (18, 20, -24.5)) + box((26, -7, -29), (44, -3, -24.5))
    shape += ring(rod(1.3, 0, 2, 24).translate((4, 0, 0)), 5).translate((35, 5, -28.2))
    shape -= rod(2.5, -2, 12, 40).rotate((0, -35, 20)).translate((72, -10, 8))
    gills = union([box((72 + 4 * k, -30, -40), (73.4 + 4 * k, -2, 40)) for k in range(4)])
    return shape - (gills - cone(1.2))


@part("90 degree pipe elbow with bolted flanges, ribs and beads; a half turn swaps the ends")
def elbow_pipe() -> Manifold:
    bend, outer, inner, straight, thick = 52.0, 17.0, 12.5, 20.0, 8.0
    # One end: its face lies at z = -straight, the pipe rises along z and bends towards +x about the line (bend, y, 0).
    flange = turned([(0, 0), (29, 0), (30, 1), (30, thick - 1), (29, thick), (0, thick)], 96)
    flange -= ring(rod(3, -1, thick + 1, 32).translate((23.5, 0, 0)), 6, 30)
    flange -= ring(rod(2.2, -thick, 2 * thick, 24).translate((31, 0, 0)), 12)
    boss = rod(5.2, thick - 1, thick + 1.6, 6) - rod(3, -1, thick + 4, 32)
    flange += ring(boss.translate((23.5, 0, 0)), 6, 30)
    flange -= turned([(14.5, -1), (16, -1), (16, 1.2), (14.5, 1.2)], 96)
    end = flange + rod(outer, 0, straight, 96)
    end += turned([(0, thick - 1), (21, thick - 1), (21, thick + 0.4), (outer, thick + 4), (0, thick + 4)], 96)
    end += ring(box((outer - 2, -1.5, thick - 1), (outer + 4, 1.5, straight)), 6)

    def bent(section: CrossSection, first: float, last: float) -> Manifold:
        """``section`` about the pipe's middle swept from one angle of the bend to another [degrees]."""
        sweep = Manifold.revolve(section.translate((bend, 0)), max(3, round((last - first) / 3)), last - first)
        # revolve turns about z from +x towards +y: lay its axis along y and start at -x.
        sweep = sweep.transform(np.array([[-1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0]]))
        return sweep.rotate((0, first, 0)).translate((bend, 0, 0))

    end = end.translate((0, 0, -straight))
    for angle in (20, 35):
        end += bent(CrossSection.circle(outer + 2.2, 96), angle, angle + 4)
    R = np.array([[0.0, 0, -1], [0, -1, 0], [-1, 0, 0]])  # half turn about the bend's middle line, (-1, 0, 1) / sqrt(2)
    pivot = np.array([bend, 0, 0])
    swap = np.column_stack([R, pivot - R @ pivot])
    pipe = bent(CrossSection.circle(outer, 96), 0, 90) + bent(rectangle(2 * outer + 9, 4), 0, 90)
    bore = rod(inner, -straight - 1, 0.01, 96)
    return pipe + end + end.transform(swap) - bent(CrossSection.circle(inner, 96), 0, 90) - bore - bore.transform(swap)


# Small parts, 12 to 65 mm.


@part("hexagon nut of M16 size with chamfers, the thread drawn as rings")
def hex_nut() -> Manifold:
    nut = Manifold.cylinder(13, 24 / np.sqrt(3), -1, 6, True)
    nut ^= turned([(0, -6.5), (11.4, -6.5), (14.6, -4.65), (14.6, 4.65), (11.4, 6.5), (0, 6.5)])
    bore = [(0.0, -7.0), (8.5, -7), (8.5, -6.5), (6.9, -5.25)]
    for k in range(5):
        bore += [(8.0, -4 + 2 * k - 0.15), (8.0, -4 + 2 * k + 0.15), (6.9, -4 + 2 * k + 0.85)] if k < 4 else []
        bore += [(6.9, -4 + 2 * k + 1.15)] if k < 4 else []
    bore += [(8.0, 3.85), (8.0, 4.15), (6.9, 5.25), (8.5, 6.5), (8.5, 7), (0, 7)]
    return nut - turned(bore)


@part("stepped shaft with a feather keyway, a snap-ring groove, a flat and a centre hole")
def stepped_shaft() -> Manifold:
    shaft = turned(
        [(0, 0), (4.2, 0), (5, 0.8), (5, 5), (4.4, 5), (4.4, 6.2), (5, 6.2), (5, 14), (7, 14), (7, 30), (9, 30)]
        + [(9.6, 30.6), (9.6, 34.4), (9, 35), (6, 35), (6, 59), (5.2, 60), (0, 60)]
    )
    slot = rectangle(12, 4, 1.999).extrude(6).rotate((0, 0, 90)).rotate((90, 0, 90))
    shaft -= slot.translate((4.6, 0, 22))
    shaft -= box((-8, 4.7, 44), (8, 12, 61))
    shaft -= rod(1.25, -1, 4, 32) + rod(2.6, -0.01, 1.6, 32, 0.6)
    return shaft


@part("angle bracket with a gusset, a slot, two countersunk holes and rounded corners")
def bracket() -> Manifold:
    plate = rectangle(40, 28, 4).extrude(4).translate((20, 0, 0))
    plate += box((0, -14, 0), (10, 14, 4))
    wall = rectangle(28, 32, 4).extrude(4).rotate((90, 0, 90)).translate((0, 0, 16))
    wall += box((0, -14, 0), (4, 14, 12))
    shape = plate + wall
    angle = np.radians(np.linspace(270, 180, 9))
    hollow = [(5.5 + 5 * float(np.cos(a)), 5.5 + 5 * float(np.sin(a))) for a in angle]
    fillet = CrossSection([[(0, 0), (5.5, 0), *hollow, (0, 5.5)]])
    shape += fillet.extrude(28).rotate((90, 0, 0)).translate((3.5, 14, 3.5))
    gusset = CrossSection([[(0, 0), (24, 0), (24, 2), (2, 20), (0, 20)]]).extrude(3).rotate((90, 0, 0))
    shape += gusset.translate((3, 1.5, 3))
    for x, y in ((31, 8.5), (31, -8.5)):
        shape -= (rod(2.2, -1, 5, 40) + rod(2.2, 2.2, 4.01, 40, 4.0)).translate((x, y, 0))
    shape -= rectangle(10, 5, 2.499).extrude(8).rotate((90, 0, 90)).translate((-1, 7.5, 23))
    shape -= rod(3, -1, 6, 48).rotate((0, 90, 0)).translate((0, -7.5, 23))
    shape -= rod(4.6, -1, 1, 48).rotate((0, 90, 0)).translate((0, -7.5, 23))
    return shape


@part("spur gear, module 1.5, 24 teeth, with a hub and six lightening holes")
def gear() -> Manifold:
    module, teeth = 1.5, 24
    pitch, base = module * teeth / 2, module * teeth / 2 * np.cos(np.radians(20))
    tip, root = pitch + module, pitch - 1.25 * module
    radius = np.linspace(base, tip, 8)
    unwound = np.sqrt((radius / base) ** 2 - 1)
    flank = unwound - np.arctan(unwound)  # involute function
    half = np.pi / 2 / teeth + np.tan(np.radians(20)) - np.radians(20) - flank
    side = [(root, np.pi / teeth - 0.035), (root, half[0] + 0.005), *zip(radius, half, strict=True)]
    tooth = [(r, -a) for r, a in side] + [(r, a) for r, a in side[::-1]]
    outline = [
        (float(r * np.cos(a + 2 * np.pi * k / teeth)), float(r * np.sin(a + 2 * np.pi * k / teeth)))
        for k in range(teeth)
        for r, a in tooth
    ]
    body = CrossSection([outline]).extrude(9)
    body ^= turned([(0, 0), (tip - 0.7, 0), (tip + 0.2, 0.9), (tip + 0.2, 8.1), (tip - 0.7, 9), (0, 9)])
    body += turned([(0, 8), (8, 8), (8, 13.2), (7.2, 14), (0, 14)], 96)
    body -= turned([(8.0, 7.8), (15, 7.8), (15, 10), (8.0, 10)], 96)
    body -= ring(rod(2.4, -1, 10, 48).translate((11.5, 0, 0)), 6)
    return body - turned([(0, -1), (4.6, -1), (4.6, 0), (4, 0.6), (4, 13.4), (4.6, 14), (4.6, 15), (0, 15)], 96)


@part("cable plug: ten contacts in a keyed shroud, latch and ribbed strain relief")
def connector_plug() -> Manifold:
    shell = rounded((-13, -7, 0), (13, 7, 20), 1.5, 24) + box((-12, -6, 14), (12, 6, 22))
    shell -= rectangle(21, 9, 1).extrude(8).translate((0, 0, 15))
    shell -= box((-11.0, 4.0, 15), (-6, 5.4, 23))
    contact = box((-0.6, -0.6, 13), (0.6, 0.6, 21.2)) + Manifold.batch_hull(
        [box((-0.6, -0.6, 21), (0.6, 0.6, 21.2)), box((-0.25, -0.25, 21.2), (0.25, 0.25, 21.8))]
    )
    shell += union([contact.translate((3.8 * (i - 2), 2.2 * (2 * j - 1), 0)) for i in range(5) for j in range(2)])
    latch = CrossSection([[(0, 2), (2.6, 4), (3.0, 6), (1.4, 17), (2.6, 17.6), (2.6, 18.6), (1.2, 20.5), (0, 20.5)]])
    shell += latch.extrude(8).rotate((90, 0, 90)).translate((-1, 6.5, 0))
    for k in range(4):
        shell += rounded((-14, -5, 4 + 2.4 * k), (-12, 5, 5.2 + 2.4 * k), 0.55, 12)
        shell += rounded((12, -5, 4 + 2.4 * k), (14, 5, 5.2 + 2.4 * k), 0.55, 12)
    boot = Manifold.batch_hull(
        [rectangle(18, 11, 4).extrude(0.1).translate((2, 0, 0.5)), rod(4.2, -20, -19.9, 64).translate((2, 0, 0))]
    )
    for k in range(5):
        boot -= box((-20, -20, -17.4 + 3.2 * k), (20, 20, -16 + 3.2 * k)) - rod(3.9 + 0.45 * k, -21, 1, 64).translate(
            (2, 0, 0)
        )
    boot += rod(2.7, -26, -19, 48).translate((2, 0, 0))
    return shell + boot


@part("ball of 12 mm diameter")
def ball() -> Manifold:
    return Manifold.sphere(6, FINE)


# Files.


def stl_bytes(solid: Manifold) -> bytes:
    """Binary STL in a canonical order: the same triangles give the same bytes."""
    mesh = solid.simplify(2e-3).to_mesh64()
    vertices = np.round(np.asarray(mesh.vert_properties)[:, :3], 5).astype("<f4") + np.float32(0)
    vertices, index = np.unique(vertices, axis=0, return_inverse=True)
    faces = index.reshape(-1)[np.asarray(mesh.tri_verts, dtype=np.int64)]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(1)]
    faces = np.take_along_axis(faces, (faces.argmin(1)[:, None] + np.arange(3)) % 3, axis=1)
    faces = faces[np.lexsort(faces.T[::-1])]
    record = np.zeros(len(faces), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    record["corners"] = vertices[faces]
    # Normals are left zero, as the format allows: readers take them from the corners.
    return b"geomtact part, millimetres".ljust(80) + np.uint32(len(faces)).tobytes() + record.tobytes()


def make(names: list[str]) -> dict[str, bytes]:
    """Contents by file name."""
    files: dict[str, bytes] = {}
    catalogue = (
        "# Made by tools/make_meshes.py. Turns of 1/order about axis through centre_mm generate the rotation group.\n"
    )
    with tempfile.TemporaryDirectory() as folder:
        for name in sorted(names):
            description, build = PARTS[name]
            content = stl_bytes(build())
            path = Path(folder) / f"{name}.stl"
            path.write_bytes(content)
            mesh = load_mesh(path, "mm").with_symmetry()
            assert mesh.symmetry is not None
            files[path.name] = content
            catalogue += "\n" + catalogue_entry(path, "mm", "MIT", description, mesh.symmetry)
            size = 1e3 * np.ptp(mesh.vertices, axis=0)
            print(
                f"{name:15s} {len(mesh.faces):6d} faces  {size[0]:5.1f} x {size[1]:5.1f} x {size[2]:5.1f} mm  "
                f"{mesh.symmetry.kind} {len(mesh.symmetry.elements)}"
            )
    files["catalogue.toml"] = catalogue.encode()
    return files


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="compare with meshes/ instead of writing")
    check = parser.parse_args().check
    files = make(list(PARTS))
    FOLDER.mkdir(exist_ok=True)
    status = 0
    for name, content in files.items():
        path = FOLDER / name
        if check and (not path.is_file() or path.read_bytes() != content):
            print(f"{path} differs from what this tool makes", file=sys.stderr)
            status = 1
        elif not check:
            path.write_bytes(content)
    return status


if __name__ == "__main__":
    sys.exit(main())
