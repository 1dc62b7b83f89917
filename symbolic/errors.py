"""The root of all user errors, and the errors of describing a cell.

Each package above has an `errors` module with those that it alone raises.
"""

import re


class DualArmError(Exception):
    """Base class of all errors that this project raises on purpose; the message says what to do."""

    def __init__(self, text: str = "", *, code: str = "") -> None:
        super().__init__(text)
        self._code = code

    @property
    def code(self) -> str:
        """Identifier of the kind of error for programs, such as `not-json`. It stays the same when
        the message changes.

        An error that was caused by another error has the code of the cause. An error without a code
        has the name of its class.
        """
        cause = self.__cause__
        if not self._code and isinstance(cause, DualArmError):
            return cause.code
        name = type(self).__name__.removesuffix("Error")
        return self._code or re.sub(r"(?<!^)(?=[A-Z])", "-", name).lower()


class DualArmWarning(UserWarning):
    """Base class of all warnings of this project; the message says what differs from the
    expectation and what to do."""


class OutsideError(DualArmError):
    """A file of unknown origin was refused. The message says why, but does not name the file."""


class WorkcellError(DualArmError):
    """A workcell description is wrong.

    Attributes:
        problems: all problems found, each as `key.path: what was found; what is allowed`.
    """

    def __init__(self, source: str, problems: tuple[str, ...]) -> None:
        self.source = source
        self.problems = problems
        listed = "\n".join(f"  - {problem}" for problem in problems)
        count = "1 problem" if len(problems) == 1 else f"{len(problems)} problems"
        super().__init__(f"{source}: {count}\n{listed}")


class RobotModelError(DualArmError):
    """No usable model of an arm can be made from a robot's URDF."""


class UrdfError(RobotModelError):
    """A URDF file is wrong.

    Attributes:
        file: name of the file, without its folder.
        problems: all problems found, each as `element attribute: what was found; what is allowed`.
    """

    def __init__(self, file: str, problems: tuple[str, ...]) -> None:
        self.file = file
        self.problems = problems
        super().__init__("\n".join(f"{file}: {problem}" for problem in problems))


class SceneError(DualArmError):
    """A scene of another program cannot be read. The message names the file and all problems."""


class BridgeError(DualArmError):
    """A module that is compiled during installation is missing, or was built for other versions of
    the libraries."""


class CollisionModelError(DualArmError):
    """A collision shape is empty, degenerate or otherwise unusable."""


class SettingsError(DualArmError):
    """An option or setting is unknown or outside its allowed range."""


class BundleError(DualArmError):
    """The files of a workcell cannot be packed into one value, or unpacked from such a value."""
