"""The project's error hierarchy: every error a user can cause has one root."""


class DualArmError(Exception):
    """Root of all errors raised on purpose by this project; the text says what to do."""


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


class BridgeError(DualArmError):
    """The compiled Pinocchio-CasADi bridge is missing or was built for other versions."""


class CodegenError(DualArmError):
    """C code could not be generated, compiled, cached or loaded."""


class CollisionModelError(DualArmError):
    """A collision shape is empty, degenerate or otherwise unusable."""


class SettingsError(DualArmError):
    """An option or setting is unknown or outside its allowed range."""


class ResultsError(DualArmError):
    """Stored results are missing, damaged, or belong to another configuration."""


class WorkerError(DualArmError):
    """Processes or machines that work for this one were lost or do not fit."""


class ReportError(DualArmError):
    """A report, picture or animation cannot be made."""
