"""Finding every file that a workcell file names, and a layout in which its references hold."""

from __future__ import annotations

import posixpath
from collections.abc import Iterator, Mapping
from itertools import count
from pathlib import Path
from typing import Any

from symbolic import outside
from symbolic.errors import BundleError, OutsideError, RobotModelError
from symbolic.robot.packages import PACKAGE_SCHEME
from symbolic.robot.urdf import resolve_mesh
from symbolic.robot.urdf_file import parse_urdf
from symbolic.robot.xacro_file import description_content
from symbolic.workcell.branches import with_branches
from symbolic.workcell.records import Robot, Workcell


class CellCollector:
    """Gathers a workcell's files and gives each a place relative to the workcell file."""

    def __init__(self, source: Path) -> None:
        self._source = source
        self._text = outside.text(_content(source, outside.WORKCELL_BYTES))
        self._files: dict[str, bytes] = {}
        self._folders: list[str] = []
        self._moved = 0
        self._places: dict[str, str] = {}

    def collect(self, workcell: Workcell) -> None:
        """Add every file that the workcell names."""
        text = self._text.encode("utf-8")
        text = with_branches(text, parse_toml(text), workcell.start_branch)
        self._text, data = outside.text(text), parse_toml(text)
        for robot, entry in zip(workcell.robots, data["robots"], strict=True):
            urdf = self._place(str(entry["urdf"]))
            folders = [self._place(str(folder)) for folder in entry.get("package_dirs", [])]
            self._folders.extend(folders)
            # Folders beyond those of the file belong to this machine; what they hold is embedded.
            named = list(zip(robot.package_dirs, folders, strict=False))
            self._files[urdf] = self._with_meshes(robot, urdf, named)
            if robot.srdf is not None:
                place = self._place(str(entry["srdf"]))
                self._files[place] = _content(robot.srdf, outside.URDF_BYTES)
        for reference, package_dirs in references(data):
            if package_dirs is None and self._place(reference) not in self._files:
                content = _content(self._source.parent / reference, outside.MESH_BYTES)
                self._files[self._place(reference)] = content

    def layout(self) -> tuple[str, dict[str, bytes], tuple[str, ...]]:
        """Everything collected, moved so that no path leads upwards.

        Returns:
            The path of the workcell file, the content of every file by path, and the package
            folders.
        """
        names = [name.split("/") for name in (*self._files, *self._folders)]
        depth = max((parts.count("..") for parts in names), default=0)
        taken = {part for parts in names for part in parts}
        level = next(name for name in (f"cell{k or ''}" for k in count()) if name not in taken)
        base = "/".join([level] * depth)
        workcell = joined(base, "workcell.toml" if depth else f"{level}.toml")
        files = {joined(base, name): content for name, content in self._files.items()}
        files[workcell] = self._text.encode("utf-8")
        folders = dict.fromkeys(joined(base, name) for name in self._folders)
        return workcell, files, tuple(folders)

    def _place(self, reference: str) -> str:
        """The place of a reference of the workcell file, relative to that file."""
        if not posixpath.isabs(reference) and not reference.startswith(PACKAGE_SCHEME):
            return posixpath.normpath(reference)
        if reference in self._places:  # both robots may name one file
            return self._places[reference]
        moved = self._places[reference] = self._new_place(reference)
        self._text = _replaced(self._text, reference, moved, self._source.name)
        return moved

    def _new_place(self, reference: str) -> str:
        self._moved += 1
        return f"embedded/{self._moved}/{posixpath.basename(reference) or 'folder'}"

    def _with_meshes(self, robot: Robot, place: str, packages: list[tuple[Path, str]]) -> bytes:
        """Add the meshes of a URDF; its content with this machine's addresses replaced."""
        path = robot.urdf
        try:
            content = description_content(path, robot.xacro_arguments, robot.package_dirs)
            named = parse_urdf(content, path.name)
        except (OutsideError, RobotModelError) as error:
            raise BundleError(str(error)) from error
        for address in dict.fromkeys((*named.collision_meshes, *named.visual_meshes)):
            mesh = resolve_mesh(address, path, robot.package_dirs)
            if mesh is None:
                continue
            target = self._own_place(address, path, place, packages)
            if target is None:
                # Below the URDF's folder, whose own name the address need not know.
                relative = self._new_place(mesh.as_posix())
                target = joined(posixpath.dirname(place), relative)
                content = _replaced(content.decode("utf-8"), address, relative, path.name).encode(
                    "utf-8"
                )
            self._files[target] = _content(mesh, outside.MESH_BYTES)
        return content

    @staticmethod
    def _own_place(
        address: str, urdf: Path, place: str, packages: list[tuple[Path, str]]
    ) -> str | None:
        """Where a mesh address leads within the workcell's own folders; None beyond them."""
        if address.startswith(PACKAGE_SCHEME):
            held = (at for folder, at in packages if resolve_mesh(address, urdf, (folder,)))
            folder = next(held, None)
            return folder and joined(folder, address.removeprefix(PACKAGE_SCHEME))
        target = address.removeprefix("file://")
        return None if posixpath.isabs(target) else joined(posixpath.dirname(place), target)


def _content(path: Path, most: int) -> bytes:
    try:
        return outside.read_bytes(path, most)
    except OutsideError as error:
        raise BundleError(f"{path} {error}") from error


def _replaced(text: str, reference: str, moved: str, file: str) -> str:
    """Text with every quoted occurrence of a reference replaced."""
    for quote in ('"', "'"):
        if f"{quote}{reference}{quote}" in text:
            return text.replace(f"{quote}{reference}{quote}", f"{quote}{moved}{quote}")
    raise BundleError(
        f"{file} names {reference!r} by an absolute path in an unusual spelling; write it "
        "relative to the file so that the trajectory can be stored with it"
    )


def joined(base: str, reference: str) -> str:
    """A reference seen from the folder that `base` is relative to, `..` resolved."""
    return posixpath.normpath(posixpath.join(base, reference))


def parse_toml(content: bytes) -> dict[str, Any]:
    """The tables of a workcell file.

    Raises:
        BundleError: it is not TOML.
    """
    try:
        return outside.toml_tables(content)
    except OutsideError as error:
        raise BundleError(f"the stored workcell: {error}") from error


def references(data: Mapping[str, Any]) -> Iterator[tuple[str, list[str] | None]]:
    """Files named by a workcell: the reference and, for a URDF, its package folders.

    Raises:
        BundleError: a key is missing or has another type.
    """
    try:
        for robot in data.get("robots", []):
            yield str(robot["urdf"]), [str(entry) for entry in robot.get("package_dirs", [])]
            if "srdf" in robot:
                yield str(robot["srdf"]), None
            yield from _meshes(robot.get("tool", []))
        yield from _meshes(data.get("environment", []))
        yield from _meshes([data.get("payload", {})])
    except (KeyError, TypeError, AttributeError) as error:
        raise BundleError(f"the stored workcell lacks or misuses the key {error}") from error


def _meshes(bodies: Any) -> Iterator[tuple[str, None]]:
    for body in bodies:
        if body.get("kind") == "mesh":
            yield str(body["path"]), None
