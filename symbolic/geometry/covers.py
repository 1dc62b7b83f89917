"""Covers of a body by few simple shapes, with which the compiled screening computes.

Each body has two covers: `slab_cover` by boxes, cylinders, spheres and capsules with exact support
functions, and `chain_cover` by a chain of equal spheres. Exact functions of
`symbolic.geometry.pieces` prove that both contain the body.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray

from symbolic.array import Array
from symbolic.errors import CollisionModelError
from symbolic.geometry.bodies import CollisionBody
from symbolic.geometry.pairs import CellGeometry
from symbolic.geometry.pieces import (
    Hull,
    Piece,
    SphereChain,
    bounding_box,
    contains,
    sphere_chain,
    support,
)
from symbolic.records import Box
from symbolic.records.content import CacheKey, digest_of_parts
from symbolic.records.poses import rotation_from_vector

MERGE_SLACK = 0.004
"""Pieces are merged into one box if the box stands out from their hull by at most this [m]."""

SLENDERNESS = 1.3
"""Length of a chain's slabs over the body's width. Larger values give fewer and larger spheres."""


OVERLAP_POSTURES = 200
"""Number of random postures in which chains of spheres are tested for overlap."""

OFTEN = 0.5
"""A pair gets the finer bound if its chains overlap in at least this share of the postures."""


def _directions() -> Array:
    grid = np.array([u for u in product((-2, -1, 0, 1, 2), repeat=3) if any(u)], dtype=float)
    return np.asarray(grid / np.linalg.norm(grid, axis=1, keepdims=True))


_DIRECTIONS = _directions()


def slab_cover(body: CollisionBody) -> tuple[Piece, ...]:
    """Return a cover of a body: boxes, cylinders, spheres and capsules whose union contains the
    body.

    A simple shape is its own cover. A hull gets the smallest box in one of a few orientations.
    Pieces inside a box of the cover are dropped, and pieces that nearly fill a common box are
    merged.
    """
    return _slab_cover(CacheKey(body.pieces, body.name))


@lru_cache(maxsize=256)
def _slab_cover(seen: CacheKey) -> tuple[Piece, ...]:
    pieces, name = seen.given
    cover = _outermost([_simple(piece) for piece in pieces])
    while (merged := _merge_once(cover)) is not None:
        cover = _outermost(merged)
    for piece in pieces:
        if not _covered(piece, cover):
            raise CollisionModelError(f"the cover of {name!r} does not contain it")
    return tuple(cover)


def chain_cover(body: CollisionBody) -> SphereChain:
    """Cover a body by equal spheres in a row along its longest principal side."""
    return _chain_cover(CacheKey(body.pieces))


@lru_cache(maxsize=256)
def _chain_cover(seen: CacheKey) -> SphereChain:
    (pieces,) = seen.given
    chains = (sphere_chain(pieces, axes, SLENDERNESS) for axes in _orientations(pieces))
    return min(chains, key=lambda chain: chain.radius)


def close_pairs(geometry: CellGeometry) -> frozenset[tuple[int, int]]:
    """Return the pairs of bodies of one arm whose distances have to be bounded piece by piece,
    because their rows of spheres (`chain_cover`) overlap in many postures.

    Each pair consists of the indices of both bodies.
    """
    bodies, found = geometry.bodies, []
    # Where an arm stands does not matter.
    known = [b.content if b.root is None else digest_of_parts(b.root[1]) for b in bodies]
    for pair in geometry.possible:
        a, b = bodies[pair.first], bodies[pair.second]
        if a.group != b.group:
            continue
        arm = geometry.arms[b.frame.robot]
        of = known[pair.first], known[pair.second], arm.chain
        if _often_close(CacheKey(a, b, arm, known=of)):
            found.append((pair.first, pair.second))
    return frozenset(found)


@lru_cache(maxsize=512)
def _often_close(seen: CacheKey) -> bool:
    a, b, arm = seen.given
    a = a if a.root is None else replace(a, pieces=a.root[1])
    steps, chains = _steps(CacheKey(arm, known=arm.chain)), [chain_cover(body) for body in (a, b)]
    T = np.broadcast_to(np.eye(4), (OVERLAP_POSTURES, 4, 4))
    for k in range(a.frame.joint + 1, b.frame.joint + 1):
        T = T @ steps[k]
    moved = chains[1].centres @ T[:, :3, :3].transpose(0, 2, 1) + T[:, None, :3, 3]
    gaps = np.linalg.norm(chains[0].centres[:, None] - moved[:, None], axis=3)
    touching = gaps.min(axis=(1, 2)) <= chains[0].radius + chains[1].radius
    if a.frame.kind == "world":
        touching &= ~_apart(a.pieces, b.pieces, T)
    return bool(np.count_nonzero(touching) > OFTEN * OVERLAP_POSTURES)


@lru_cache(maxsize=4)
def _steps(seen: CacheKey) -> list[Array]:
    """Compute the pose of each joint's frame in the frame of the joint before it, in the same
    random postures in every call.

    Args:
        seen: cache key that holds the geometry of the arm.

    Returns:
        One array (OVERLAP_POSTURES, 4, 4) per joint.
    """
    (arm,), found = seen.given, []
    q = np.random.default_rng(0).uniform(arm.lower, arm.upper, (OVERLAP_POSTURES, arm.joints))
    for k, axis in enumerate(arm.axes):
        moved = np.tile(np.eye(4), (len(q), 1, 1))
        along = q[:, k, None] * axis
        if arm.turning[k]:
            moved[:, :3, :3] = rotation_from_vector(along)
        else:
            moved[:, :3, 3] = along
        found.append(arm.origins[k] @ moved)
    return found


def _apart(first: tuple[Piece, ...], second: tuple[Piece, ...], T: Array) -> NDArray[np.bool_]:
    """Return for n relative poses of two sets of pieces whether a coordinate axis of the first
    frame separates the sets, (n,).

    Args:
        first, second: the sets, each in the frame of its body.
        T: (n, 4, 4) from the frame of `second` to the frame of `first`.
    """
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    high = np.max([support(piece, axes) for piece in first], axis=0)
    turned = (-axes @ T[:, :3, :3]).reshape(-1, 3)
    ahead = np.max([support(piece, turned) for piece in second], axis=0).reshape(-1, len(axes))
    low = T[:, :3, 3] @ axes.T - ahead
    return np.asarray(np.any(low > high, axis=1))


def _covered(piece: Piece, cover: list[Piece]) -> bool:
    """Return True if a cover contains a piece because the piece is one of the cover's own pieces,
    or lies inside one of its boxes."""
    return any(
        other is piece or (isinstance(other.shape, Box) and contains(other, piece))
        for other in cover
    )


def _simple(piece: Piece) -> Piece:
    if not isinstance(piece.shape, Hull):
        return piece
    boxes = [bounding_box((piece,), axes) for axes in _orientations((piece,))]
    return min(boxes, key=_volume)


def _volume(box: Piece) -> float:
    assert isinstance(box.shape, Box)
    return float(np.prod(box.shape.size))


def _orientations(pieces: tuple[Piece, ...]) -> list[Array]:
    """Return the rotations (3, 3) of boxes that are tried as covers of a body, without repetition.

    These are the body's axes, each piece's axes, and the principal axes of the vertices of each
    hull.
    """
    found = [np.eye(3)]
    for piece in pieces:
        found.append(piece.rotation)
        if isinstance(piece.shape, Hull):
            points = piece.shape.vertices @ piece.rotation.T
            _, vectors = np.linalg.eigh(np.cov(points.T))
            if np.linalg.det(vectors) < 0.0:
                vectors[:, 0] *= -1.0
            found.append(vectors)
    unique: list[Array] = []
    for axes in found:
        if not any(np.allclose(np.abs(axes.T @ other).max(axis=0), 1.0) for other in unique):
            unique.append(axes)
    return unique


def _outermost(cover: list[Piece]) -> list[Piece]:
    kept: list[Piece] = []
    ordered = sorted(cover, key=lambda piece: -float(support(piece, _DIRECTIONS).mean()))
    for piece in ordered:
        if not _covered(piece, kept):
            kept.append(piece)
    return kept


def _merge_once(cover: list[Piece]) -> list[Piece] | None:
    """Merge two pieces of a cover into a box around both: those two, and that box, for which the
    box exceeds the pieces' common hull least.

    Returns:
        The new cover; None if every box exceeds the hull by more than `MERGE_SLACK`.
    """
    best: tuple[float, int, int, Piece] | None = None
    for i, j in combinations(range(len(cover)), 2):
        pair = (cover[i], cover[j])
        hull = np.maximum(support(pair[0], _DIRECTIONS), support(pair[1], _DIRECTIONS))
        for axes in _orientations(pair):
            box = bounding_box(pair, axes)
            excess = float(np.max(support(box, _DIRECTIONS) - hull))
            if excess <= MERGE_SLACK and (best is None or excess < best[0]):
                best = (excess, i, j, box)
    if best is None:
        return None
    _, i, j, box = best
    return [piece for k, piece in enumerate(cover) if k not in (i, j)] + [box]
