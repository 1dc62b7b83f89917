"""`run_job.py` of the torque target, unedited, in simulated time against mocks of its controllers,
with faults. `vendor/test_ros.py` runs it over ROS 2's own client library and messages."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from hybrid_opt.extras.bundles.job_file import pad_errors
from hybrid_opt.extras.bundles.programs.bring_up import BLOCK, FILE, SPEED
from hybrid_opt.job.compliance import TRACKED, separation
from symbolic.array import Array
from tests.hybrid_opt.extras.bundles import mock_ros
from tests.hybrid_opt.extras.bundles.bundles import contents
from tests.hybrid_opt.extras.bundles.bundles import read_job as job
from tests.hybrid_opt.extras.bundles.mock_ros import World, run
from tests.hybrid_opt.job.jobs import rack_job

DRIVERS = ("simulation", "franka", "ur")

Fault = Callable[[World], None]


@cache
def sound(driver: str) -> World:
    """A world in which nothing goes wrong."""
    with TemporaryDirectory() as folder:
        code, world = run(contents("torque", driver), Path(folder))
    assert code == 0, world.log
    return world


def column(world: World, index: int) -> Array:
    return np.array([row[index] for row in world.record])


def moves(world: World, least: float = 1e-9) -> list[int]:
    """Numbers of the records after which joints move by more than the least [rad]."""
    change = np.abs(np.diff(column(world, 1), axis=0)).max(axis=1)
    return np.flatnonzero(change > least).tolist()


def both(s: float) -> Array:
    """Both arms' planned positions at a coordinate."""
    return np.concatenate([job().position(arm, s) for arm in (0, 1)])


def held_at(world: World) -> float:
    """Where along the path the program says that it holds the job [s]."""
    found = re.findall(r"held in \w+, ([0-9.]+) s", " ".join(world.log))
    return float(found[-1])


@pytest.mark.parametrize("driver", DRIVERS)
def test_the_job_is_done(driver: str) -> None:
    world = sound(driver)
    np.testing.assert_allclose(column(world, 1)[-1], both(job().end), atol=1e-6)
    assert world.log[-1].startswith("done")
    time, moved = column(world, 0), moves(world)
    assert time[moved[-1]] - time[moved[0]] == pytest.approx(job().end, abs=0.3)


@pytest.mark.parametrize("stiffness", [1e4, 3e4, 1e5, 3e5])
def test_arms_of_stiff_controllers_keep_their_force(stiffness: float) -> None:
    """What controllers make up between two points changes the gap of the pads, and the force by the
    stiffness of both arms in series."""
    world = sound("franka")
    s = column(world, 0) - column(world, 0)[0] - begins("franka")
    held = (s > job().pressed) & (s < job().begin("release"))
    along, _ = pad_errors(rack_job().workcell, column(world, 1)[held])
    ratio = 1.0 - stiffness / 2.0 * along / [job().force(0, each) for each in s[held]]
    print(f"{stiffness:g} N/m: {ratio.min():.5f} to {ratio.max():.5f} of the command")
    assert np.abs(ratio - 1.0).max() < TRACKED


def test_a_joint_that_moves_both_arms_is_commanded_once(tmp_path: Path) -> None:
    """The first joint of the left arm stands in for a lift of both; it does what the left one's
    does."""
    files = dict(contents("torque"))
    document = json.loads(files["job.json"])
    left, right = document["robots"]
    right["ros_joints"][0] = left["ros_joints"][0]
    for name in ("position", "velocity", "acceleration"):
        for own, other in zip(right[name], left[name], strict=True):
            own[0] = other[0]
    files["job.json"] = json.dumps(document)
    code, world = run(files, tmp_path)
    assert code == 0, world.log
    ((controller, _), _) = world.of(0), world.of(1)
    assert len(controller.joints) == len(left["joints"]) + len(right["joints"]) - 1
    last = np.concatenate([left["position"][-1], right["position"][-1]])
    np.testing.assert_allclose(column(world, 1)[-1], last, atol=1e-6)


def test_positions_and_efforts_are_those_of_the_job() -> None:
    """Both arms' commands against the job, by the mock's own interpolation."""
    world = sound("franka")
    time, q, effort = (column(world, k) for k in range(3))
    first, *_, last = moves(world)
    for k in range(first + 40, last - 40, 97):
        s = time[k] - time[first]
        # The world's steps are 5 ms apart.
        speed = max(job().speed(arm, s) for arm in (0, 1))
        assert np.abs(q[k] - both(s)).max() < 0.02 * speed + 1e-4
        wanted = np.concatenate([job().effort(a, "without_gravity", s, 1.0) for a in (0, 1)])
        assert np.abs(effort[k] - wanted).max() < 3.0
    assert np.abs(effort[first + 1000]).max() > 1.0


def freeze(world: World, arm: int) -> None:
    """An arm's drives stop."""
    controller, part = world.of(arm)
    controller.stands[part] = True


def fall_silent(world: World, arm: int) -> None:
    world.silent[arm] = True


def shift(world: World, arm: int) -> None:
    world.offset[arm] = 0.2


def deaf(world: World) -> None:
    world.felt[1] = None


def abort(world: World) -> None:
    world.of(0)[0].aborts_at = world.now


FAULTS: dict[str, tuple[Fault, str]] = {
    "one arm stops": (partial(freeze, arm=0), r"\d mm|\d ms"),
    "the other arm stops": (partial(freeze, arm=1), r"\d mm|\d ms"),
    "no news": (partial(fall_silent, arm=1), r"right .*\d s|\d ms"),
    "a silent sensor": (deaf, "right.*sensor"),
    "an encoder jumps": (partial(shift, arm=0), r"left .*\d mm"),
    "Ctrl-C": (World.interrupt, "Ctrl-C"),
    "a controller gives up": (abort, "Aborted"),
}


UNSEEN = ("one arm stops", "the other arm stops")
"""Faults that show only where the arms move."""

PLACES = (
    ("approach", 0.5),
    ("press", 0.5),
    ("lift", 0.5),
    *(("carry", share) for share in (0.05, 0.3, 0.45, 0.7, 0.95)),
    ("set_down", 0.5),
    ("release", 0.5),
    ("retreat", 0.5),
)
"""Phases and shares of them in which something goes wrong."""

USUAL = (("simulation", "one arm stops"), ("ur", "Ctrl-C"), ("franka", "a silent sensor"))
"""Faults of the short tests, in the carry; the slow ones inject all of them in all phases."""


def begins(driver: str) -> float:
    """When the arms of a sound run begin to move, from when its program starts [s]."""
    time = column(sound(driver), 0)
    return float(time[moves(sound(driver), 1e-12)[0]] - time[0])


def with_fault(
    driver: str, name: str, when: float, folder: Path, hold: float = 6.0
) -> tuple[int, World]:
    """A run in which something happens at a time, and that is left some time after that [s]."""

    def prepare(world: World) -> None:
        world.later(when, lambda: FAULTS[name][0](world))
        for k in range(3):
            world.later(when + hold + 0.5 * k, world.interrupt)

    return run(contents("torque", driver), folder, prepare)


@pytest.mark.parametrize(
    ("driver", "name", "phase", "share"),
    [
        pytest.param(
            driver,
            name,
            *place,
            marks=() if (driver, name) in USUAL and place == ("carry", 0.45) else pytest.mark.slow,
        )
        for driver in DRIVERS
        for name in FAULTS
        for place in PLACES
        if driver != "simulation" or name != "a silent sensor"
    ],
)
def test_both_arms_hold_and_press(
    driver: str, name: str, phase: str, share: float, tmp_path: Path
) -> None:
    """The arms that still move stop at one place of the path, in the time that the job states; the
    squeeze of that place stays; what happened is told."""
    told, planned = FAULTS[name][1], rack_job().phase(phase)
    when = begins(driver) + planned.begin + share * planned.duration
    code, world = with_fault(driver, name, when, tmp_path)
    text = " ".join(world.log)
    assert re.search(told, text) or (code == 0 and name in UNSEEN), text
    if name in UNSEEN and phase in ("press", "release", "retreat"):
        # Nothing moves then, or no farther than is allowed: it is seen later, if at all.
        assert code in (0, 1), text
    else:
        assert code == 1, text
        assert f" in {phase}, " in text or share > 0.9 or name in UNSEEN, text
    if code == 0:
        return
    assert "'back'" in text
    q, time = column(world, 1), column(world, 0) - column(world, 0)[0]
    assert np.ptp(q[-200:], axis=0).max() < 1e-9
    if name not in UNSEEN:
        # To see it, to tell it, and the stop itself.
        noticed = 0.1 + job().limits.silence
        assert time[moves(world)[-1] + 1] <= when + noticed + job().limits.stop_time
    s = held_at(world)
    stopped = {"one arm stops": {0}, "the other arm stops": {1}}.get(name, set())
    for arm in (0, 1):
        away = job().distance(arm, world.q(arm).tolist(), s)
        # One that stopped by itself is off by what is allowed, and by the other's way to its stop.
        late = job().limits.partner_stop_time
        fastest = max(job().speed(arm, at) for at in np.linspace(s - late, s, 26))
        most = job().limits.path + late * fastest
        assert away < (most if arm in stopped else 1e-3), f"{name} at {s}: {away}"
        held = job().effort(arm, "without_gravity", s, 0.0)
        np.testing.assert_allclose(world.effort(arm), held, atol=2.0)


@pytest.mark.parametrize(
    ("driver", "word", "code"),
    [
        ("simulation", "continue", 0),
        ("franka", "back", 3),
        pytest.param("simulation", "back", 3, marks=pytest.mark.slow),
        pytest.param("ur", "continue", 0, marks=pytest.mark.slow),
    ],
)
def test_a_held_job_sets_the_box_down(driver: str, word: str, code: int, tmp_path: Path) -> None:
    when = begins(driver) + job().begin("carry") + 2.5

    def prepare(world: World) -> None:
        world.later(when, world.interrupt)
        world.later(when + 5.0, lambda: world.command(word))

    found, world = run(contents("torque", driver), tmp_path, prepare)
    assert found == code, world.log
    end = job().end if word == "continue" else 0.0
    np.testing.assert_allclose(column(world, 1)[-1], both(end), atol=1e-4)
    assert np.abs(np.diff(column(world, 1), axis=0)).max() < 0.02, "no arm jumps"


@pytest.mark.parametrize(
    ("phase", "share"),
    [
        ("lift", 0.3),
        ("set_down", 0.1),
        *(
            pytest.param(phase, share, marks=pytest.mark.slow)
            # At the end of the set-down an arm that stops stands where it has to.
            for phase, last in (("lift", 1.0), ("carry", 1.0), ("set_down", 0.6))
            for share in (0.02, 0.25, 0.5, 0.75, 0.98)
            if share < last
        ),
    ],
)
def test_a_box_comes_home_after_one_arm_stopped(phase: str, share: float, tmp_path: Path) -> None:
    """Also where the arms move slowly: the pads never part by more than the bundle states, and the
    arms are not too far from their places to go back."""
    planned = rack_job().phase(phase)
    when = begins("simulation") + planned.begin + share * planned.duration

    def heal(world: World) -> None:
        controller, part = world.of(0)
        controller.stands[part] = False
        controller.switch(True)

    def prepare(world: World) -> None:
        world.later(when, lambda: freeze(world, 0))
        world.later(when + 2.0, lambda: heal(world))
        world.later(when + 3.0, lambda: world.command("back"))

    code, world = run(contents("torque", "simulation"), tmp_path, prepare)
    assert code == 3, world.log
    np.testing.assert_allclose(column(world, 1)[-1], both(0.0), atol=1e-4)
    time = column(world, 0) - column(world, 0)[0]
    along, across = pad_errors(
        rack_job().workcell, column(world, 1)[(time > when) & (time < when + 2.0)]
    )
    stated = separation(rack_job(), job().limits.partner_stop_time)
    assert np.hypot(along, across).max() <= stated


def elsewhere(world: World) -> None:
    controller, part = world.of(0)
    controller.q[part] += 0.05


def deaf_from_the_start(world: World) -> None:
    world.felt[0] = None


def off_by_ten(world: World) -> None:
    world.felt[0] = 10.0


GOAL = "right.*goal"
REFUSED: dict[str, tuple[str, Fault]] = {
    r"left .*\d mm": ("simulation", elsewhere),
    GOAL: ("franka", lambda w: setattr(w.of(1)[0], "refuses", True)),
    "10.0 N": ("ur", off_by_ten),
    "left.*sensor": ("franka", deaf_from_the_start),
}


@pytest.mark.parametrize("told", REFUSED)
def test_nothing_moves_that_should_not(told: str, tmp_path: Path) -> None:
    driver, prepare = REFUSED[told]
    code, world = run(contents("torque", driver), tmp_path, prepare)
    assert code == 2
    assert re.search(told, world.log[-1])
    # A goal that the other controller has taken is replaced before it begins.
    most = 0.01 if told == GOAL else 1e-12
    assert np.ptp(column(world, 1), axis=0).max() < most


def test_a_controller_that_refuses_to_go_on_leaves_the_other_one_pressing(tmp_path: Path) -> None:
    when = begins("ur") + job().begin("carry") + 2.5

    def prepare(world: World) -> None:
        world.later(when, world.interrupt)
        world.later(when + 4.9, lambda: setattr(world.of(1)[0], "refuses", True))
        world.later(when + 5.0, lambda: world.command("continue"))
        world.later(when + 10.0, world.interrupt)

    code, world = run(contents("torque", "ur"), tmp_path, prepare)
    assert code == 1
    assert "right" in world.log[-2]
    assert "goal" in world.log[-2]
    for arm in (0, 1):
        held = job().effort(arm, "without_gravity", held_at(world), 0.0)
        np.testing.assert_allclose(world.effort(arm), held, atol=2.0)


@pytest.mark.parametrize("lateness", [0.02, 0.06])
def test_postures_are_compared_at_the_time_of_their_measurement(
    lateness: float, tmp_path: Path
) -> None:
    """Measurements that arrive late, as on a loaded machine, stop nothing."""
    code, world = run(contents("torque"), tmp_path, lambda w: setattr(w, "lateness", lateness))
    assert code == 0, world.log


def test_a_look_at_both_arms_moves_nothing(tmp_path: Path) -> None:
    code, world = run(contents("torque", "ur"), tmp_path, arguments=["--check"])
    assert code == 0
    assert not world.calls
    assert np.ptp(column(world, 1), axis=0).max() == 0.0


@pytest.mark.parametrize(
    ("driver", "called"),
    [
        ("simulation", ["switch_controller"]),
        ("ur", ["set_payload", "zero_ftsensor", "switch_controller"]),
        (
            "franka",
            ["switch_controller", "set_load", "set_full_collision_behavior", "switch_controller"],
        ),
    ],
)
def test_arms_know_their_loads_before_they_are_controlled(driver: str, called: list[str]) -> None:
    """Once, before the first contact: on a UR each change zeroes the sensor."""
    names = [name.rsplit("/", 1)[1] for name, _ in sound(driver).calls]
    assert names == called * (1 if driver == "simulation" else 2)


def test_a_payload_is_sent_as_the_driver_defines_it(tmp_path: Path) -> None:
    newer = "ur_msgs/srv/SetPayload"
    with patch.dict(mock_ros.SERVICES, {newer: {"payload", "transition_time"}}):
        code, world = run(contents("torque", "ur"), tmp_path)
    assert code == 0, world.log
    assert set(world.calls[0][1]) == {"payload"}


def bring_up(driver: str, folder: Path, prepare: Fault) -> tuple[int, World, dict[str, Any]]:
    """Run a bundle's bring-up, with a block once it asks for one; what it wrote last."""

    def with_block(world: World) -> None:
        def press() -> None:
            if BLOCK in world.log[-1:]:
                world.command("press")

        prepare(world)
        for k in range(200):
            world.later(0.5 * k, press)

    code, world = run(contents("torque", driver), folder, with_block, ["--bring-up"])
    path = folder / FILE
    return code, world, tomllib.loads(path.read_text("utf-8")) if path.exists() else {}


def test_bring_up_measures_what_the_arms_are(tmp_path: Path) -> None:
    """Arms of a known lag, sensors of a known offset and sign; the job then runs."""

    lags, offsets = [0.025, 0.035], [1.0, 0.5]

    def prepare(world: World) -> None:
        world.lag, world.sign, world.felt = lags, -1.0, list(offsets)

    code, world, found = bring_up("franka", tmp_path, prepare)
    assert code == 0, world.log
    for own, lag, offset in zip(found["robots"], lags, offsets, strict=True):
        own = own["measured"]
        assert own["lag"] == pytest.approx(lag, abs=0.002)
        assert own["speed"] == pytest.approx(1.0, abs=0.03)
        assert own["offset"] == pytest.approx(-offset, abs=0.01)
        assert (own["sign"], own["press"]) == (-1.0, pytest.approx(1.0, abs=0.05))
    np.testing.assert_allclose(column(world, 1)[-1], both(0.0), atol=1e-4)


LATE: dict[str, tuple[str, Fault]] = {
    "right .* 6. ms.* 30": ("ur", lambda w: setattr(w, "lag", [0.06, 0.065])),
    r" \d\d\.\d ms ": ("simulation", lambda w: setattr(w, "lag", [0.0, 0.06])),
    "left .* 10.0 N": ("ur", off_by_ten),
}


@pytest.mark.parametrize("told", LATE)
def test_a_job_refuses_arms_that_are_not_as_planned(told: str, tmp_path: Path) -> None:
    driver, prepare = LATE[told]
    code, world, found = bring_up(driver, tmp_path, prepare)
    assert code == 2
    assert re.search(told, world.log[-1]), world.log
    assert f"--driver {tmp_path / FILE}" in world.log[-1]
    assert {robot["name"] for robot in found["robots"]} == {"left", "right"}


def test_bring_up_says_how_fast_arms_of_a_slower_controller_are(tmp_path: Path) -> None:
    def prepare(world: World) -> None:
        rates = np.array([job().robots[arm]["velocity"] for arm in (0, 1)])
        world.fastest = 0.5 * np.abs(rates).max()
        for k in range(3):
            world.later(30.0 + k, world.interrupt)

    code, world, found = bring_up("simulation", tmp_path, prepare)
    assert (code, found) == (2, {})
    told = re.search(r"speed over the planned one: ([0-9.]+), ([0-9.]+)", world.log[-1])
    assert told is not None, world.log
    assert 0.5 < min(float(share) for share in told.groups()) < SPEED


def test_a_job_refuses_arms_that_nobody_measured(tmp_path: Path) -> None:
    """Or that were measured with another job."""
    for text, told in (("", "nothing was measured"), ('job = ""\nrobots = []', "of another job")):
        with patch.object(mock_ros, "as_planned", lambda files, text=text: {**files, FILE: text}):
            code, world = run(contents("torque"), tmp_path / told[:3])
        assert code == 2
        assert told in world.log[-1]
        assert "--bring-up" in world.log[-1]


def test_in_the_air_the_whole_job_is_driven_without_force(tmp_path: Path) -> None:
    code, world = run(contents("torque", "franka"), tmp_path, arguments=["--in-air"])
    assert code == 0, world.log
    np.testing.assert_allclose(column(world, 1)[-1], both(job().end), atol=1e-6)
    pressed = max(np.abs(job().effort(0, "without_gravity", job().pressed, 0.0)))
    assert np.abs(column(world, 2)).max() < pressed
