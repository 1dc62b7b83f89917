"""The contact models that workcell files can name."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

from symbolic.contact.holding_hands import HoldingHands
from symbolic.contact.model import ContactModel
from symbolic.contact.paper_contact import PaperContact
from symbolic.contact.soft_contact import soft_finger
from symbolic.errors import SettingsError
from symbolic.records import Workcell

CONTACT_MODELS: dict[str, Callable[[Workcell], ContactModel]] = {
    "paper": PaperContact,
    "soft-finger": soft_finger,
    "holding-hands": HoldingHands,
}
"""Contact models by the name in `task.allocation` of a workcell file."""


CACHED_MODELS = 16
"""Number of workcells whose contact models are cached."""


@lru_cache(maxsize=CACHED_MODELS)
def contact_model(workcell: Workcell) -> ContactModel:
    """Return the contact model that `task.allocation` of a workcell names."""
    return CONTACT_MODELS[workcell.task.allocation](workcell)


def squeeze_problem(workcell: Workcell, purpose: str) -> str:
    """Return an error message if a workcell's hands hold without a squeeze; '' if its pads press
    the payload between them.

    Args:
        workcell: the cell.
        purpose: subject of the message, such as 'a simulation of pads'.
    """
    if contact_model(workcell).is_squeeze:
        return ""
    return (
        f"{purpose} is for pads that press the payload between them; the hands of this cell "
        "hold by themselves (docs/explanation/limits.md)"
    )


def require_squeeze(workcell: Workcell, purpose: str) -> None:
    """Raise an error unless the arms of a workcell press the payload between them.

    Args:
        workcell: the cell.
        purpose: subject of the error's message, such as 'a simulation of pads'.

    Raises:
        SettingsError: the workcell has hands that hold without a squeeze.
    """
    if problem := squeeze_problem(workcell, purpose):
        raise SettingsError(problem, code="needs-pads")


@lru_cache(maxsize=CACHED_MODELS)
def command_model(workcell: Workcell) -> ContactModel:
    """Return the contact model with which a workcell's commanded forces and worst cases are
    computed."""
    return contact_model(workcell).command_model
