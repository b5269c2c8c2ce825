"""What is refused about a link to a vehicle."""

from __future__ import annotations

from uuvtai.errors import UserError


class LinkError(UserError, RuntimeError):
    """A link that cannot be had, or used: what, where, why, what to type next."""
