"""The contact models that workcell files can name."""

from __future__ import annotations

from collections.abc import Callable

from symbolic.contact.model import ContactModel
from symbolic.contact.paper_contact import PaperContact
from symbolic.contact.soft_contact import soft_finger
from symbolic.records import Workcell

CONTACT_MODELS: dict[str, Callable[[Workcell], ContactModel]] = {
    "paper": PaperContact,
    "soft-finger": soft_finger,
}
"""Models by the name that `task.allocation` of a workcell file has."""


def contact_model(workcell: Workcell) -> ContactModel:
    """Return the contact model of a workcell."""
    return CONTACT_MODELS[workcell.task.allocation](workcell)


def command_model(workcell: Workcell) -> ContactModel:
    """Return the contact model of a workcell's commanded forces and worst cases."""
    return contact_model(workcell).command_model
