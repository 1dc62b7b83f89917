"""Two FR3 of franky-sim and a box in one scene of MuJoCo, as robots that libfranka controls.

The scene is a process of its own: pylibfranka holds Python's interpreter while it waits for a
robot. It steps once both arms have commanded a torque, so that no load of this machine changes what
happens.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np
from franky_sim import SimulationServer
from franky_sim.franka_robot_protocol import StateControllerMode
from franky_sim.mujoco_simulator import MujocoSimulator
from scipy.spatial.transform import Rotation

from symbolic.array import Array
from symbolic.records import Box, Workcell
from symbolic.records.poses import box_placement

PATIENCE = 300.0
"""Longest wait of the scene and of the program for one another [s]."""

OPTION = {"cone": "elliptic", "impratio": "50"}
"""Of MuJoCo: with its defaults what is held by friction creeps (documentation of `impratio`)."""

FRICTION = "0.002 1"
"""Time constant of friction in contacts with the pads [s], two steps. MuJoCo's constraints neglect
the acceleration that the arms' joints cause at constant speeds, here up to 0.5 m/s^2; friction lets
a held box slide by that over 2 / time constant: with the usual 0.02 s at 5 mm/s."""

CYCLE = 0.001
"""Of libfranka [s]."""

REPEAT = 0.05
"""An arm that answers to no state for so long gets it again [s]: libfranka waits 1 s for one, and
may have taken the last one before its controller asked for it."""

FLANGE = "0 0 0.107"
"""Of an FR3 in its last link [m]."""


@dataclass(frozen=True, eq=False)
class Scene:
    """What is added to the arms of franky-sim.

    Attributes:
        cell: bases, pads and box.
        q: first postures of both arms [rad].
        start, goal: poses of the box; a support stands below each [m, rad].
    """

    cell: Workcell
    q: tuple[tuple[float, ...], tuple[float, ...]]
    start: Array
    goal: Array

    def build(self, simulator: MujocoSimulator) -> None:
        """Add arms with pads at their flanges, a box and its supports; nothing else collides."""
        option = simulator.scene.find("option")
        assert option is not None
        option.attrib.update(OPTION)
        friction = f"{self.cell.contacts[0].friction} 0.02 0.001"
        for robot, q in zip(self.cell.robots, self.q, strict=True):
            simulator.add_robot(initial_q=q)
            body = simulator.worldbody[-1]
            _place(body, robot.T_world_base)
            for geom in body.iter("geom"):
                geom.set("contype", "0")
                geom.set("conaffinity", "0")
            (link,) = (each for each in body.iter("body") if each.get("name", "").endswith("link7"))
            flange = ElementTree.SubElement(link, "body", pos=FLANGE)
            (pad,) = robot.tool
            assert isinstance(pad.shape, Box)
            geom = _box(flange, f"pad_{robot.name}", pad.shape.size, friction, mass="0.2")
            _place(geom, pad.pose)
            contact = simulator.scene.find("contact")
            assert contact is not None
            pair = {"geom1": f"pad_{robot.name}", "geom2": "box", "solreffriction": FRICTION}
            ElementTree.SubElement(contact, "pair", pair)
        size = self.cell.payload.size
        for name, pose in (("start", self.start), ("goal", self.goal)):
            height = pose[2] - size[2] / 2.0
            support = _box(simulator.worldbody, name, [0.6 * size[0], 0.6 * size[1], height], "1")
            support.set("pos", _text([pose[0], pose[1], height / 2.0]))
        body = ElementTree.SubElement(simulator.worldbody, "body", name="box")
        _place(body, box_placement(self.cell.task.orientation, self.start[None])[0])
        ElementTree.SubElement(body, "freejoint")
        _box(body, "box", size, friction, mass=str(self.cell.payload.mass))


def _box(parent: Any, name: str, size: Any, friction: str, **more: str) -> Any:
    half = _text(np.asarray(size) / 2.0)
    shape = {"name": name, "type": "box", "size": half, "friction": friction, "condim": "6"}
    return ElementTree.SubElement(parent, "geom", shape | more)


def _place(element: Any, placement: Array) -> None:
    element.set("pos", _text(placement[:3, 3]))
    turn = Rotation.from_matrix(placement[:3, :3])
    element.set("quat", _text(turn.as_quat(scalar_first=True)))


def _text(values: Any) -> str:
    return " ".join(f"{value:.9g}" for value in values)


def simulate(scene: Scene, there: Connection, now: Any) -> None:
    """Simulate a scene in this process, until its other end says that it is over.

    Args:
        there: gets the addresses of both arms.
        now: shared: force of each pad on the box [N], place of the box [m], its quaternion.
    """
    with MujocoSimulator() as simulator:
        scene.build(simulator)
        with SimulationServer(simulator) as server:
            fresh = [False, False]
            for arm, robot in enumerate(simulator.robots):
                _note_commands(robot, fresh, arm)
            there.send([robot.hostname for robot in simulator.robots])
            server.run_once()
            while not all(
                each.robot_state.controller_mode == StateControllerMode.kExternalController
                for each in server.robot_servers
            ):
                # franky-sim holds both arms while they connect.
                server.run_once()
                if there.poll():
                    return
            now[:] = _state(simulator, scene.cell)
            while _hear(server, fresh, there):
                simulator.step()
                now[:] = _state(simulator, scene.cell)
                for each in server.robot_servers:
                    each.send_state()


def _note_commands(robot: Any, fresh: list[bool], arm: int) -> None:
    control = robot.torque_control

    def noted(torques: Any, has_new_command: bool = True) -> None:
        fresh[arm] = fresh[arm] or has_new_command
        control(torques, has_new_command)

    robot.torque_control = noted


def _hear(server: SimulationServer, fresh: list[bool], there: Connection) -> bool:
    """Wait for a torque of each arm; False where the other end is over."""
    fresh[:] = [False, False]
    begin = told = time.monotonic()
    while not all(fresh):
        now = time.monotonic()
        for each, heard in zip(server.robot_servers, tuple(fresh), strict=True):
            if not heard:
                each.process_commands()
                if now > told + REPEAT:
                    each.send_state()
        told = now if now > told + REPEAT else told
        time.sleep(CYCLE / 10.0)
        if there.poll() or now > begin + PATIENCE:
            return False
    return True


def _state(simulator: MujocoSimulator, cell: Workcell) -> list[float]:
    """Force of each pad on the box [N], place of the box [m], its quaternion."""
    assert simulator.data is not None
    box = simulator.data.body("box")
    forces = [_pressed(simulator, f"pad_{robot.name}") for robot in cell.robots]
    return [*forces, *box.xpos, *box.xquat]


def _pressed(simulator: MujocoSimulator, pad: str) -> float:
    """Normal force between a pad and the box [N]."""
    model, data = simulator.model, simulator.data
    assert model is not None
    assert data is not None
    both, total, wrench = {model.geom(pad).id, model.geom("box").id}, 0.0, np.zeros(6)
    for k in range(data.ncon):
        if {data.contact[k].geom1, data.contact[k].geom2} == both:
            mujoco.mj_contactForce(model, data, k, wrench)
            total += wrench[0]
    return total
