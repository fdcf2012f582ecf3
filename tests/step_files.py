"""STEP files (AP214) in millimetres, written by hand: a solid of flat faces, and a cylinder."""

import numpy as np

_HEAD = """ISO-10303-21;
HEADER;
FILE_DESCRIPTION((''),'2;1');
FILE_NAME('part','',(''),(''),'','','');
FILE_SCHEMA(('AUTOMOTIVE_DESIGN { 1 0 10303 214 1 1 1 1 }'));
ENDSEC;
DATA;
"""
_CONTEXT = (
    "APPLICATION_CONTEXT('automotive design')",
    "PRODUCT_CONTEXT('',#1,'mechanical')",
    "PRODUCT('part','part','',(#2))",
    "PRODUCT_DEFINITION_FORMATION('','',#3)",
    "PRODUCT_DEFINITION_CONTEXT('part definition',#1,'design')",
    "PRODUCT_DEFINITION('design','',#4,#5)",
    "PRODUCT_DEFINITION_SHAPE('','',#6)",
    "(LENGTH_UNIT()NAMED_UNIT(*)SI_UNIT(.MILLI.,.METRE.))",
    "(NAMED_UNIT(*)PLANE_ANGLE_UNIT()SI_UNIT($,.RADIAN.))",
    "(NAMED_UNIT(*)SI_UNIT($,.STERADIAN.)SOLID_ANGLE_UNIT())",
    "UNCERTAINTY_MEASURE_WITH_UNIT(LENGTH_MEASURE(1.E-6),#8,'distance_accuracy_value','')",
    "(GEOMETRIC_REPRESENTATION_CONTEXT(3)GLOBAL_UNCERTAINTY_ASSIGNED_CONTEXT((#11))"
    "GLOBAL_UNIT_ASSIGNED_CONTEXT((#8,#9,#10))REPRESENTATION_CONTEXT('',''))",
)


class _File:
    """The lines of a file, each an entity; methods give the entity's number."""

    def __init__(self):
        self.lines = list(_CONTEXT)

    def add(self, text):
        self.lines.append(text)
        return f"#{len(self.lines)}"

    def point(self, v):
        return self.add(f"CARTESIAN_POINT('',({v[0]:.12E},{v[1]:.12E},{v[2]:.12E}))")

    def corner(self, v):
        return self.add(f"VERTEX_POINT('',{self.point(v)})")

    def direction(self, v):
        v = np.asarray(v, float) / np.linalg.norm(v)
        return self.add(f"DIRECTION('',({v[0]:.12E},{v[1]:.12E},{v[2]:.12E}))")

    def placed(self, at, z, x):
        return self.add(f"AXIS2_PLACEMENT_3D('',{self.point(at)},{self.direction(z)},{self.direction(x)})")

    def straight(self, at, along):
        vector = self.add(f"VECTOR('',{self.direction(along)},1.)")
        return self.add(f"LINE('',{self.point(at)},{vector})")

    def edge(self, start, end, curve):
        return self.add(f"EDGE_CURVE('',{start},{end},{curve},.T.)")

    def face(self, walked, surface):
        """A face within ``walked``, edges each with whether it is walked forwards."""
        oriented = [self.add(f"ORIENTED_EDGE('',*,*,{edge},.{'T' if along else 'F'}.)") for edge, along in walked]
        loop = self.add(f"EDGE_LOOP('',({','.join(oriented)}))")
        bound = self.add(f"FACE_OUTER_BOUND('',{loop},.T.)")
        return self.add(f"ADVANCED_FACE('',({bound}),{surface},.T.)")

    def plane(self, at, z, x):
        return self.add(f"PLANE('',{self.placed(at, z, x)})")

    def text(self, faces):
        """The whole file, of a solid within ``faces``."""
        shell = self.add(f"CLOSED_SHELL('',({','.join(faces)}))")
        solid = self.add(f"MANIFOLD_SOLID_BREP('part',{shell})")
        shape = self.add(f"ADVANCED_BREP_SHAPE_REPRESENTATION('',({solid}),#12)")
        self.add(f"SHAPE_DEFINITION_REPRESENTATION(#7,{shape})")
        data = "".join(f"#{number}={line};\n" for number, line in enumerate(self.lines, 1))
        return _HEAD + data + "ENDSEC;\nEND-ISO-10303-21;\n"


def solid_step(vertices, faces):
    """Of flat triangles ``faces`` (m, 3) between ``vertices`` (n, 3)."""
    file = _File()
    corners = [file.corner(v) for v in vertices]
    edges, shell = {}, []
    for face in faces.tolist():
        walked = []
        for a, b in zip(face, [*face[1:], face[0]], strict=True):
            low, high = min(a, b), max(a, b)
            if (low, high) not in edges:
                curve = file.straight(vertices[low], vertices[high] - vertices[low])
                edges[low, high] = file.edge(corners[low], corners[high], curve)
            walked.append((edges[low, high], a == low))
        a, b, c = vertices[face]
        shell.append(file.face(walked, file.plane(a, np.cross(b - a, c - a), b - a)))
    return file.text(shell)


def cylinder_step(radius, height):
    """Of a cylinder about z, its middle at the origin."""
    file, z, x = _File(), np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
    ends = [-0.5 * height * z, 0.5 * height * z]
    corners = [file.corner(end + radius * x) for end in ends]
    rims = [
        file.edge(corner, corner, file.add(f"CIRCLE('',{file.placed(end, z, x)},{radius:.12E})"))
        for corner, end in zip(corners, ends, strict=True)
    ]
    seam = file.edge(*corners, file.straight(ends[0] + radius * x, z))
    side = file.add(f"CYLINDRICAL_SURFACE('',{file.placed(ends[0], z, x)},{radius:.12E})")
    return file.text(
        [
            file.face([(rims[0], True), (seam, True), (rims[1], False), (seam, False)], side),
            file.face([(rims[0], False)], file.plane(ends[0], -z, x)),
            file.face([(rims[1], True)], file.plane(ends[1], z, x)),
        ]
    )
