"""Lists in YAML whose entries say by one key what they are: ``- arc: {radius_cm: 80, angle_deg: 90}``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pydantic import model_serializer, model_validator

from lanenet.config import Settings


class OneOf(Settings):
    """An entry of which exactly one key is set."""

    @model_validator(mode="after")
    def _exactly_one(self) -> OneOf:
        names = self.keys_set
        if len(names) != 1:
            known = ", ".join(type(self).model_fields)
            raise ValueError(f"expected exactly one of {known}, found {' and '.join(names) or 'none'}")
        return self

    @model_serializer(mode="wrap")
    def _only_what_is_set(self, handler: Callable[[Any], Any]) -> dict[str, Any]:
        return {name: value for name, value in handler(self).items() if value is not None}

    @property
    def keys_set(self) -> list[str]:
        """Names of the keys that are set."""
        return [name for name in type(self).model_fields if getattr(self, name) is not None]

    @property
    def kind(self) -> str:
        """Name of the one key."""
        return self.keys_set[0]

    @property
    def value(self) -> Any:
        """What stands under it."""
        return getattr(self, self.kind)
