"""Integrals over the wavelength by few nodes: Gauss rules built for a weight, and product rules on their nodes.

    int w(nm) f(nm) d nm ~ sum_j W_j f(nm_j)

The n nodes are those of the Gauss rule of a weight w0, by Lanczos' tridiagonalisation of its sum over a fine grid
(Golub & Welsch, Math. Comp. 23, 221, 1969; Gragg & Harrod, Numer. Math. 44, 317, 1984): exact for polynomials f up
to the order 2n - 1 where w is w0. Of any other weight w, W_j is the integral of w times the j-th Lagrange polynomial of
the nodes: exact up to the order n - 1."""

from __future__ import annotations

import numpy as np


def gauss_nodes(nm: np.ndarray, weight: np.ndarray, count: int) -> np.ndarray:
    """(count,) nodes in nm, ascending, of the Gauss rule of a weight >= 0 (N,) on a grid (N,); fewer where the weight
    has fewer places."""
    kept = weight > 0
    x, w = nm[kept], weight[kept] / weight[kept].sum()
    middle = float(w @ x)
    spread = float(np.sqrt(w @ (x - middle) ** 2))
    if spread == 0 or count == 1:
        return np.array([middle])
    x = (x - middle) / spread
    basis = [np.sqrt(w)]
    diagonal, beside = [], []
    for k in range(min(count, len(x))):
        diagonal.append(float(basis[k] @ (x * basis[k])))
        rest = x * basis[k]
        for _ in range(2):  # orthogonal to all before it, to rounding
            for known in basis:
                rest = rest - (rest @ known) * known
        length = float(np.linalg.norm(rest))
        if length < 1e-12:
            break
        beside.append(length)
        basis.append(rest / length)
    n = len(diagonal)
    matrix = np.diag(diagonal) + np.diag(beside[: n - 1], 1) + np.diag(beside[: n - 1], -1)
    return middle + spread * np.linalg.eigvalsh(matrix)


def lagrange(nodes: np.ndarray, nm: np.ndarray) -> np.ndarray:
    """(n, N) Lagrange polynomials of the nodes at wavelengths (N,)."""
    rows = []
    for j, node in enumerate(nodes):
        others = np.delete(nodes, j)
        rows.append(np.prod((nm[None] - others[:, None]) / (node - others[:, None]), axis=0))
    return np.array(rows)


def widths(nm: np.ndarray) -> np.ndarray:
    """(N,) weights of the trapezium rule at wavelengths (N,) in either order, nm; one alone has the width 1."""
    if len(nm) == 1:
        return np.ones(1)
    steps = np.abs(np.diff(nm)) / 2
    return np.append(steps, 0) + np.append(0, steps)
