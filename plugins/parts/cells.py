"""Cells: the fillings of a printed grid, columns x rows x layers of boxes in one mesh.

Definition
    cell (i, j, l):  |x - (i - (columns - 1)/2) pitch| <= (pitch - wall)/2, y alike with rows,
                     z from -(skin + l pitch + wall/2) to -(skin + (l + 1) pitch - wall/2)
`skin` of wall material lies between the touched face at z = 0 and the grid; walls of the thickness `wall` part the cells. The
normals point out of the cells, into the walls.
Fingerprint
    the grid's period and its walls' width, everywhere; a wrong wall moves all lines alike.
Validity
    boxes with flat faces. Numbers of cells are structure (XML integers).
References
    Fan, Li, Cong & Zhang, MagicGripper, III.A: cells of 0.6 to 1 mm, skins from 0.3 mm on.
"""

from optics.effect import Declared, Part
from optics.parameter import Parameter

PARAMETERS = (
    Parameter("pitch", "mm", 0.8, (0.05, 20.0), "from cell to cell", plausible=0.02, how="difference", step=1.0),
    Parameter("wall", "mm", 0.2, (0.001, 10.0), "thickness of the walls", plausible=0.02, how="difference", step=1.0),
    Parameter("skin", "mm", 0.5, (0.0, 20.0), "from the touched face to the grid", plausible=0.05, how="difference", step=1.0),
)


def build():
    import mitsuba as mi
    import numpy as np

    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    # two triangles a side, their normals outwards
    box = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
                    [1, 5, 7], [1, 7, 3]])

    class Cells(Declared.on_mesh()):
        kind = "cells"

        def __init__(self, props):
            self.counts = tuple(int(props.get(n, d)) for n, d in (("columns", 20), ("rows", 20), ("layers", 6)))
            if min(self.counts) < 1:
                raise ValueError(f"cells '{props.id()}': {self.counts} cells; allowed: one or more each way")
            props["face_normals"] = True
            number = int(np.prod(self.counts))
            mi.Mesh.__init__(self, "cells", 8 * number, 12 * number, props, False, False)
            self.declare(props)
            params = mi.traverse(self)
            params["faces"] = mi.UInt32((box + 8 * np.arange(number)[:, None, None]).astype(np.uint32).ravel())
            self.rebuild(params)

        def vertices(self):
            """(number, 8, 3) corners of the cells, mm; cells count layers first, then rows, then columns."""
            pitch, wall = self.number("pitch"), self.number("wall")
            if wall >= pitch:
                raise ValueError(f"{self.name}.wall = {wall:g} mm is no less than {self.name}.pitch = {pitch:g} mm; allowed: a wall "
                                 "thinner than the pitch")
            i, j, k = (a.ravel() for a in np.meshgrid(*map(np.arange, self.counts), indexing="ij"))
            low = np.stack([(i - self.counts[0] / 2) * pitch, (j - self.counts[1] / 2) * pitch,
                            -self.number("skin") - (k + 1) * pitch], -1) + wall / 2
            return low[:, None] + corners * (pitch - wall)

        def rebuild(self, params):
            self.placed = self.vertices()
            params["vertex_positions"] = mi.Float(self.placed.astype(np.float32).ravel())
            params.update()

        def cells(self):
            """Boxes around the cells: middles and sizes (number, 3) in mm, volumes (number,) in mm^3."""
            from types import SimpleNamespace

            low, high = self.placed.min(1), self.placed.max(1)
            edges = self.placed[:, [1, 2, 4]] - self.placed[:, :1]
            return SimpleNamespace(middles=(low + high) / 2, sizes=high - low, volumes=np.abs(np.linalg.det(edges)))

        def to_string(self):
            return f"Cells[{self.name}]"

    return Cells


part = Part("cells", "shape", PARAMETERS, build)
