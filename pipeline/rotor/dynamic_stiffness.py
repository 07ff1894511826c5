"""The dynamic stiffness ``D(w)`` of many speeds at once, kept and solved as band matrices.

    D(w) = -w^2 M + j w (C + W G) + K                                        (paper, eq. 1)

with excitation frequency w and rotor speed W (equal for unbalance). Beam elements couple neighbouring nodes
only, so all four matrices share one narrow band: storage and solution cost grow linearly with the nodes. Seals
add their impedance at the rotor speed W. Casings, which come last among the nodes, follow the bearings that they hold
in the band. The modes of a base, which every pedestal moves with, are a border of it, which Schur's complement solves.

Legend: n DOF, S speeds, R right-hand sides, u band width on either side of the diagonal, b DOF of the border.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.errors import PipelineError
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.interpolation import bearing_places
from pipeline.rotor.model import DOF_PER_NODE, RotorModel, Seals, casing_dof, list_translations
from pipeline.write_numbers import write_number

_NO_BLOCKS = np.empty((0, 0))


@dataclass(frozen=True, eq=False)
class BandedStiffness:
    """Diagonals of M, C, G, K restricted to ``dof``, each ``(m, 2 u + 1)``: row j holds the column ``order[j]``.

    The last b of the order are the border, which only impedances couple with the rest.
    """

    dof: np.ndarray  # (m,) which DOF of the rotor
    order: np.ndarray  # (m,) positions within ``dof``, as they follow each other in the band
    bandwidth: int  # u
    mass: np.ndarray
    damping: np.ndarray
    gyroscopic: np.ndarray
    stiffness: np.ndarray
    seals: Seals
    seal_places: np.ndarray  # (T, 2) places of x and y of the seals in the band; -1 where they are not
    border: int = 0  # b


def banded(rotor: RotorModel, dof: np.ndarray | None = None) -> BandedStiffness:
    """The rotor's matrices as diagonals, for all DOF or the ascending ``dof`` only."""
    dof = np.arange(rotor.n_dof) if dof is None else dof
    reach, by = rotor.reach, np.array(rotor.casings) + 0.5
    positions = np.array([*range(rotor.n_nodes), *(by[(reach == x).any(axis=1)].mean() for x, _ in casing_dof(rotor))])
    places, border = positions[dof // DOF_PER_NODE], np.isin(dof, casing_dof(rotor)) & (rotor.participation.size > 0)
    order = np.argsort(np.where(border, np.inf, places), kind="stable")
    ordered = dof[order]
    blocks = [a[np.ix_(ordered, ordered)] for a in (rotor.mass, rotor.damping, rotor.gyroscopic, rotor.stiffness)]
    rows, columns = np.nonzero(np.any([block != 0 for block in blocks], axis=0))
    # A bearing couples its node with what moves its casing.
    held = _locate(bearing_places(rotor).dof, ordered)
    held = np.where(held < len(dof) - border.sum(), held, held[:, :1])
    least = np.ptp(held, axis=1).max(initial=0) if rotor.casings else 0
    bandwidth = int(np.abs(rows - columns).max(initial=least))
    places = _locate(list_translations(rotor.seals.nodes), ordered)
    bandwidth = max(bandwidth, int((places >= 0).all(axis=-1).any()))  # x and y of a seal lie side by side
    mass, damping, gyroscopic, stiffness = (_columns(block, bandwidth) for block in blocks)
    return BandedStiffness(
        dof, order, bandwidth, mass, damping, gyroscopic, stiffness, rotor.seals, places, int(border.sum())
    )


def _locate(wanted: np.ndarray, dof: np.ndarray) -> np.ndarray:
    """Positions of the ``wanted`` (T, k) within ``dof`` (m,); -1 where they are not."""
    positions = {int(index): i for i, index in enumerate(dof)}
    return np.array([positions.get(int(index), -1) for index in wanted.ravel()], dtype=int).reshape(wanted.shape)


def _columns(matrix: np.ndarray, bandwidth: int) -> np.ndarray:
    """(m, 2 u + 1): of each column the rows of the band, zero beyond the matrix."""
    columns = np.arange(len(matrix))[:, None]
    beyond = np.pad(matrix, ((bandwidth, bandwidth), (0, 0)))
    return np.ascontiguousarray(beyond[columns + np.arange(2 * bandwidth + 1), columns])


def solve(
    system: BandedStiffness,
    frequencies: np.ndarray,
    speeds: np.ndarray,
    right: np.ndarray,
    impedance: np.ndarray = _NO_BLOCKS,
    impedance_dof: np.ndarray = _NO_BLOCKS,
    transposed: bool = False,
    chunk_size: int = 16,
) -> np.ndarray:
    """Solve ``D(w) X = right`` at every speed, or ``D(w)' X = right`` if ``transposed``.

    Args:
        frequencies: (S,) excitation frequencies w, rad/s.
        speeds: (S,) rotor speeds W, rad/s.
        right: (S, m, R) complex.
        impedance: (B, S, k, k) complex blocks added at ``impedance_dof`` (B, k), positions within
            ``system.dof``.
        chunk_size: speeds that are assembled at once: few enough to stay in the processor's cache.

    Returns:
        (S, m, R) complex. Raises PipelineError where D is singular or the result is not finite.
    """
    from scipy.linalg import lapack

    width, inner = system.bandwidth, len(system.dof) - system.border
    # Right-hand sides in Fortran order, too: LAPACK then leaves the solution in their place, and nothing is copied.
    solution = np.asarray(np.take(right.swapaxes(1, 2), system.order, axis=2), dtype=complex)
    impedance_places = np.argsort(system.order)[impedance_dof.astype(int)]
    # LAPACK's band storage in Fortran order, seen in C order as (speed, column, row), with u rows of room for
    # pivoting. A chunk of speeds is assembled at once.
    band = np.empty((min(chunk_size, len(speeds)), len(system.dof), 3 * width + 1), dtype=complex)
    for start in range(0, len(speeds), chunk_size):
        chunk = slice(start, min(start + chunk_size, len(speeds)))
        band[:, :, :width] = 0.0
        matrix, w, speed = band[: chunk.stop - start, :, width:], frequencies[chunk], speeds[chunk]
        matrix.real = system.stiffness - w[:, None, None] ** 2 * system.mass
        matrix.imag = w[:, None, None] * (system.damping + speed[:, None, None] * system.gyroscopic)
        # The border's rows, and its columns.
        edges = np.zeros((2, len(w), system.border, len(system.dof)), dtype=complex)
        seals = zip(system.seals.impedance(w, speed), system.seal_places, strict=True)
        for block, places in (*zip(impedance[:, chunk], impedance_places, strict=True), *seals):
            for i, j in np.argwhere((places[:, None] >= 0) & (places >= 0)):
                if max(p := places[i], q := places[j]) < inner or p == q:
                    matrix[:, q, width + p - q] += block[:, i, j]
                else:
                    edge, line, at = (0, p, q) if p >= inner else (1, q, p)
                    edges[edge, :, line - inner, at] += block[:, i, j]
        for s in range(chunk.start, chunk.stop):
            factor, pivots, info = lapack.zgbtrf(band[s - start, :inner].T, width, width, overwrite_ab=True)
            sides, (rows, columns) = solution[s], edges[:: 1 - 2 * transposed, s - start]
            if system.border:
                sides = np.concatenate([sides[:, :inner], columns[:, :inner]])
            lapack.zgbtrs(factor, width, width, sides.T, pivots, trans=int(transposed), overwrite_b=True)
            if system.border:
                corner = edges[0, s - start, :, inner:] + np.diag(matrix[s - start, inner:, width])
                seen, through = sides[: -system.border], sides[-system.border :]
                schur = (corner.T if transposed else corner) - rows[:, :inner] @ through.T
                *_, driven, info = lapack.zgesv(schur, solution[s, :, inner:].T - rows[:, :inner] @ seen.T)
                solution[s] = np.concatenate([seen - driven.T @ through, driven.T], axis=1)
            if info != 0:
                solution[s] = np.nan
    finite = np.isfinite(solution).all(axis=(1, 2))
    if not finite.all():
        raise PipelineError(
            "The dynamic stiffness must be regular to give a response, but it is singular at "
            f"{write_number(speeds[~finite][0], digits=6)} rad/s: check bearings and supports of the rotor"
        )
    result = np.empty_like(right, dtype=complex)
    result[:, system.order] = solution.swapaxes(1, 2)
    return result


def apply(
    rotor: RotorModel,
    rows: np.ndarray,
    columns: np.ndarray,
    frequencies: np.ndarray,
    speeds: np.ndarray,
    x: np.ndarray,
) -> np.ndarray:
    """The product ``D(w)[rows, columns] @ x`` at every speed: (S, rows, R) from ``x`` (S, columns, R).

    The matrices are sparse: the cost grows with what couples, not with the square of the nodes.
    """
    parts = [a[np.ix_(rows, columns)] for a in (rotor.mass, rotor.damping, rotor.gyroscopic, rotor.stiffness)]
    mass, damping, gyroscopic, stiffness = np.split(multiply(np.concatenate(parts), x), len(parts), axis=1)
    w, speed = frequencies[:, None, None], speeds[:, None, None]
    product = stiffness - w**2 * mass + 1j * w * (damping + speed * gyroscopic)
    at_rows, at_columns = (_locate(list_translations(rotor.seals.nodes), dof) for dof in (rows, columns))
    seals = rotor.seals.impedance(frequencies, speeds)
    for t, i, j in np.argwhere((at_rows[:, :, None] >= 0) & (at_columns[:, None] >= 0)):
        product[:, at_rows[t, i]] += seals[t, :, i, j, None] * x[:, at_columns[t, j]]
    return np.asarray(product)


def multiply(matrix: np.ndarray, x: np.ndarray) -> np.ndarray:
    """``matrix @ x``, (S, rows, R) from ``x`` (S, columns, R), at the cost of the entries that are not zero."""
    from scipy.sparse import csr_array

    flat = np.moveaxis(x, 1, 0).reshape(len(x[0]), -1)
    return np.moveaxis((csr_array(matrix) @ flat).reshape(len(matrix), len(x), -1), 0, 1)


def assemble_systems(rotor: RotorModel, bearings: BearingTable) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``M``, ``C + W G + C_b`` and ``K + K_b`` with the seals, (S, n, n) each, at the speeds of ``bearings``.

    The first is (n, n) where there are no seals.
    """
    shape = (len(bearings.speeds), *rotor.mass.shape)
    mass = np.broadcast_to(rotor.mass, shape).copy() if rotor.seals.nodes else rotor.mass
    damping = rotor.damping + bearings.speeds[:, None, None] * rotor.gyroscopic
    stiffness = np.broadcast_to(rotor.stiffness, shape).copy()
    blocks, places = bearings.values.reshape(*bearings.values.shape[:2], 2, 2, 2), bearing_places(rotor)
    held = [*zip(places.spread(blocks), places.dof, strict=True)]
    held += zip(rotor.seals.matrices(bearings.speeds), list_translations(rotor.seals.nodes), strict=True)
    for block, dof in held:
        for b, total in zip(range(block.shape[1]), (stiffness, damping, mass), strict=False):  # bearings have no mass
            total[(slice(None), *np.ix_(dof, dof))] += block[:, b]
    return mass, damping, stiffness
