"""Where both arms can hold the box at once: a map over positions and directions of the box, before
anybody chooses poses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation

from hybrid_opt.errors import ProposalError
from hybrid_opt.extras.proposing.common import MachineKinematics
from hybrid_opt.extras.proposing.hold_search import (
    LIBRARY,
    PoseSearch,
    PoseState,
    PostureLibrary,
    ways_to_hold,
)
from hybrid_opt.extras.proposing.kinematics import ArmKinematics
from hybrid_opt.extras.proposing.problem import Problem
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.geometry.pairs import CellGeometry
from symbolic.records.poses import Orientation

CHOSEN_HEIGHTS = 6
"""Number of heights that are chosen if none are given."""

LEVEL_STEP = 0.05
"""Unit of chosen heights [m]."""

COARSE_GRID = (10, 10, 18)
"""Numbers of positions along x, y and z of the first, coarse grid."""

POSITION_STEPS = (0.02, 0.05, 0.1, 0.2)
"""Distances between positions of which one is chosen if none is given [m]: the least with at most
`USUAL_POSITIONS` positions at one height."""

USUAL_POSITIONS = 1000

MOST_POSES = 100_000
"""Largest number of box poses of a map."""

COMMON_POSITIONS = 5
"""Number of positions of the joints that move both arms which are tried: zero, as far as the limits
allow, and random ones."""


@dataclass(frozen=True)
class HoldMapSettings:
    """Grid of a map of box poses that both arms can hold.

    Attributes:
        step: distance between positions at one height [m]; None to choose one of `POSITION_STEPS`.
        heights: heights of the box centre in the world [m]; empty to choose `CHOSEN_HEIGHTS` from
            the lowest to the highest at which both arms can hold the box.
        yaws: number of directions of the box, evenly over half a turn about the vertical; over a
            whole turn for hands, and if the file states where the pads are.
    """

    step: float | None = None
    heights: tuple[float, ...] = ()
    yaws: int = 4

    def __post_init__(self) -> None:
        if self.step is not None and not 0.01 <= self.step <= 1.0:
            raise SettingsError(f"step: found {self.step:g}; allowed is 0.01 to 1 m")
        if not 1 <= self.yaws <= 36:
            raise SettingsError(f"yaws: found {self.yaws}; allowed is 1 to 36")
        for height in self.heights:
            if not abs(height) <= 10.0:
                raise SettingsError(f"heights: found {height:g}; allowed is -10 to 10 m")


@dataclass(frozen=True, eq=False)
class HeldPose:
    """A pose of the box with a posture of both arms that holds it.

    Attributes:
        pose: (6,) pose of the box in the world [m, rad].
        contacts: tables of both contacts as they stand in a file.
        spins: rotation of each pad about its normal, in addition to the file's [rad].
        q: joint positions (joints,) of each arm [rad or m].
        comfort: distance from joint limits and singular postures, as in `HoldMap`.
    """

    pose: Array
    contacts: list[dict[str, Any]]
    spins: tuple[float, float]
    q: tuple[Array, Array]
    comfort: float


@dataclass(frozen=True, eq=False)
class HoldMap:
    """Map of the box poses that both arms can hold at once, on a grid of heights (l), positions (y
    and x) and directions (w) of the box. A direction is a rotation about the vertical.

    Attributes:
        geometry: bodies of the cell.
        ways: for each way to hold the box the tables of both contacts as they stand in a file.
        x, y, z: (nx,), (ny,), (l,) coordinates of the box centre in the world [m].
        yaws: (w,) rotations about the vertical, in addition to the orientation of the file [rad].
        poses: (l, ny, nx, w, 6) box poses [m, rad].
        state: (l, ny, nx, w) values of `PoseState`.
        way: (l, ny, nx, w) index in `ways` of the way to hold the box; -1 where none is possible.
        spins: (l, ny, nx, w, 2) rotation of each pad about its normal, in addition to the file's
            [rad]; NaN where the box cannot be held.
        q: joint positions (l, ny, nx, w, joints) of each arm [rad or m]; NaN where the box cannot
            be held.
        comfort: (l, ny, nx, w) of the less comfortable arm, from 0, at a joint limit and a singular
            posture, to 1, far from both; NaN where the box cannot be held.
    """

    geometry: CellGeometry
    ways: tuple[list[dict[str, Any]], ...]
    x: Array
    y: Array
    z: Array
    yaws: Array
    poses: Array
    state: NDArray[np.int8]
    way: NDArray[np.int8]
    spins: Array
    q: tuple[Array, Array]
    comfort: Array

    @property
    def step(self) -> float:
        """Distance between neighbouring positions of the box centre at one height [m]; 0 for a
        single position.
        """
        across = np.diff(self.x if len(self.x) > 1 else self.y)
        return float(across[0]) if len(across) else 0.0

    @property
    def holds(self) -> NDArray[np.bool_]:
        """(l, ny, nx, w) True for box poses, by height, y, x and direction, at which both arms can
        hold the box."""
        return np.asarray(self.state == PoseState.HOLDS)

    @property
    def directions(self) -> NDArray[np.intp]:
        """(l, ny, nx) number of directions in which both arms can hold the box, by height, y and x
        of its centre."""
        return np.asarray(self.holds.sum(axis=-1))

    @cached_property
    def _quality(self) -> Array:
        """(l, ny, nx, w) quality of box poses, by height, y, x and rotation about the vertical.

        It is the comfort of the postures times the distance of the box centre, in grid steps, from
        the nearest position at the same height at which the box, with the same rotation, cannot be
        held; 0 at poses that cannot be held. Positions beyond the grid count as ones at which it
        cannot be held.
        """
        inside = np.pad(self.holds, ((0, 0), (1, 1), (1, 1), (0, 0)))
        depth = np.zeros(inside.shape)
        for level, yaw in product(range(len(self.z)), range(len(self.yaws))):
            depth[level, :, :, yaw] = ndimage.distance_transform_edt(inside[level, :, :, yaw])
        return np.asarray(depth[:, 1:-1, 1:-1] * np.where(self.holds, self.comfort + 1e-6, 0.0))

    def best(self, level: int | None = None) -> HeldPose | None:
        """Return the best box pose that both arms can hold; None if there is none.

        It maximises the comfort of the postures (their distance from joint limits and singular
        postures) times the distance of the box centre from the nearest position at the same height
        at which the box, with the same rotation about the vertical, cannot be held. Positions
        beyond the grid count as such.

        Args:
            level: index of the height in `z`; None for all heights.
        """
        first = 0 if level is None else level
        quality = self._quality if level is None else self._quality[level : level + 1]
        index = np.unravel_index(int(np.argmax(quality)), quality.shape)
        if not quality[index] > 0.0:
            return None
        at = (first + int(index[0]), *map(int, index[1:]))
        spins = self.spins[at]
        return HeldPose(
            self.poses[at],
            self.ways[int(self.way[at])],
            (float(spins[0]), float(spins[1])),
            (self.q[0][at], self.q[1][at]),
            float(self.comfort[at]),
        )


def hold_map(
    problem: Problem,
    spins: Array,
    rng: np.random.Generator,
    settings: HoldMapSettings | None = None,
    tell: Callable[[int, int], None] = lambda done, total: None,
) -> HoldMap:
    """Find the poses at which both arms can hold the box at once.

    A pose can be held if both arms reach their contacts in one of the ways of `ways_to_hold`,
    within their joint limits and with the manipulability that `propose` requires, and FCL finds no
    collision.

    Args:
        problem: the problem, with bases.
        spins: (n,) rotations of the pads about their normals that are tried [rad].
        rng: generator of random postures. Both arms get the same random numbers, so equal arms that
            face one another give a symmetric map.
        settings: the grid; None for the default.
        tell: function that is called with the number of steps done and of all steps.

    Raises:
        WorkcellError: the file is wrong, or the payload cannot be held at rest in any way.
        ProposalError: every rotation of the pads puts a tool into the payload.
        SettingsError: the grid has too many poses.
    """
    settings = settings or HoldMapSettings()
    grids = _GridSearch(problem, spins, rng, settings, tell)
    x, y, z = grids.fine_grid()
    shape = (len(z), len(y), len(x), settings.yaws)
    if np.prod(shape) > MOST_POSES:
        raise SettingsError(
            f"step and yaws: they give {np.prod(shape)} box poses; allowed are {MOST_POSES}, so "
            "take a longer step or fewer yaws"
        )
    search = grids.searched(x, y, z)
    return HoldMap(
        grids.ways[0].bodies.geometry,
        tuple(way.contacts for way in grids.ways),
        x,
        y,
        z,
        grids.yaws,
        search.poses.reshape(*shape, -1),
        search.state.reshape(shape),
        search.way.reshape(shape),
        search.spins.reshape(*shape, -1),
        (search.q[0].reshape(*shape, -1), search.q[1].reshape(*shape, -1)),
        search.comfort.reshape(shape),
    )


def holds_anywhere(problem: Problem, spins: Array, rng: np.random.Generator) -> bool:
    """Return True if both arms can hold the box at some pose of a coarse grid, which covers all
    positions within the arms' lengths.

    Args:
        problem, spins, rng: as for `hold_map`, whose errors are raised too.
    """
    grids = _GridSearch(problem, spins, rng, HoldMapSettings())
    return bool((grids.searched(*grids.coarse_grid()).state == PoseState.HOLDS).any())


def turned(orientation: Orientation, angles: Array, yaw: float) -> Array:
    """Rotate an orientation of the box about the vertical.

    Args:
        orientation: convention of the three numbers.
        angles: (3,) orientation [rad].
        yaw: angle of the rotation [rad].

    Returns:
        (3,) orientation in the same convention [rad].
    """
    if orientation.is_vector:
        about = Rotation.from_rotvec([0.0, 0.0, yaw]) * Rotation.from_rotvec(angles)
        return np.asarray(about.as_rotvec())
    found = angles + np.array([0.0, 0.0, yaw])
    if abs(found[2]) > np.pi:
        found[2] = np.angle(np.exp(1j * found[2]))
    return np.asarray(found)


Grid = tuple[Array, Array, Array]
"""Coordinates (nx,), (ny,) and (l,) of the box centre [m]."""


class _GridSearch:
    """The ways to hold the box, both arms' random postures, and the search on a grid."""

    def __init__(
        self,
        problem: Problem,
        spins: Array,
        rng: np.random.Generator,
        settings: HoldMapSettings,
        tell: Callable[[int, int], None] = lambda done, total: None,
    ) -> None:
        """Prepare the ways to hold the box and the postures.

        Args:
            problem, spins, rng, settings, tell: as for `hold_map`.
        """
        self.ways = list(ways_to_hold(problem, spins))
        if not self.ways:
            text = "the robots' tools enter the payload in every way to hold it"
            raise ProposalError(f"{problem.source}: {text}")
        is_whole = problem.states_contacts or problem.has_hands
        turn = 2.0 * np.pi if is_whole else np.pi
        self.yaws = turn * np.arange(settings.yaws) / settings.yaws
        upright, orientation = problem.poses[0][3:], problem.orientation
        self._angles = np.array([turned(orientation, upright, float(yaw)) for yaw in self.yaws])
        self._orientation, self._settings, self._tell = orientation, settings, tell
        arms, seed = self.ways[0].arms, int(rng.integers(2**32))
        commons = _common_positions(arms, rng)
        self._libraries = [[_library(arm, seed, common) for arm in arms] for common in commons]
        levels = COARSE_GRID[2] + (len(settings.heights) or CHOSEN_HEIGHTS)
        self._done, self._total = 0, len(commons) * len(self.ways) * levels

    def searched(self, x: Array, y: Array, z: Array) -> PoseSearch:
        """Find for each pose of a grid a way in which both arms can hold the box there.

        Args:
            x, y, z: (nx,), (ny,), (l,) coordinates of the box centre [m].

        Returns:
            The finished search, with poses sorted by height, y, x and direction.
        """
        parts = np.meshgrid(z, y, x, np.arange(len(self.yaws)), indexing="ij")
        up, across, along, which = (part.ravel() for part in parts)
        poses = np.column_stack([along, across, up, self._angles[which.astype(int)]])
        search = PoseSearch(self._orientation, self.ways, poses)
        levels = np.split(np.arange(len(poses)), len(z))
        for both, number, rows in product(self._libraries, range(len(self.ways)), levels):
            search.attempt(number, both, rows)
            self._done += 1
            self._tell(min(self._done, self._total), self._total)
        return search

    def coarse_grid(self) -> Grid:
        """Return a coarse grid of all positions within the lengths of both arms."""
        lows, highs = [], []
        for way in self.ways:
            spheres = [(at, length + np.linalg.norm(point)) for at, length, point in way.bounds]
            lows.append(np.max([at - radius for at, radius in spheres], axis=0))
            highs.append(np.min([at + radius for at, radius in spheres], axis=0))
        low, high = np.min(lows, axis=0), np.max(highs, axis=0)
        # Where no position is within both lengths, one is as good as any.
        low, high = np.minimum(low, (low + high) / 2.0), np.maximum(high, (low + high) / 2.0)
        x, y, z = (np.linspace(a, b, n) for a, b, n in zip(low, high, COARSE_GRID, strict=True))
        return x, y, z

    def fine_grid(self) -> Grid:
        """Choose a finer grid around the promising positions of the coarse grid. Its coordinates
        are multiples of a round step.

        Promising are positions at which the box can be held. If there are none, they are those that
        both arms reach, though with collisions; if there are none of these either, all positions.
        """
        coarse = self.coarse_grid()
        state = self.searched(*coarse).state.reshape(*COARSE_GRID[::-1], -1)
        wanted = state == PoseState.HOLDS
        for other in (state == PoseState.COLLIDES, state >= PoseState.OUT_OF_REACH):
            wanted = wanted if wanted.any() else other
        ranges = []
        for axis, values in zip((2, 1, 0), coarse, strict=True):
            used = values[wanted.any(axis=tuple({0, 1, 2, 3} - {axis}))]
            # Heights are few, so they stay near those that hold.
            gap = (0.5 if axis == 0 else 1.0) * float(values[1] - values[0])
            ranges.append((max(used[0] - gap, values[0]), min(used[-1] + gap, values[-1])))
        settings = self._settings
        steps = POSITION_STEPS if settings.step is None else (settings.step,)
        grids = [(_multiples(*ranges[0], step), _multiples(*ranges[1], step)) for step in steps]
        x, y = next((g for g in grids if len(g[0]) * len(g[1]) <= USUAL_POSITIONS), grids[-1])
        if settings.heights:
            return x, y, np.unique(settings.heights)
        z = _multiples(*ranges[2], LEVEL_STEP)
        return x, y, z[np.unique(np.linspace(0, len(z) - 1, CHOSEN_HEIGHTS).round().astype(int))]


def _multiples(low: float, high: float, step: float) -> Array:
    """Return the multiples of a step from `low` to `high`; the multiple nearest to the middle of
    this range if it contains none.
    """
    first, last = np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9)
    numbers = np.arange(first, last + 1.0)
    return np.round(step * (numbers if len(numbers) else np.round([(low + high) / step / 2])), 9)


def _common_positions(
    arms: Sequence[ArmKinematics], rng: np.random.Generator
) -> list[Array | None]:
    """Return positions (k,) to try for the k joints that move both arms [rad or m]: the rest
    position, then random ones. Without such joints the result is [None]."""
    if not arms[0].common:
        return [None]
    machine = MachineKinematics(arms)
    rest, low, high = (x[: machine.common] for x in (machine.rest, machine.lower, machine.upper))
    return [rest, *rng.uniform(low, high, (COMMON_POSITIONS - 1, len(rest)))]


def _library(arm: ArmKinematics, seed: int, common: Array | None) -> PostureLibrary:
    """Draw the random postures of an arm.

    Args:
        arm: the arm.
        seed: seed of the random numbers.
        common: (k,) positions of the k joints that move both arms [rad or m], or None.
    """
    q = arm.drawn(LIBRARY, np.random.default_rng(seed))
    if common is not None:
        q[:, arm.common] = common
    return PostureLibrary(arm, q)
