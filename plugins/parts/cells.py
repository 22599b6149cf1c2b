"""Cells: the fillings of a printed grid, columns x rows x layers of boxes in one mesh.

Definition
    cell (i, j, l):  |x - (i - (columns - 1)/2) pitch| <= (pitch - wall)/2, y alike with rows,
                     z from -(skin + l pitch + wall/2) to -(skin + (l + 1) pitch - wall/2)
with `wall` + `wall_error` for the wall. A cell that was not filled lacks the share u = `unfilled` of its filling: index
1 + (n - 1)(1 - u), absorption and scattering times (1 - u). Which cell is said by `unfilled_column`, `unfilled_row` and
`unfilled_layer`, from 0 on, layers from the touched face. `skin` of wall material lies between the touched face at z =
0 and the grid; walls of the thickness `wall` part the cells. The normals point out of the cells, into the walls. Where
the scene has a `block` that gives way, its corners move with it.
Fingerprint
    the grid's period and its walls' width, everywhere; a wrong wall moves all lines alike.
Validity
    boxes with flat faces; deformed ones are flat in two triangles a side. Numbers of cells are structure (XML
    integers).
References
    Fan, Li, Cong & Zhang, MagicGripper, III.A: cells of 0.6 to 1 mm, skins from 0.3 mm on.
XML
    columns integer, 20: cells along x
    rows integer, 20: cells along y
    layers integer, 6: cells along z
"""

from optics.scene.checking import agree, made
from optics.scene.declare import Part
from optics.scene.mitsuba_parts import Declared
from optics.scene.parameter import Parameter

PARAMETERS = (
    Parameter("pitch", "mm", 0.8, (0.05, 20.0), "from cell to cell", plausible=0.02, how="difference", step=1.0),
    Parameter("wall", "mm", 0.2, (0.001, 10.0), "thickness of the walls", plausible=0.02, how="difference", step=1.0),
    Parameter(
        "skin", "mm", 0.5, (0.0, 20.0), "from the touched face to the grid", plausible=0.05, how="difference", step=1.0
    ),
    Parameter(
        "wall_error",
        "mm",
        0.0,
        (-5.0, 5.0),
        "by which walls are thicker than `wall`",
        neutral=0.0,
        plausible=0.02,
        how="difference",
        step=1.0,
    ),
    Parameter(
        "unfilled",
        "1",
        0.0,
        (0.0, 1.0),
        "share of its filling that one cell lacks",
        neutral=0.0,
        plausible=1.0,
        how="difference",
    ),
    *(
        Parameter(f"unfilled_{axis}", "1", 0.0, (0.0, 9999.0), f"{axis} of that cell", how="difference")
        for axis in ("column", "row", "layer")
    ),
)


def build():
    from types import SimpleNamespace

    import mitsuba as mi
    import numpy as np

    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    # two triangles a side, their normals outwards
    box = np.array(
        [
            [0, 1, 3],
            [0, 3, 2],
            [4, 6, 7],
            [4, 7, 5],
            [0, 4, 5],
            [0, 5, 1],
            [2, 3, 7],
            [2, 7, 6],
            [0, 2, 6],
            [0, 6, 4],
            [1, 5, 7],
            [1, 7, 3],
        ]
    )

    class Cells(Declared.on_mesh()):
        kind = "cells"
        moved_by = "block"
        block = None

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
            pitch, wall = self.number("pitch"), self.number("wall") + self.number("wall_error")
            if not 0 < wall < pitch:
                raise ValueError(
                    f"{self.name}.wall + wall_error = {wall:g} mm; allowed: above 0 and below {self.name}.pitch = "
                    f"{pitch:g} mm"
                )
            i, j, k = (a.ravel() for a in np.meshgrid(*map(np.arange, self.counts), indexing="ij"))
            low = (
                np.stack(
                    [
                        (i - self.counts[0] / 2) * pitch,
                        (j - self.counts[1] / 2) * pitch,
                        -self.number("skin") - (k + 1) * pitch,
                    ],
                    -1,
                )
                + wall / 2
            )
            return low[:, None] + corners * (pitch - wall)

        def wire(self, scene):
            self.block = scene.one("block")
            self.follow(self.block)

        def rebuild(self, params):
            """Vertices for the present parameters, moved as the present press moves the block."""
            self.placed = self.vertices()
            self.moved = self.block is not None and self.block.press() is not None
            if self.moved:
                self.placed = self.placed + self.block.displacement(self.placed)
            params["vertex_positions"] = mi.Float(self.placed.astype(np.float32).ravel())
            params.update()

        def lacking(self):
            """(number of the cell that was not filled, share of the filling that it lacks)."""
            place = [int(round(self.number(f"unfilled_{axis}"))) for axis in ("column", "row", "layer")]
            for at, count, axis in zip(place, self.counts, ("column", "row", "layer")):
                if at >= count:
                    raise ValueError(f"{self.name}.unfilled_{axis} = {at}; allowed: 0 to {count - 1}")
            return int(np.ravel_multi_index(place, self.counts)), self.number("unfilled")

        def cells(self, parts):
            """Maps from the world to places 0 ... 1 in each cell, and volumes of its parts.

            origins (number, 3) mm and rows (number, 3, 3) 1/mm:  place = rows (p - origin), of the parallelepiped
            nearest to the cell
            volumes (number, parts^3) mm^3, of what of the cell has its place in each part; x outermost
            """
            middles = self.placed.mean(1)
            edges = np.einsum("nci,cj->nij", self.placed, corners - 0.5) / 2  # columns: along x, y and z
            rows = np.linalg.inv(edges)
            origins = middles - edges.sum(2) / 2
            volumes = np.repeat(np.abs(np.linalg.det(edges))[:, None] / parts**3, parts**3, 1)
            if self.moved:
                volumes = self.shares(origins, rows, parts) * volumes.sum(1, keepdims=True)
            return SimpleNamespace(origins=origins, rows=rows, volumes=volumes)

        def shares(self, origins, rows, parts, fine=8):
            """(number, parts^3) volumes over that of the parallelepiped, by a grid of points in each cell (faces
            trilinear)."""
            t = (np.arange(fine) + 0.5) / fine
            t = np.stack(np.meshgrid(t, t, t, indexing="ij"), -1).reshape(-1, 3)  # (points, 3)
            factors = np.where(corners == 1, t[:, None], 1 - t[:, None])  # (points, 8, 3)
            local = np.einsum("nij,nkj->nki", rows, self.placed - origins[:, None])
            places = np.einsum("pk,nki->npi", factors.prod(2), local)
            slopes = np.stack(
                [
                    np.einsum("pk,nki->npi", (2 * corners[:, a] - 1) * np.delete(factors, a, 2).prod(2), local)
                    for a in range(3)
                ],
                -1,
            )
            part = (np.clip(places, 0, 1 - 1e-6) * parts).astype(int)
            part = (
                (part[..., 0] * parts + part[..., 1]) * parts + part[..., 2] + parts**3 * np.arange(len(rows))[:, None]
            )
            found = np.bincount(part.ravel(), np.abs(np.linalg.det(slopes)).ravel() / fine**3, len(rows) * parts**3)
            return np.maximum(found.reshape(len(rows), -1), 1e-3 / parts**3)

        def to_string(self):
            return f"Cells[{self.name}]"

    return Cells


def check_boxes():
    """Cells of pitch - wall each way, the first layer's tops half a wall below the skin; their volumes."""
    import numpy as np

    grid = made("cells", columns=2, rows=1, layers=2, pitch=0.8, wall=0.2, skin=0.5, bsdf={"type": "clear"})
    corners = grid.vertices()
    agree(corners.max(1)[0], [-0.1, 0.3, -0.6], 0, 1e-6)
    agree(corners.min((0, 1)), [-0.7, -0.3, -2.0], 0, 1e-6)
    agree(grid.cells(1).volumes, np.full((4, 1), 0.6**3), 1e-5)


def random(rng):
    """A grid that a printer of droplets makes."""
    return {"pitch": rng.uniform(0.6, 1.0), "wall": rng.uniform(0.1, 0.3), "skin": rng.uniform(0.3, 0.8)}


part = Part("cells", "shape", PARAMETERS, build, checks=(check_boxes,), random=random)
