"""The root of all user errors, and the errors of describing a cell.

Each package above has an `errors` module with those that it alone raises.
"""

import re


class DualArmError(Exception):
    """Root of all errors raised on purpose by this project; the text says what to do."""

    def __init__(self, text: str = "", *, code: str = "") -> None:
        super().__init__(text)
        self._code = code

    @property
    def code(self) -> str:
        """Name of the mistake for programs, such as `not-json`, which stays when the text changes.

        An error that passes another one on has its code; one without any has its class's name.
        """
        cause = self.__cause__
        if not self._code and isinstance(cause, DualArmError):
            return cause.code
        name = type(self).__name__.removesuffix("Error")
        return self._code or re.sub(r"(?<!^)(?=[A-Z])", "-", name).lower()


class DualArmWarning(UserWarning):
    """Root of all warnings of this project; the text says what is different and what to do."""


class OutsideError(DualArmError):
    """A file from outside is refused; the text says why, but not which file it is."""


class WorkcellError(DualArmError):
    """A workcell description is wrong.

    Attributes:
        problems: every problem found, each `key.path: what was found; what is allowed`.
    """

    def __init__(self, source: str, problems: tuple[str, ...]) -> None:
        self.source = source
        self.problems = problems
        listed = "\n".join(f"  - {problem}" for problem in problems)
        count = "1 problem" if len(problems) == 1 else f"{len(problems)} problems"
        super().__init__(f"{source}: {count}\n{listed}")


class RobotModelError(DualArmError):
    """A robot's URDF cannot be turned into the model that a computation needs."""


class UrdfError(RobotModelError):
    """A URDF file is wrong.

    Attributes:
        file: its name, without its folder.
        problems: every problem found, each `element attribute: what was found; what is allowed`.
    """

    def __init__(self, file: str, problems: tuple[str, ...]) -> None:
        self.file = file
        self.problems = problems
        super().__init__("\n".join(f"{file}: {problem}" for problem in problems))


class SceneError(DualArmError):
    """A scene of another program cannot be read; the text names its file and every problem."""


class BridgeError(DualArmError):
    """Code compiled at installation is missing, or was built for other versions."""


class CollisionModelError(DualArmError):
    """A collision shape is empty, degenerate or otherwise unusable."""


class SettingsError(DualArmError):
    """An option or setting is unknown or outside its allowed range."""


class BundleError(DualArmError):
    """A workcell's files cannot be collected into one value, or unpacked from it."""
