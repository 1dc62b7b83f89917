"""The contact models that workcell files can name."""

from __future__ import annotations

from collections.abc import Callable

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
"""Models by the name that `task.allocation` of a workcell file has."""


def contact_model(workcell: Workcell) -> ContactModel:
    """Return the contact model of a workcell."""
    return CONTACT_MODELS[workcell.task.allocation](workcell)


def squeeze_problem(workcell: Workcell, purpose: str) -> str:
    """Return why a purpose does not apply to hands that hold by themselves; '' for pads that
    press."""
    if contact_model(workcell).is_squeeze:
        return ""
    return (
        f"{purpose} is for pads that press the payload between them; the hands of this cell "
        "hold by themselves (docs/explanation/limits.md)"
    )


def require_squeeze(workcell: Workcell, purpose: str) -> None:
    """Refuse hands that hold by themselves.

    Raises:
        SettingsError: the arms do not press the payload between them.
    """
    if problem := squeeze_problem(workcell, purpose):
        raise SettingsError(problem, code="needs-pads")


def command_model(workcell: Workcell) -> ContactModel:
    """Return the contact model of a workcell's commanded forces and worst cases."""
    return contact_model(workcell).command_model
