"""Networks of the package."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gaponet.nn.network_card import NetworkCard


def networks() -> tuple[NetworkCard, ...]:
    """Return the cards of the trained networks in the package, by name. GapModel.load takes the names.

    Errors in a card are mean absolute joint position errors in mrad, payloads are in kg, rates in Hz.

    Raises:
        ModelError: A card is damaged.
    """
    from gaponet.nn.network_card import network_cards

    return network_cards()
